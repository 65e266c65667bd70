"""A solved head, or any mesh, under any light: stills and videos, and pictures of what it covers of itself.

    python -m tools.relight RESULT --light studio.hdr --out DIR                      the head from the front
    python -m tools.relight RESULT --light window --frames 0,40,80 --out DIR         as in the clip: pose, eyes, lids
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

from shared.errors import InputError, refused
from shared.geometry.eyeballs import gaze_between
from shared.geometry.raycast import pixel_directions
from shared.geometry.transforms import WORLD_FROM_CAMERA
from shared.imaging.color import encode_srgb
from shared.io.images import write_exr, write_png
from shared.rendering.envmap import latlong_lookup
from shared.rendering.precomputed_transfer import Sizes
from shared.rendering.shading import DEEP
from shared.rendering.view_set import ROUGHNESSES
from shared.rendering.views import HeadViews, ViewCamera, orbit_camera
from tools.relight.inputs import Asset, open_asset, read_light, turned_head, turned_light
from tools.relight.options import CLAY, check_options, parser
from tools.relight.video import write_video

AT_ONCE = 16


@dataclass(frozen=True)
class RelightShot:
    """One picture: its file's stem, camera, how far the light is turned, and what moves against the light."""

    stem: str
    camera: ViewCamera
    light_yaw_deg: float
    moves: str


def plan_shots(asset: Asset, options: argparse.Namespace) -> list[RelightShot]:
    """What is to be seen, in order. InputError where the clip has no such frame."""
    if options.frames:
        return [_clip_shot(asset, frame, options) for frame in options.frames]
    turns = [(i * 360.0 / options.turntable, 0.0) for i in range(options.turntable or 0)]
    return [_turned_shot(asset, i, *turn, options) for i, turn in enumerate(turns or options.view or [(0.0, 0.0)])]


def _turned_shot(asset: Asset, i: int, yaw: float, pitch: float, options: argparse.Namespace) -> RelightShot:
    stem = f"{i:04d}" if options.turntable else f"yaw{yaw:+.0f}_pitch{pitch:+.0f}"
    front = orbit_camera(asset.mesh, 0.0, 0.0, options.size)
    if options.turn == "camera":
        return RelightShot(stem, orbit_camera(asset.mesh, yaw, pitch, options.size), options.light_yaw, "camera")
    if options.turn == "light":
        return RelightShot(stem, front, options.light_yaw + yaw, "head")
    pose = turned_head(asset.mesh, front.camera_from_head, yaw, pitch)
    return RelightShot(stem, ViewCamera(pose, front.intrinsics, front.size), options.light_yaw, "head")


def _clip_shot(asset: Asset, frame: int, options: argparse.Namespace) -> RelightShot:
    """A frame of the clip through its own lens, whose axis is taken for the picture's middle, with eyes and lids as
    they are in it."""
    if asset.poses is None:
        raise InputError("a mesh has no frames", where="--frames", hint="use --view or --turntable")
    found = np.nonzero(asset.frame_index == frame)[0]
    if len(found) == 0:
        low, high = int(asset.frame_index.min()), int(asset.frame_index.max())
        raise InputError(
            "no pose of this frame", where="--frames", got=frame, expected=f"solved frames, {low} .. {high}"
        )
    scale = options.size / (2.0 * asset.intrinsics[1, 2])
    width = 2 * round(asset.intrinsics[0, 2] * scale)
    lens = np.diag([scale, scale, 1.0]) @ asset.intrinsics
    f = found[0]
    # Eyes that shut lids may leave open a little look as they do before and after.
    gaze = None if asset.eye_turn is None else gaze_between(asset.eye_turn)[f]
    shut, pitch = (None if moved is None else moved[f] for moved in (asset.shut, asset.pitch))
    camera = ViewCamera(asset.poses[f], lens, (width, options.size), gaze, lids=shut, pitch=pitch)
    return RelightShot(f"frame{frame:06d}", camera, options.light_yaw, asset.moves)


def render_shots(
    views: HeadViews, shots: list[RelightShot], light: np.ndarray, background: np.ndarray | str
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


def _behind(views: HeadViews, shot: RelightShot, light: np.ndarray, background: np.ndarray | str) -> np.ndarray:
    """What shows beside the head: [h, w, 3], 0 where the head covers the pixel."""
    camera = shot.camera
    colour = background
    if isinstance(background, str):
        rotation = WORLD_FROM_CAMERA if shot.moves == "head" else camera.camera_from_head[:3, :3].T
        rays = pixel_directions(camera.intrinsics, *camera.size) @ rotation.T
        colour = latlong_lookup(light, rays / np.linalg.norm(rays, axis=-1, keepdims=True))
    return (1.0 - views.coverage(camera))[..., None] * colour


def save_pictures(
    out: Path, name: str, shots: list[RelightShot], pictures: Iterator[np.ndarray], options: argparse.Namespace
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


def save_visibility(out: Path, views: HeadViews, camera: ViewCamera, roughnesses: list[float]) -> list[Path]:
    """V~ as grey pictures, mid blue beside the mesh."""
    written = []
    for roughness in roughnesses:
        share = views.visibility(camera, roughness)
        grey = np.round(255.0 * np.nan_to_num(share)).astype(np.uint8)
        picture = np.where(np.isnan(share)[..., None], np.uint8([40, 60, 90]), grey[..., None].repeat(3, 2))
        written.append(out / f"visibility_{roughness:.2f}.png")
        write_png(written[-1], picture)
    return written


def run(options: argparse.Namespace) -> list[Path]:
    """Everything that was asked for -> the files that were written."""
    check_options(options)
    given = {name: getattr(options, name) for name in CLAY if getattr(options, name) is not None}
    if given and options.asset.is_dir():
        raise InputError(
            "a result has maps of its own", where=f"--{next(iter(given))}", hint="leave it out, or name a mesh"
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
        eyes=asset.eyes,
        lids=asset.lids,
        head_faces=asset.head_faces,
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
        for path in run(parser(__doc__).parse_args(arguments)):
            print(path)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        print(f"error: {refused(error)}", file=sys.stderr)
        return 2
    return 0
