"""What a stage gets to read: the golden outputs of the stages before it, kept in the repository as small as they go.

Arrays are rounded to 1/4096 of their unit and pictures to half precision, so that they pack well; they are inputs like
any others. Records that a stage looks for beside its inputs (manifest, provenance) are written when they are laid out.
"""

from __future__ import annotations

import importlib
import io
import shutil
import zipfile
from pathlib import Path

import numpy as np

from shared.contract.declare import Stage
from shared.contract.hashing import hash_file
from shared.contract.manifest import MANIFEST, PROVENANCE, RECORDS, make_work, write_record
from shared.io.arrays import load_arrays
from shared.io.images import read_exr, write_exr
from shared.io.material_maps import read_material, write_material
from tools.goldens.tiny import GOLDEN_FOLDER, SETTINGS, STAGES, TINY_SUBJECT, stage_folder

_LEFT_OUT = {
    "sample_frames": ("contact_sheet.png",),
    "track_landmarks": ("overlay.png", "curves.png", "residuals.png"),
    "init_albedo": ("segments.png", "segment_albedo.exr"),
    "inverse_render": ("shape.png",),
}
"""Outputs that no later stage needs."""
_GRAIN = 4096.0
_EPOCH = (1980, 1, 1, 0, 0, 0)


def stage_of(name: str) -> Stage:
    """A stage's declaration."""
    return importlib.import_module(f"stages.{name}").STAGE


def kept_folder(stage: str) -> Path:
    """Where the repository keeps a stage's golden outputs for the stages after it."""
    return GOLDEN_FOLDER / stage / "output"


def keep_outputs(run_folder: Path, stage: str) -> None:
    """Replaces a stage's kept outputs by those of a run."""
    source, target = stage_folder(run_folder, stage), kept_folder(stage)
    shutil.rmtree(target, ignore_errors=True)
    for path in sorted(path for path in source.rglob("*") if path.is_file()):
        name = path.relative_to(source).as_posix()
        if name in RECORDS or name in _LEFT_OUT[stage]:
            continue
        (target / name).parent.mkdir(parents=True, exist_ok=True)
        if path.suffix == ".npz":
            _pack(target / name, load_arrays(path))
        elif path.stem == "material":
            write_material(target / name, read_material(path), half=True, attributes={})
        elif path.suffix == ".exr":
            colour_space = "lin_rec709_scene" if stage == "init_albedo" or "maps" not in name else "data"
            image = read_exr(path).astype(np.float16)
            write_exr(target / name, image, colour_space=colour_space, latlong=name == "envmap.exr")
        else:
            shutil.copyfile(path, target / name)


def _pack(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """An .npz as small as it goes; poses stay as they are, since rounded ones would not be rigid."""
    with zipfile.ZipFile(path, "w") as archive:
        for name, values in sorted(arrays.items()):
            if values.dtype.kind == "f" and values.ndim == 2 and len(values) > 100:
                values = np.round(values * _GRAIN) / _GRAIN
            buffer = io.BytesIO()
            np.lib.format.write_array(buffer, values, allow_pickle=False)
            archive.writestr(zipfile.ZipInfo(f"{name}.npy", _EPOCH), buffer.getvalue(), zipfile.ZIP_DEFLATED, 9)


def lay_out(out: Path, stage: str) -> Path:
    """Makes out/<subject>/work/ with the results of all stages before this one -> out/<subject>."""
    run_folder = out / TINY_SUBJECT.name
    for name in STAGES[: STAGES.index(stage)]:
        folder = stage_folder(run_folder, name)
        shutil.copytree(kept_folder(name), folder)
        _describe(folder, name)
    return run_folder


def _describe(folder: Path, name: str) -> None:
    """The records that the stages after it look for."""
    stage = stage_of(name)
    given = dict(setting.split("=") for setting in SETTINGS.get(name, ()))
    parameters = {p.name: p.parse(given[p.name], name) if p.name in given else p.default for p in stage.parameters}
    work = make_work(stage, parameters, {})
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    outputs = {path.relative_to(folder).as_posix(): {"sha256": hash_file(path), "bytes": path.stat().st_size}
               for path in files}
    write_record(folder / MANIFEST, {**work.content(), "key": work.key, "outputs": outputs})
    costs = {"wall_s": 1.0, "cpu_s": 1.0, "peak_memory_mb": 100.0, "warnings": [], "threads": 1}
    write_record(folder / PROVENANCE, costs)
