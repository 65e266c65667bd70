"""A solved head, or any mesh, under any light: stills and videos, and pictures of what it covers of itself.

    python -m tools.relight RESULT --light studio.hdr --out DIR                      the head from the front
    python -m tools.relight RESULT --light window --frames 0,40,80 --out DIR         in the poses of the clip
    python -m tools.relight RESULT --light sky.exr --turntable 72 --video turn.mp4 --out DIR
    python -m tools.relight statue.obj --light low_sun --roughness 0.15 --specular 12 --visibility --out DIR

RESULT   a run's folder, its export/ or work/inverse_render/; or a mesh (.obj, .npz; .glb, .ply, .stl with trimesh).
Lights   lat-long .hdr or .exr (twice as wide as high, +y on top, +z, to the camera, in the middle), a studio light
         by name, or "clip": the recovered light. It stands still before the camera; the head turns.
Writes   one picture per view and light, linear .exr or sRGB .png, or a video per light; visibility_ROUGHNESS.png:
         the share V~ of the highlight's lobe that the mesh leaves open, from 0 (black) to 1 (white).
Method   the solver's own renderer: traced visibility, diffuse bounces, highlights as sums over the directions; those
         too narrow for that by the split sum, modulated by V~. More --directions, sharper shadows and reflections.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from shared.color import encode_srgb
from shared.envmap import latlong_lookup
from shared.errors import InputError
from shared.geometry import WORLD_FROM_CAMERA
from shared.io.images import write_exr, write_png
from shared.raycast import pixel_directions
from shared.shading import DEEP
from shared.solve.capture import Sizes
from shared.solve.views import Camera, HeadViews, orbit_camera
from shared.studio_lights import STUDIO_LIGHTS
from shared.view_set import ROUGHNESSES
from tools.relight_inputs import Asset, open_asset, read_light, turned_head, turned_light
from tools.relight_video import write_video

AT_ONCE = 16
TURNS = ("head", "camera", "light")
CLAY = {"albedo": (0.55, 0.55, 0.55), "specular": 1.0, "roughness": 0.3}
"""What meshes are made of unless told otherwise."""


@dataclass(frozen=True)
class Shot:
    """One picture: its file's stem, camera, how far the light is turned, and what moves against the light."""

    stem: str
    camera: Camera
    light_yaw_deg: float
    moves: str


def plan_shots(asset: Asset, options: argparse.Namespace) -> list[Shot]:
    """What is to be seen, in order. InputError where the clip has no such frame."""
    if options.frames:
        return [_clip_shot(asset, frame, options) for frame in options.frames]
    turns = [(i * 360.0 / options.turntable, 0.0) for i in range(options.turntable or 0)]
    return [_turned_shot(asset, i, *turn, options) for i, turn in enumerate(turns or options.view or [(0.0, 0.0)])]


def _turned_shot(asset: Asset, i: int, yaw: float, pitch: float, options: argparse.Namespace) -> Shot:
    stem = f"{i:04d}" if options.turntable else f"yaw{yaw:+.0f}_pitch{pitch:+.0f}"
    front = orbit_camera(asset.mesh, 0.0, 0.0, options.size)
    if options.turn == "camera":
        return Shot(stem, orbit_camera(asset.mesh, yaw, pitch, options.size), options.light_yaw, "camera")
    if options.turn == "light":
        return Shot(stem, front, options.light_yaw + yaw, "head")
    pose = turned_head(asset.mesh, front.camera_from_head, yaw, pitch)
    return Shot(stem, Camera(pose, front.intrinsics, front.size), options.light_yaw, "head")


def _clip_shot(asset: Asset, frame: int, options: argparse.Namespace) -> Shot:
    """A frame of the clip through its own lens, whose axis is taken for the picture's middle."""
    if asset.poses is None:
        raise InputError("a mesh has no frames", where="--frames", mend="use --view or --turntable")
    found = np.nonzero(asset.frame_index == frame)[0]
    if len(found) == 0:
        low, high = int(asset.frame_index.min()), int(asset.frame_index.max())
        raise InputError(
            "no pose of this frame", where="--frames", got=frame, expected=f"solved frames, {low} .. {high}"
        )
    scale = options.size / (2.0 * asset.intrinsics[1, 2])
    width = 2 * round(asset.intrinsics[0, 2] * scale)
    lens = np.diag([scale, scale, 1.0]) @ asset.intrinsics
    return Shot(
        f"frame{frame:06d}", Camera(asset.poses[found[0]], lens, (width, options.size)), options.light_yaw, asset.moves
    )


def render_shots(
    views: HeadViews, shots: list[Shot], light: np.ndarray, background: np.ndarray | str
) -> Iterator[np.ndarray]:
    """Linear pictures [h, w, 3] in order. background: a colour [3], or "environment"."""
    for start in range(0, len(shots), AT_ONCE):
        part = shots[start : start + AT_ONCE]
        same = len({(shot.light_yaw_deg, shot.moves) for shot in part}) == 1
        for group in [part] if same else [[shot] for shot in part]:
            seen = turned_light(light, group[0].light_yaw_deg)
            cameras = [shot.camera for shot in group]
            pictures = views.render(seen, cameras, group[0].moves)
            for shot, picture in zip(group, pictures, strict=True):
                yield picture + _behind(views, shot, seen, background)


def _behind(views: HeadViews, shot: Shot, light: np.ndarray, background: np.ndarray | str) -> np.ndarray:
    """What shows beside the head: [h, w, 3], 0 where the head covers the pixel."""
    camera = shot.camera
    colour = background
    if isinstance(background, str):
        rotation = WORLD_FROM_CAMERA if shot.moves == "head" else camera.camera_from_head[:3, :3].T
        rays = pixel_directions(camera.intrinsics, *camera.size) @ rotation.T
        colour = latlong_lookup(light, rays / np.linalg.norm(rays, axis=-1, keepdims=True))
    return (1.0 - views.coverage(camera))[..., None] * colour


def save_pictures(
    out: Path, name: str, shots: list[Shot], pictures: Iterator[np.ndarray], options: argparse.Namespace
) -> list[Path]:
    """Stills or a video of one light -> the files."""
    exposed = (picture * 2.0**options.exposure for picture in pictures)
    if options.video:
        path = out / (options.video if options.single else f"{Path(options.video).stem}_{name}.mp4")
        write_video(path, (_coded(picture) for picture in exposed), options.fps)
        return [path]
    written = []
    for shot, picture in zip(shots, exposed, strict=True):
        path = out / f"{name}_{shot.stem}.{options.format}"
        if options.format == "exr":
            write_exr(path, picture.astype(np.float32), colour_space="lin_rec709_scene")
        else:
            write_png(path, _coded(picture))
        written.append(path)
    return written


def _coded(picture: np.ndarray) -> np.ndarray:
    return np.round(encode_srgb(np.clip(picture, 0.0, 1.0)) * 255.0).astype(np.uint8)


def save_visibility(out: Path, views: HeadViews, camera: Camera, roughnesses: list[float]) -> list[Path]:
    """V~ as grey pictures, mid blue beside the mesh."""
    written = []
    for roughness in roughnesses:
        share = views.visibility(camera, roughness)
        grey = np.round(255.0 * np.nan_to_num(share)).astype(np.uint8)
        picture = np.where(np.isnan(share)[..., None], np.uint8([40, 60, 90]), grey[..., None].repeat(3, 2))
        written.append(out / f"visibility_{roughness:.2f}.png")
        write_png(written[-1], picture)
    return written


def _numbers(count: int):
    """A parser of count comma-separated numbers; any number of them where count is 0."""

    def parse(text: str) -> tuple[float, ...]:
        values = tuple(float(part) for part in text.split(","))
        if count and len(values) != count or not np.isfinite(values).all():
            raise ValueError(text)
        return values

    parse.__name__ = f"{count} numbers" if count else "numbers"
    return parse


def _frames(text: str) -> list[int]:
    return [int(part) for part in text.split(",")]


def _background(text: str) -> np.ndarray | str:
    """environment, none, or r,g,b in linear light."""
    return text if text == "environment" else np.array((0.0,) * 3 if text == "none" else _numbers(3)(text))


class _Parser(argparse.ArgumentParser):
    """Faults of the command line as one line."""

    def error(self, message: str):
        raise InputError(message, where="tools.relight", mend="see --help")


def parser() -> argparse.ArgumentParser:
    """The command line."""
    found = _Parser(
        prog="python -m tools.relight", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    found.add_argument("asset", type=Path, metavar="RESULT", help="a result's folder, or a mesh")
    found.add_argument(
        "--light",
        nargs="+",
        default=list(STUDIO_LIGHTS),
        metavar="LIGHT",
        help=f"files, clip, or {', '.join(STUDIO_LIGHTS)} (default: these four)",
    )
    found.add_argument("--out", type=Path, required=True, help="folder for the pictures; made if need be")
    what = found.add_mutually_exclusive_group()
    what.add_argument(
        "--frames", type=_frames, metavar="N,N", help="frames of the clip, in its poses and through its lens"
    )
    what.add_argument(
        "--view",
        type=_numbers(2),
        action="append",
        metavar="YAW,PITCH",
        help="degrees to the picture's right and upwards (default 0,0); may be repeated; negative: --view=-30,0",
    )
    what.add_argument("--turntable", type=int, metavar="N", help="a full turn in N pictures")
    found.add_argument("--turn", choices=TURNS, default="head", help="what turns by these angles (default: the head)")
    found.add_argument(
        "--light-yaw", type=float, default=0.0, metavar="DEG", help="turns the light to the picture's right"
    )
    found.add_argument(
        "--background",
        type=_background,
        default=np.zeros(3),
        metavar="WHAT",
        help="environment, none (default), or a linear colour r,g,b",
    )
    found.add_argument("--size", type=int, default=720, metavar="PX", help="height of the pictures (default 720)")
    found.add_argument("--exposure", type=float, default=0.0, metavar="STOPS", help="brightens by 2^STOPS")
    found.add_argument("--format", choices=("png", "exr"), default="png")
    found.add_argument("--video", metavar="NAME.mp4", help="a video instead of stills; one per light")
    found.add_argument("--fps", type=int, default=24)
    found.add_argument(
        "--visibility",
        type=float,
        nargs="*",
        metavar="ROUGHNESS",
        help=f"pictures of V~ of the first view (default {' '.join(map(str, ROUGHNESSES))})",
    )
    found.add_argument("--directions", type=int, default=1536, help="over the sphere (default 1536); 4096 for gloss")
    found.add_argument("--albedo", type=_numbers(3), metavar="R,G,B", help="of a mesh, linear (default .55,.55,.55)")
    found.add_argument("--specular", type=float, help="of a mesh: 1 (default) reflects 4 %% head-on")
    found.add_argument("--roughness", type=float, help="of a mesh, 0.05 to 1 (default 0.3)")
    return found


def check_options(options: argparse.Namespace) -> None:
    """InputError for what argparse lets through."""
    ranges = {
        "size": (16, 4096),
        "fps": (1, 240),
        "directions": (128, 16384),
        "roughness": (0.05, 1.0),
        "specular": (0.0, 100.0),
        "turntable": (2, 2000),
        "exposure": (-20, 20),
    }
    for name, (low, high) in ranges.items():
        value = getattr(options, name)
        if value is not None and not low <= value <= high:
            raise InputError("out of range", where=f"--{name}", got=value, expected=f"{low} .. {high}")
    if any(not 0.05 <= value <= 1.0 for value in options.visibility or ()):
        raise InputError("out of range", where="--visibility", got=options.visibility, expected="0.05 .. 1")
    if not all(0.0 <= value <= 1.0 for value in options.albedo or ()):
        raise InputError("out of range", where="--albedo", got=options.albedo, expected="0 .. 1")
    if options.video and (Path(options.video).suffix != ".mp4" or Path(options.video).name != options.video):
        raise InputError(
            "not the name of a video", where="--video", got=options.video, expected="NAME.mp4, put into --out"
        )
    if options.video and options.size % 2:
        raise InputError("videos have even sizes", where="--size", got=options.size, mend="add one")


def run(options: argparse.Namespace) -> list[Path]:
    """Everything that was asked for -> the files that were written."""
    check_options(options)
    given = {name: getattr(options, name) for name in CLAY if getattr(options, name) is not None}
    if given and options.asset.is_dir():
        raise InputError(
            "a result has maps of its own", where=f"--{next(iter(given))}", mend="leave it out, or name a mesh"
        )
    asset = open_asset(options.asset, **{**CLAY, **given})
    lights = {Path(name).stem: read_light(name, asset) for name in options.light}
    shots = plan_shots(asset, options)
    options.single = len(lights) == 1
    sizes = Sizes(directions=options.directions, nodes=600)
    # A fitted head says little about its own cavities; a mesh that was given is taken at its word.
    deep = DEEP if asset.poses is not None else 1.01
    views = HeadViews(
        asset.mesh,
        asset.maps,
        sizes,
        [shot.camera for shot in shots],
        light_resolution=max(8, round((options.directions / 6) ** 0.5)),
        deep=deep,
    )
    try:
        options.out.mkdir(parents=True, exist_ok=True)
        written = []
        for name, light in lights.items():
            written += save_pictures(
                options.out, name, shots, render_shots(views, shots, light, options.background), options
            )
        if options.visibility is not None:
            written += save_visibility(options.out, views, shots[0].camera, options.visibility or list(ROUGHNESSES))
    except OSError as error:
        raise InputError("cannot be written", where=str(error.filename or options.out), got=error.strerror) from error
    return written


def main(arguments: list[str] | None = None) -> int:
    """Exit code 0, or 2 when the input is at fault."""
    try:
        for path in run(parser().parse_args(arguments)):
            print(path)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
