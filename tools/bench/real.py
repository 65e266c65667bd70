"""How well real clips come out, which have no truth: run as a new user would, judged on frames that were held out.

    python -m tools.bench real FOLDER --out DIR [--exceptions FILE] [--preset NAME] [--set STAGE.KEY=VALUE ...]

FOLDER   holds the clips (mp4, mov, mkv, gif); each is a case by its name.
FILE     yaml, what `limn new` is told of single clips: `NAME: {moves: camera}` (also transfer, focal_length_px,
         focal_length_mm, sensor_width_mm); FOLDER/clips.yaml by default, where there is one. Of all others it is told
         nothing, no focal length either.
Does     `limn new` in DIR/subjects, `limn run` in DIR/runs (what is finished there is kept), then re-renders the
         held-out frames. DIR/sheets has a sheet of each clip (frame, re-render, error, albedo, another light), and
         DIR/real.html shows them beside the table. These pictures are made of the clip: mind its licence.
Columns  skin_, eyes_, lips_, head_: PSNR linear (db) and of sRGB codes (srgb_db), structural similarity (ssim). skin is
         the face without eyes, lids, brows and lips; head all that the mesh covers inside the person mask; pixels
         that are clipped count nowhere, clipped_share is theirs of the skin. detail: sharpness of the mean texture
         under the final poses, tracked_detail under the tracked ones (python -m tools.bench.whole_run). jitter_:
         median second difference of the final poses, per frame squared; tracked_jitter_: of the tracked ones.
         roughness_end, specular_end: the end of its range that the fit reached. highlights_fitted: false where both
         stayed what they were before the fit, as after a step that had to be undone. refused: why the run ended early.
Resumes  rows of the same clip, arguments and code are kept.
"""

from __future__ import annotations

import argparse
import re
import shutil
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from shared.appearance.projection import ROUGHNESS_RANGE, SPECULAR_RANGE, reached_end
from shared.contract.hashing import hash_file
from shared.contract.pipeline import load_pipeline
from shared.contract.wording import check_keys, read_yaml, unknown_name
from shared.errors import InputError
from shared.io.arrays import load_arrays, read_json
from tools.bench.chart.runs import SHOWN, current_code
from tools.bench.real_page import clip_sheet, html_page
from tools.bench.rerender import SolvedClip
from tools.bench.runner import Bench, Entry, Table, markdown_table, measured
from tools.bench.whole_run import code_of, cost_row, detail_row
from tools.scoring.held_out import pose_acceleration, region_errors

SUFFIXES = (".mp4", ".mov", ".mkv", ".gif")
TOLD = ("moves", "transfer", "focal_length_px", "focal_length_mm", "sensor_width_mm")
EXCEPTIONS = "clips.yaml"
NEEDS_A_LOOK = 3
"""Exit code of a run that misses a quality gate; it is a result."""
SCORED_BY = ("tools/bench/real.py", "tools/bench/rerender.py", "tools/scoring/held_out.py", "tools/bench/whole_run.py",
             "tools/relight/inputs.py", "shared/rendering/views.py", "shared/rendering/render.py")  # fmt: skip
JUDGED = ("skin", "bare_skin", "eyes", "lips", "head")
REGION_COLUMNS = tuple(f"{region}_{kind}" for region in JUDGED for kind in ("db", "srgb_db", "ssim"))
COLUMNS = (
    "case", "told", "frames", "held_out", *REGION_COLUMNS, "skin_pixels", "bare_skin_pixels", "clipped_share",
    "detail", "tracked_detail", "jitter_deg", "jitter_across_mm", "jitter_depth_mm", "tracked_jitter_deg",
    "roughness", "roughness_end", "specular", "specular_end", "highlights_fitted", "reprojection_p95_px",
    "noise_factor", "focal_gain", "rotation_range_deg", "fitted_residual", "held_out_residual", "wall_s", "cpu_s",
    "peak_mb", "warnings", "refused",
)  # fmt: skip


@dataclass(frozen=True)
class RealClip:
    """A clip and what `limn new` is told of it; digest: of its content."""

    path: Path
    told: Mapping[str, object]
    digest: str

    def arguments(self) -> list[str]:
        """Of `limn new`, but for the folder."""
        options = [(f"--{name.replace('_', '-')}", str(value)) for name, value in self.told.items()]
        return [str(self.path), *(word for pair in options for word in pair)]

    def say(self) -> str:
        """What is told, in words."""
        return ", ".join(f"{name} {value}" for name, value in self.told.items())


def all_clips(folder: Path, exceptions: Path | None) -> dict[str, RealClip]:
    """{name: clip}, by name. InputError where there is none, where two share a name or an exception fits none."""
    paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES) if folder.is_dir() else []
    if not paths:
        raise InputError("no clip in this folder", where=str(folder), expected=", ".join(SUFFIXES))
    told = read_exceptions(exceptions, {path.stem for path in paths}) if exceptions else {}
    clips: dict[str, RealClip] = {}
    for path in paths:
        name = re.sub(r"[^\w.-]+", "_", path.stem).strip("._")  # as `limn new` names a folder
        if not name or name in clips:
            raise InputError("not a name of its own", where=str(folder), got=path.name, hint="rename the clip")
        clips[name] = RealClip(path, told.get(path.stem, {}), hash_file(path)[:SHOWN])
    return clips


def read_exceptions(path: Path, names: set[str]) -> dict[str, dict[str, object]]:
    """{name of a clip: what `limn new` is told of it}. InputError for other names or other keys."""
    content = check_keys(read_yaml(path), names, str(path))
    return {name: check_keys(told, TOLD, f"{path}, {name}") for name, told in content.items()}


def row_of(run: Path, sheet: Path) -> dict[str, object]:
    """The measures of a finished run; its sheet is written."""
    clip = SolvedClip(run)
    compared = clip.compared()
    clip_sheet(clip, compared, sheet)
    regions = region_errors(compared)
    return {
        "held_out": len(compared),
        **{f"{region}_{kind}": regions.get(region, {}).get(kind) for region in JUDGED
           for kind in ("db", "srgb_db", "ssim", "pixels")},
        "clipped_share": clip.clipped_share(),
        **detail_row(run),
        **pose_columns(run),
        **record_columns(run),
        **cost_row(run),
    }  # fmt: skip


def pose_columns(run: Path) -> dict[str, float]:
    """How much the final poses tremble, and the tracked ones."""
    found = {}
    for prefix, stage in (("", "inverse_render"), ("tracked_", "track_landmarks")):
        poses = load_arrays(run / "work" / stage / "poses.npz")
        trembling = pose_acceleration(poses["camera_from_head"], poses["frame_index"])
        found |= {f"{prefix}jitter_{kind}": value for kind, value in trembling.items()}
    return found


def record_columns(run: Path) -> dict[str, object]:
    """What the stages' own records say of tracking, material and residuals."""
    tracking = read_json(run / "work" / "track_landmarks" / "tracking.json")
    solve, given = (read_json(run / "work" / "inverse_render" / name) for name in ("solve.json", "manifest.json"))
    roughness, specular = solve["model"]["roughness"], solve["model"]["specular_intensity"]
    before = given["parameters"]["roughness"], given["parameters"]["specular_prior"]
    return {
        "frames": tracking["frames"],
        "roughness": roughness,
        "roughness_end": reached_end(roughness, ROUGHNESS_RANGE),
        "specular": specular,
        "specular_end": reached_end(specular, SPECULAR_RANGE),
        "highlights_fitted": (roughness, specular) != before,
        "reprojection_p95_px": tracking["reprojection_px"]["p95"],
        "noise_factor": tracking["noise_factor"],
        "focal_gain": tracking["focal"]["gain"],
        "rotation_range_deg": tracking["rotation_range_deg"],
        "fitted_residual": solve["residuals"]["fitted"],
        "held_out_residual": solve["residuals"]["held_out"],
    }


class RealBench(Bench):
    """Every clip of a folder. A clip that the run refuses is a row, too, and tried again the next time. Beside its rows
    the table holds `code`, {case: {file: fingerprint}} of what made them."""

    name, columns = "real", COLUMNS

    @classmethod
    def add_arguments(cls, parser: argparse.ArgumentParser) -> None:
        parser.add_argument("folder", type=Path, metavar="FOLDER", help="holds the clips")
        parser.add_argument("--exceptions", type=Path, metavar="FILE", help=f"yaml ({EXCEPTIONS} of FOLDER)")
        parser.add_argument("--preset", default="standard", help="of every run (standard)")
        parser.add_argument("--set", nargs="*", default=[], metavar="STAGE.KEY=VALUE", help="parameters of every run")

    def __init__(self, options: argparse.Namespace):
        super().__init__(options)
        folder, self.out, self.pipeline = options.folder.resolve(), options.out.resolve(), load_pipeline(None)
        beside = folder / EXCEPTIONS
        self._clips = all_clips(folder, options.exceptions or (beside if beside.is_file() else None))
        if options.preset not in self.pipeline.presets:
            raise unknown_name("preset", options.preset, self.pipeline.presets, "--preset")

    def facts(self) -> dict[str, Any]:
        versions = {name: stage.version for name, stage in self.pipeline.stages.items()}
        return {"preset": self.options.preset, "set": sorted(self.options.set), "versions": versions}

    def refresh(self, table: Table) -> None:
        """Drops rows of other code, of another clip of that name or told something else, and of clips refused."""
        code = table.beside.setdefault("code", {})

        def holds(row: Mapping) -> bool:
            clip = self._clips.get(row["case"])
            same = clip is None or (row["clip"], row["told"]) == (clip.digest, clip.say())
            return same and not row.get("refused") and current_code(code.get(row["case"], {}))

        kept = [row for row in table.rows if holds(row)]
        table.dropped += len(table.rows) - len(kept)
        table.rows = kept

    def cases(self) -> dict[str, RealClip]:
        return self._clips

    def measure(self, case: RealClip, entry: Entry) -> None:
        facts = {"clip": case.digest, "told": case.say()}
        subject, runs = self.subject_of(entry.name, case), self.out / "runs"
        command = [sys.executable, "-m", "tools.limn", "run", str(subject), "--out", str(runs), "--renew"]
        command += ["--preset", self.options.preset, *(word for own in self.options.set for word in ("--set", own))]
        try:
            measured(command, runs / f"{entry.name}.log", well=(0, NEEDS_A_LOOK))
        except InputError as error:
            entry.add(facts | {"refused": str(error)})
            return
        run = runs / entry.name
        row = row_of(run, self.out / "sheets" / f"{entry.name}.png")
        entry.table.beside["code"][entry.name] = code_of(run, SCORED_BY)
        entry.add(facts | row)

    def subject_of(self, name: str, case: RealClip) -> Path:
        """The subject's folder, made anew: what was told of the clip may have changed."""
        folder = self.out / "subjects" / name
        shutil.rmtree(folder, ignore_errors=True)
        folder.parent.mkdir(parents=True, exist_ok=True)
        new = [sys.executable, "-m", "tools.limn", "new", "--dest", str(folder.parent), "--name", name]
        measured([*new, *case.arguments()], self.out / "subjects" / f"{name}.log")
        return folder

    def say(self, row: Mapping) -> list[str]:
        if row.get("refused"):
            return [str(row["case"]), str(row["refused"])]
        shown = ("skin_db", "skin_ssim", "eyes_db", "lips_db", "head_db", "detail", "jitter_deg", "wall_s")
        return [str(row["case"]), *(f"{name} {row[name]:.4g}" for name in shown if row[name] is not None)]

    def page(self, table: Table) -> str:
        """A clip in a column: there are more measures than clips."""
        rows = self.shown(table)
        turned = [{"case": name, **{row["case"]: row.get(name) for row in rows}} for name in COLUMNS[1:]]
        return markdown_table(turned)

    def write(self, table: Table) -> None:
        super().write(table)
        page = html_page(self.shown(table), COLUMNS[1:], self.out / "sheets")
        (self.out / "real.html").write_text(page, encoding="utf-8")
