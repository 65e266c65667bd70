"""Golden files: what each stage makes of the tiny subject, reduced to a few hundred numbers.

    python -m tools.goldens [STAGE ...]     runs the tiny subject and rewrites tests/golden/<stage>.json

A golden file changes only on purpose, together with its stage's version or an earlier stage's, with the reason in the
commit. Images are kept as a coarse grid of block means, arrays as evenly spaced samples with their spread: enough to
notice any change of result, small enough to read in a review.
"""

from __future__ import annotations

import argparse
import importlib
import tempfile
from pathlib import Path

import numpy as np

from shared.io.arrays import load_arrays, read_json, write_json
from shared.io.images import read_exr, read_png

ROOT = Path(__file__).resolve().parents[1]
TINY_SUBJECT = ROOT / "tests" / "tiny"
GOLDEN_FOLDER = ROOT / "tests" / "golden"
STAGES = ("sample_frames", "track_landmarks", "init_albedo", "inverse_render", "export_usd")
TINY_SETTINGS = (
    "init_albedo.size=256",
    "inverse_render.map_size=256",
    "inverse_render.shape_subdivisions=0",
    "inverse_render.shape_rounds=1",
)
BLOCKS, SAMPLES = 8, 24
MOST_FILES = 4
"""Of many files of one kind (frames, masks) the first few stand for all."""


def stage_folder(run_folder: Path, stage: str) -> Path:
    """Where a run keeps one stage's files."""
    return run_folder / "export" if stage == "export_usd" else run_folder / "work" / stage


def summarise(folder: Path, stage: str) -> dict:
    """{file: numbers} of one stage's folder, with the version that made it and those of the stages before it."""
    files = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())
    content = {}
    for suffix, reduce in ((".exr", _image), (".png", _image), (".npz", _archive)):
        for name in [name for name in files if name.endswith(suffix)]:
            siblings = [other for other in content if Path(other).parent == Path(name).parent]
            if len(siblings) < MOST_FILES or "maps/" in name:
                content[name] = reduce(folder / name)
    kept = [name for name in files if not name.endswith("log.txt")]
    before = {name: version(name) for name in STAGES[: STAGES.index(stage)]}
    return {"version": version(stage), "before": before, "files": kept, "content": content}


def version(stage: str) -> int:
    """A stage's version as declared."""
    return importlib.import_module(f"stages.{stage}").STAGE.version


def _image(path: Path) -> dict:
    image = (read_exr if path.suffix == ".exr" else read_png)(path).astype(np.float64)
    rows = np.array_split(np.arange(image.shape[0]), BLOCKS)
    columns = np.array_split(np.arange(image.shape[1]), BLOCKS)
    means = [[image[np.ix_(row, column)].mean((0, 1)) for column in columns] for row in rows]
    return {"shape": list(image.shape), "blocks": _rounded(means)}


def _archive(path: Path) -> dict:
    return {name: _array(values) for name, values in load_arrays(path).items() if values.dtype.kind in "fiu"}


def _array(values: np.ndarray) -> dict:
    flat = values.astype(np.float64).ravel()
    chosen = flat[np.unique(np.linspace(0, len(flat) - 1, SAMPLES).astype(int))] if len(flat) else flat
    return {"shape": list(values.shape), "spread": _rounded(np.nanstd(flat)), "samples": _rounded(chosen)}


def _rounded(values) -> list | float:
    return np.round(np.nan_to_num(np.asarray(values, np.float64)), 6).tolist()


def run_tiny(destination: Path) -> Path:
    """The tiny subject from clip to export in destination -> the folder with work/ and export/."""
    from tools.limn import main as limn

    settings = [word for setting in TINY_SETTINGS for word in ("--set", setting)]
    code = limn(["run", str(TINY_SUBJECT), "--out", str(destination), *settings])
    if code not in (0, 3):
        raise RuntimeError(f"the run of the tiny subject ended with exit code {code}")
    return destination / TINY_SUBJECT.name


def main() -> int:
    """Rewrites the golden files of the stages named, or of all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("stages", nargs="*", metavar="STAGE", help=", ".join(STAGES))
    chosen = parser.parse_args().stages or STAGES
    with tempfile.TemporaryDirectory() as scratch:
        run_folder = run_tiny(Path(scratch))
        for stage in chosen:
            target = GOLDEN_FOLDER / f"{stage}.json"
            summary = summarise(stage_folder(run_folder, stage), stage)
            if target.exists():
                old = read_json(target)
                raised = any(old.get(key) != summary[key] for key in ("version", "before"))
                if old["content"] != summary["content"] and not raised:
                    print(f"{stage}: the result changed but the stage's version is still {old['version']}: raise it")
            GOLDEN_FOLDER.mkdir(parents=True, exist_ok=True)
            write_json(target, summary)
            print(f"{target}: {len(summary['content'])} files")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
