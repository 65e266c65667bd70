"""The command line of tools/relight/command.py: what can be asked for, and what is out of range."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from shared.errors import InputError
from shared.rendering.studio_lights import STUDIO_LIGHTS
from shared.rendering.view_set import ROUGHNESSES

TURNS = ("head", "camera", "light")
CLAY = {"albedo": (0.55, 0.55, 0.55), "specular": 1.0, "roughness": 0.3}
"""What meshes are made of unless told otherwise."""


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
        raise InputError(message, where="tools.relight", hint="see --help")


def parser(description: str) -> argparse.ArgumentParser:
    """The command line."""
    found = _Parser(
        prog="python -m tools.relight", description=description, formatter_class=argparse.RawDescriptionHelpFormatter
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
    found.add_argument("--directions", type=int, default=1536,
                       help="over the sphere (default 1536); 4096 for narrow lobes")
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
        raise InputError("videos have even sizes", where="--size", got=options.size, hint="add one")
