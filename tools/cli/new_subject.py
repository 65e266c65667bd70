"""`limn new CLIP`: a subject folder from a video or an image sequence."""

from __future__ import annotations

import os
import re
import shutil
from dataclasses import dataclass
from pathlib import Path

from shared.contract.confine import trust
from shared.contract.subject import is_sequence, load_subject
from shared.errors import InputError

_TEMPLATE = """\
# A subject for limn. All lengths in millimetres.
video: {video}   # or an image sequence: frames/%05d.png

# The lens: {{focal_length_mm: 60, sensor_width_mm: 22.3}} or {{focal_length_px: 5166}} (pixels of the source frame).
# Known values make the head's size in depth right; left out, the focal length is estimated, and said so.
{camera}

# How the file's numbers encode light: srgb | bt709 | linear
colour: {{transfer: {transfer}}}

# head: camera and light stand still, the head turns. camera: head and light still, the camera is carried around.
capture: {{moves: {moves}}}

# How far the pupils are apart when they look far away sets the head's size; left out, irises and a mean head do:
# head: {{pupil_distance_mm: 63}}

# A 24-patch colour chart in view is found by itself; by hand, or to leave it out:
# chart: {{frame: 0, corners: [[x, y], [x, y], [x, y], [x, y]]}}   # or off

# A place on a grey wall or card, in the light of the face, tells the light's tint (px; not where the camera moves):
# grey: [x, y]
"""


@dataclass(frozen=True)
class NewSubject:
    """What `limn new` was told."""

    clip: Path
    name: str | None = None
    parent: Path = Path(".")
    link: bool = False
    focal_length_mm: float | None = None
    sensor_width_mm: float | None = None
    focal_length_px: float | None = None
    transfer: str = "srgb"
    moves: str = "head"


def make_subject(new: NewSubject) -> tuple[Path, str]:
    """Makes the folder; returns it and a sentence about the clip. InputError leaves nothing behind."""
    from shared.io.video import probe

    if new.link:
        trust([Path(os.path.realpath(new.clip.parent))])
    info = probe(new.clip)
    name = new.name or (new.clip.parent.name if is_sequence(new.clip.name) else new.clip.stem)
    name = re.sub(r"[^\w.-]+", "_", name).strip("._") or "subject"
    folder = Path(os.path.abspath(new.parent / name))
    if folder.exists():
        raise InputError("the folder exists already", where=str(folder), hint="choose another with --name")
    partial = folder.with_name(f".{name}.tmp-{os.getpid()}")
    partial.mkdir(parents=True)
    try:
        video = _take_clip(new, partial)
        text = _TEMPLATE.format(video=_quoted(video), camera=_camera(new), transfer=new.transfer, moves=new.moves)
        (partial / "subject.yaml").write_text(text, encoding="utf-8")
        load_subject(partial)
        partial.rename(folder)
    except InputError as error:
        raise InputError(error.what, where=error.where.replace(str(partial), str(folder)), got=error.got,
                         expected=error.expected, hint=error.hint) from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return folder, f"{info.width} x {info.height}, {info.frame_count} frames at {info.fps:g} frames a second"


def _take_clip(new: NewSubject, folder: Path) -> str:
    """Copies or links the clip into the folder; returns its path there."""
    if not is_sequence(new.clip.name):
        place = f"clip{new.clip.suffix.lower()}"
        _take(new.clip, folder / place, new.link)
        return place
    (folder / "frames").mkdir()
    pattern = re.compile(re.sub(r"%0?\d*d", r"\\d+", re.escape(new.clip.name).replace(r"\%", "%")))
    for path in sorted(new.clip.parent.iterdir()):
        if path.is_file() and pattern.fullmatch(path.name):
            _take(path, folder / "frames" / path.name, new.link)
    return f"frames/{new.clip.name}"


def _take(source: Path, target: Path, link: bool) -> None:
    if link:
        target.symlink_to(source.resolve())
    else:
        shutil.copyfile(source, target)


def _camera(new: NewSubject) -> str:
    values = {"focal_length_mm": new.focal_length_mm, "sensor_width_mm": new.sensor_width_mm,
              "focal_length_px": new.focal_length_px}
    given = ", ".join(f"{name}: {value:g}" for name, value in values.items() if value is not None)
    return f"camera: {{{given}}}" if given else "# camera: {focal_length_mm: , sensor_width_mm: }"


def _quoted(text: str) -> str:
    return text if re.fullmatch(r"[\w./-]+", text) else "'" + text.replace("'", "''") + "'"
