"""Small pictures of a subject: the clip, its re-render and the head from a side, or a crop where it got no further."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from shared.contract.folders import RunFolder
from shared.contract.manifest import read_manifest
from shared.errors import InputError
from shared.io.export_maps import acescg_from_rec709
from shared.io.image_sequence import ImageSequenceReader
from shared.io.images import exr_size, read_exr
from shared.io.source import check_size
from shared.report.pictures import jpeg_uri, shrunk, srgb_bytes

EDGE_PX = 112
SIDE_VIEW = "left"


def result_pictures(run: RunFolder) -> list[tuple[str, str]]:
    """(what it shows, data URI) of a finished result, of those files that its parameters left; InputError where one
    cannot be read, or lies elsewhere."""
    export, found = run.published("export_usd"), []
    for folder in (export / "plates", export / "renders", export / "views"):
        _check_own(run, folder)
    frames = _numbers(export / "renders", ".exr")
    shown = frames[len(frames) // 2] if frames else next(iter(_numbers(export / "plates", ".jpg")), None)
    plate = export / "plates" / f"{shown:04d}.jpg" if shown is not None else None
    if plate and plate.is_file():
        found.append((f"frame {shown}", _uri(_picture(plate.with_name("%04d.jpg"), shown))))
    to_rec709 = np.linalg.inv(acescg_from_rec709(np.eye(3))) if _is_acescg(export) else None
    if frames:
        found.append((f"re-render of frame {shown}", _uri(_linear(export / "renders" / f"{shown:04d}.exr", to_rec709))))
    view = export / "views" / f"novel_{SIDE_VIEW}.exr"
    if view.is_file():
        found.append(("another view", _uri(_linear(view, to_rec709))))
    return found


def crop_pictures(run: RunFolder) -> list[tuple[str, str]]:
    """The same of a subject that got no further than its first stage, or of the first of its clips."""
    folders = [clip.published("sample_frames") for clip in run.clips()] or [run.published("sample_frames")]
    _check_own(run, folders[0] / "frames")
    frames = _numbers(folders[0] / "frames", ".png")
    if not frames:
        return []
    shown = frames[len(frames) // 2]
    return [("crop", _uri(_picture(folders[0] / "frames" / "%06d.png", shown)))]


def _check_own(run: RunFolder, folder: Path) -> None:
    """InputError where the folder, or a file in it, is a link that leads out of the subject's results."""
    root = run.root.resolve()
    for path in (folder, *(path for path in folder.glob("*") if path.is_symlink())):
        if not path.resolve().is_relative_to(root):
            raise InputError("a link that leads elsewhere", where=str(path))


def _numbers(folder: Path, suffix: str) -> list[int]:
    """Numbers of the files that are named by one."""
    return sorted(int(path.stem) for path in folder.glob(f"*{suffix}") if path.stem.isascii() and path.stem.isdigit())


def _is_acescg(export: Path) -> bool:
    manifest = read_manifest(export)
    return manifest is not None and manifest["parameters"].get("acescg") is True


def _picture(pattern: Path, number: int) -> np.ndarray:
    """One of the numbered pictures, uint8 RGB; measured by its header before it is decoded."""
    reader = ImageSequenceReader(pattern)
    first = _numbers(pattern.parent, pattern.suffix)[0]
    for frame in reader.frames([number - first]):
        if not frame.fault:
            codes = frame.codes()
            return codes if codes.dtype == np.uint8 else (codes >> 8).astype(np.uint8)
    raise InputError("a picture that cannot be read", where=str(pattern), got=number)


def _linear(path: Path, to_rec709: np.ndarray | None) -> np.ndarray:
    """An EXR of a head before nothing, cut to the head, as uint8 sRGB."""
    check_size(*exr_size(path), str(path))
    linear = read_exr(path)
    if linear.ndim != 3:
        raise InputError("not a picture in colour", where=str(path))
    seen = np.nonzero((linear > 0).any(-1))
    if seen[0].size:
        (top, left), (bottom, right) = ([int(getattr(axis, edge)()) for axis in seen] for edge in ("min", "max"))
        linear = linear[top:bottom + 1, left:right + 1]
    return srgb_bytes(shrunk(linear if to_rec709 is None else linear @ to_rec709.astype(np.float32), EDGE_PX))


def _uri(picture: np.ndarray) -> str:
    return jpeg_uri(np.ascontiguousarray(shrunk(picture, EDGE_PX)), quality=80)


PICTURE_ERRORS = (InputError, OSError, ValueError, cv2.error)
"""What reading a damaged picture may raise."""
