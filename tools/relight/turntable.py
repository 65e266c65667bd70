"""What a result looks like, to show to others: the head turning under three lights, a light turning about the head, and
a sheet of its maps. Where the gaze is known the eyes do as they did in the clip: stay on the camera, or go with the
head.

Two videos (H.264 in MP4, see video.py) and a PNG in a folder beside the export, with a record of what they show. What
the record says to be of this export and these settings is not made again; a file that is not as the record has it is
another's, and is not written over.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from shared.contract.hashing import hash_file
from shared.contract.manifest import read_record
from shared.errors import InputError
from shared.geometry.eyeballs import gaze_towards
from shared.geometry.transforms import camera_centres, world_from_head
from shared.io.arrays import write_json
from shared.io.export_maps import MAPS
from shared.io.exr_picture import read_rec709
from shared.io.images import write_png
from shared.io.material_maps import read_material
from shared.rendering.precomputed_transfer import Sizes
from shared.rendering.studio_lights import studio_light
from shared.rendering.views import HeadViews, ViewCamera, light_in_head_space, orbit_camera
from shared.report.page import TURNTABLE
from shared.report.pictures import srgb_bytes
from tools.relight.inputs import Asset, open_asset, turned_head, turned_light
from tools.relight.map_sheet import map_sheet
from tools.relight.options import CLAY
from tools.relight.video import write_video

LIGHTS = ("window", "low_sun", "two_lamps")
"""Under which the head turns, from left to right."""
TURNING_LIGHT = "low_sun"
HEAD, LIGHT, SHEET = TURNTABLE
RECORD = "turntable.json"
RANGES = {"size": (64, 2048), "frames": (2, 2000), "fps": (1, 240)}
FARTHEST_GAZE, LEAST_TURN = np.radians([25.0, 1.0])
"""So far eyes follow a camera that goes round, if they did not look farther aside in the clip. Of a head that turned by
less than the second it is not known what its eyes do."""
_DIRECTIONS, _NODES = 768, 500
_AT_ONCE = 8
Progress = Callable[[Iterable, str, int], Iterable]


@dataclass(frozen=True)
class TurntableSettings:
    """size: edge of one picture, px; frames: of a whole turn."""

    size: int = 480
    frames: int = 72
    fps: int = 24


def check_settings(settings: TurntableSettings) -> None:
    """InputError for what is out of range."""
    for name, (low, high) in RANGES.items():
        value = getattr(settings, name)
        if not low <= value <= high:
            raise InputError("out of range", where=f"--{name}", got=value, expected=f"{low} .. {high}")
    if settings.size % 2:
        raise InputError("videos have even sizes", where="--size", got=settings.size, hint="add one")


def turntable_folder(export: Path) -> Path:
    """Where it is written: turntable/ beside export/, NAME_turntable/ beside an export of another name."""
    return export.parent / ("turntable" if export.name == "export" else f"{export.name}_turntable")


def write_turntable(export: Path, settings: TurntableSettings, progress: Progress) -> Iterator[str]:
    """Makes what is not there yet, and says so of each file.

    progress(items, label, total) wraps what takes long. InputError where the export cannot be read, or where a file of
    these names is not this command's own.
    """
    check_settings(settings)
    out, state = turntable_folder(export), _state_of(export, settings)
    files = _kept_files(out, state)
    makers = {SHEET: _write_sheet, HEAD: _write_head, LIGHT: _write_light}
    todo = [name for name in makers if name not in files]
    yield from (f"{out / name}: is there" for name in files)
    if not todo:
        return
    asset = open_asset(export, **CLAY)
    views = _views(asset, progress) if {HEAD, LIGHT} & {*todo} else None
    try:
        out.mkdir(exist_ok=True)
        for name in todo:
            new = out / f".new-{name}"
            makers[name](new, export, asset, views, settings, progress)
            files[name] = hash_file(new)
            (out / name).unlink(missing_ok=True)  # whenever this is cut off, no file is there that no record tells of
            write_json(out / RECORD, state | {"files": files})
            new.replace(out / name)
            yield f"{out / name}: written, {(out / name).stat().st_size / 1e6:.1f} MB"
    except OSError as error:
        raise InputError("cannot be written", where=str(error.filename or out), got=error.strerror) from error


def _state_of(export: Path, settings: TurntableSettings) -> dict:
    """What the pictures depend on: the files that they show, and the settings."""
    shown = [export / "mesh.obj", export / "poses.npz", *export.glob("hair.obj"),
             *sorted((export / "maps").glob("*.exr"))]
    if missing := [path for path in shown[:2] if not path.is_file()]:
        raise InputError("no export of a head", where=str(export), expected=missing[0].name)
    return {"export": {path.relative_to(export).as_posix(): hash_file(path) for path in shown}, **asdict(settings)}


def _kept_files(out: Path, state: dict) -> dict[str, str]:
    """{file: SHA-256} of what need not be made again. InputError where a file is not as this command left it."""
    record = read_record(out / RECORD) or {}
    recorded = record.get("files")
    recorded = recorded if isinstance(recorded, dict) else {}
    found = {name: hash_file(out / name) for name in (SHEET, HEAD, LIGHT) if (out / name).exists()}
    for name, digest in found.items():
        if recorded.get(name) != digest:
            raise InputError("not a file of this command, and not written over", where=str(out / name),
                             hint="move it elsewhere")
    return found if {key: record.get(key) for key in state} == state else {}


def _views(asset: Asset, progress: Progress) -> HeadViews:
    """The head, to be seen from all sides."""
    return HeadViews(
        asset.mesh, asset.maps, Sizes(directions=_DIRECTIONS, nodes=_NODES),
        progress=lambda items, label: progress(items, label, len(items) if hasattr(items, "__len__") else None),
        light_resolution=round((_DIRECTIONS / 6) ** 0.5),
        eyes=asset.eyes,
        head_faces=asset.head_faces,
    )


def _write_sheet(path: Path, export: Path, asset: Asset, views: HeadViews | None, *_) -> None:
    maps = {}
    for file in sorted((export / "maps").glob("*.exr")):
        if (name := file.name.partition(".")[0]) in MAPS:
            maps[name] = read_material(file) if name == "material" else read_rec709(file)
    write_png(path, map_sheet(maps))


def _write_head(
    path: Path, export: Path, asset: Asset, views: HeadViews, settings: TurntableSettings, progress: Progress
) -> None:
    angles = np.arange(settings.frames) * 360.0 / settings.frames
    pictures = (head_at(asset, views, angle, settings.size) for angle in progress(angles, HEAD, len(angles)))
    write_video(path, pictures, settings.fps)


def head_at(asset: Asset, views: HeadViews, yaw_deg: float, size: int) -> np.ndarray:
    """uint8 [size, 3 size, 3] sRGB: the head turned by yaw_deg to the picture's right before lights that stand still,
    one of LIGHTS in each third; size: edge of a third, px."""
    front = orbit_camera(asset.mesh, 0.0, 0.0, size)
    pose = turned_head(asset.mesh, front.camera_from_head, yaw_deg, 0.0)
    turn = world_from_head(pose[None], "head")[0]
    lights = [light_in_head_space(studio_light(name), turn) for name in LIGHTS]
    pictures = views.relit(lights, looking(asset, replace(front, camera_from_head=pose)))
    return np.hstack([srgb_bytes(picture) for picture in pictures])


def looking(asset: Asset, camera: ViewCamera) -> ViewCamera:
    """The camera with the eyes as they would look if it were the clip's: each eye's yaw is a line over the side from
    which the camera sees the head, of a slope from 0, eyes that go with the head, to 1, eyes on the camera."""
    if asset.eye_turn is None:
        return camera
    sides = gaze_towards(camera_centres(asset.poses))[:, 0]
    side = gaze_towards(camera_centres(camera.camera_from_head[None]))[0, 0]
    gaze = np.full((2, 2), np.nan)
    for k in range(2):
        is_open = np.isfinite(asset.eye_turn[:, k]).all(1)
        if is_open.any():
            own, (yaw, pitch) = sides[is_open], asset.eye_turn[is_open, k].T
            away = own - own.mean()
            slope = np.clip(away @ yaw / (away @ away + len(own) * LEAST_TURN**2), 0.0, 1.0)
            farthest = max(FARTHEST_GAZE, np.abs(yaw).max())
            gaze[k] = np.clip(yaw.mean() + slope * (side - own.mean()), -farthest, farthest), pitch.mean()
    return replace(camera, gaze=gaze)


def _write_light(
    path: Path, export: Path, asset: Asset, views: HeadViews, settings: TurntableSettings, progress: Progress
) -> None:
    def pictures() -> Iterator[np.ndarray]:
        camera = looking(asset, orbit_camera(asset.mesh, 0.0, 0.0, settings.size))
        light = studio_light(TURNING_LIGHT)
        starts = range(0, settings.frames, _AT_ONCE)
        for start in progress(starts, LIGHT, len(starts)):
            frames = range(start, min(start + _AT_ONCE, settings.frames))
            turned = [turned_light(light, k * 360.0 / settings.frames) for k in frames]
            yield from (srgb_bytes(picture) for picture in views.relit(turned, camera))

    write_video(path, pictures(), settings.fps)
