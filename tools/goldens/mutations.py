"""Does a golden file notice a change of method? One constant at a time is changed by 5 % in a copy of the code.

A mutation says where a number stands and what stands there; one that is not found there any more is an error, so that
the list keeps up with the code.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from tools.goldens.golden import differences, read_golden, run_from_inputs
from tools.goldens.kernels import OWN, REPOSITORY

_COPIED = ("shared", "stages", "tools", "tests/tiny", "tests/golden", "pipeline.yaml", ".models")


@dataclass(frozen=True)
class Mutation:
    """kind of constant; stage whose golden has to notice; file and the text in it, before and after."""

    name: str
    stage: str
    file: str
    before: str
    after: str
    quick: bool = False


MUTATIONS = (
    Mutation("person mask: level", "sample_frames", "shared/capture/framing.py", "MASK_LEVEL = 0.5",
             "MASK_LEVEL = 0.525", quick=True),
    Mutation("sharpness: fine scale", "sample_frames", "shared/capture/frame_quality.py", "COARSE_PX = 0.8, 1.6",
             "COARSE_PX = 0.84, 1.6"),
    Mutation("landmarks: crop", "sample_frames", "shared/capture/landmarks.py", "CROP_ENLARGEMENT = 1.5",
             "CROP_ENLARGEMENT = 1.575"),
    Mutation("tracks: robust weight", "track_landmarks", "shared/tracking/texture_tracks.py", "OUTLIER_SPREADS = 1.5",
             "OUTLIER_SPREADS = 1.575"),
    Mutation("adjustment: robust weight", "track_landmarks", "shared/tracking/first_poses.py", "\nLOSS = 2.0",
             "\nLOSS = 2.1"),
    Mutation("head fit: prior of codes", "track_landmarks", "shared/tracking/fit_head.py", "identity: float = 1.0",
             "identity: float = 1.05"),
    Mutation("adjustment: stopping bound", "track_landmarks", "shared/tracking/bundle.py", "LEAST_GAIN = 1e-4",
             "LEAST_GAIN = 1.05e-4"),
    Mutation("transfer function: exponent", "init_albedo", "shared/imaging/color.py", "0.055) / 1.055) ** 2.4)",
             "0.055) / 1.055) ** 2.52)", quick=True),
    Mutation("view weight: exponent", "init_albedo", "shared/imaging/image_sampling.py",
             "np.where(shown, cosine**2, 0.0)", "np.where(shown, cosine**2.1, 0.0)"),
    Mutation("segments: seen weight", "init_albedo", "stages/init_albedo.py", "SEEN_WEIGHT = 0.5",
             "SEEN_WEIGHT = 0.525"),
    Mutation("BRDF: normal incidence", "inverse_render", "shared/rendering/brdf.py", "\nF0 = 0.04", "\nF0 = 0.042"),
    Mutation("prior: specular intensity", "inverse_render", "stages/inverse_render.py", '"specular_prior", float, 0.84',
             '"specular_prior", float, 0.882'),
    Mutation("shape: smoothness", "inverse_render", "stages/inverse_render.py", '"shape_smoothness", float, 19.0',
             '"shape_smoothness", float, 19.95'),
    Mutation("texture: prior's spread", "inverse_render", "shared/appearance/texture.py", "PRIOR_SPREAD = 0.3",
             "PRIOR_SPREAD = 0.315"),
    Mutation("views: studio lamps", "export_usd", "shared/rendering/studio_lights.py", "share = 0.5 + 0.5 *",
             "share = 0.525 + 0.5 *"),
    Mutation("views: framing", "export_usd", "shared/rendering/views.py", "DISTANCE_MM, FILLED = 900.0, 1.1",
             "DISTANCE_MM, FILLED = 900.0, 1.155"),
)


def mutated_text(mutation: Mutation) -> str:
    """The file's text with the constant changed. ValueError unless it stands there once."""
    text = (REPOSITORY / mutation.file).read_text(encoding="utf-8")
    if text.count(mutation.before) != 1:
        raise ValueError(f"{mutation.name}: {mutation.before!r} stands {text.count(mutation.before)} times in "
                         f"{mutation.file}")
    return text.replace(mutation.before, mutation.after)


def noticed_by(mutation: Mutation) -> list[str]:
    """The lines that the stage's golden test would fail with, the constant changed. ValueError where it is not found.
    """
    with tempfile.TemporaryDirectory() as scratch:
        copy = Path(scratch) / "code"
        _copy_code(copy)
        (copy / mutation.file).write_text(mutated_text(mutation), encoding="utf-8")
        run = run_from_inputs(mutation.stage, Path(scratch) / "out", OWN, copy)
        return list(differences(mutation.stage, run.measures, read_golden(mutation.stage)))


def _copy_code(target: Path) -> None:
    """What a stage needs of the repository; data that no mutation changes are links."""
    for name in _COPIED:
        source = REPOSITORY / name
        if source.suffix == ".yaml":
            shutil.copyfile(source, target / name)
        elif name.startswith(("tests", ".models")):
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            (target / name).symlink_to(source)
        else:
            shutil.copytree(source, target / name, ignore=shutil.ignore_patterns("__pycache__"))


def mutation_table(mutations: Sequence[Mutation], at_once: int) -> str:
    """A line of every mutation: stage, constant, change, and what noticed."""
    with ThreadPoolExecutor(at_once) as pool:
        found = list(pool.map(noticed_by, mutations))
    lines = []
    for mutation, seen in zip(mutations, found, strict=True):
        change = f"{mutation.before.strip()} -> {mutation.after.strip()}"
        first = seen[0].split(": ", 1)[1] if seen else "NOT NOTICED"
        more = f" and {len(seen) - 1} more" if len(seen) > 1 else ""
        lines.append(f"{mutation.stage:16}{mutation.name:28}{change:90}{first}{more}")
    return "\n".join(lines)
