"""A subject: the folder with the clip, or several of one head, and subject.yaml."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path

from shared.contract.chart_place import AUTO, ChartPlace, parse_chart
from shared.contract.confine import check_link, inside
from shared.contract.declare import Parameter
from shared.contract.grey_place import parse_grey
from shared.contract.wording import Anything, check_keys, nearest, read_yaml, unknown_name
from shared.errors import InputError, shown

TRANSFERS = ("srgb", "bt709", "linear")
MOVES = ("head", "camera")
GIVEN = ("landmarks", "poses")
"""Files that a user may bring from another tracker."""
MOST_CLIPS = 8
LARGEST_BYTES = 1 << 36
MOST_FILES = 100_000

_COUNTER = re.compile(r"%(?:0?(\d+))?d")
_CAMERA = (
    Parameter("focal_length_mm", float, None, "Focal length of the lens.", "mm", 1.0, 5000.0),
    Parameter("sensor_width_mm", float, None, "Width of the sensor's used part.", "mm", 1.0, 500.0),
    Parameter("focal_length_px", float, None, "Focal length in pixels of the source frame.", "px", 10.0, 1e6),
)
_HEAD = (
    Parameter("pupil_distance_mm", float, None, "Distance of the pupils of eyes that look far away.", "mm", 40.0, 90.0),
)
_CLIP_NAME = re.compile(r"[a-z][a-z0-9_]{0,31}\Z")
_OF_A_CLIP = ("video", "camera", "colour", "tracking", "chart", "grey")
_OF_ALL = ("clips", "capture", "head")
_NEW = "make a subject with: limn new CLIP"


@dataclass(frozen=True)
class Subject:
    """Facts of subject.yaml. video: absolute path of the file, or of an image sequence with a counter (%05d).

    focal_length_px: of the source frame; None with focal_length_mm also None means: estimate it. landmarks, poses:
    files of another tracker; hold_poses: whether its poses stay as they are. chart: where a colour chart is. grey: a
    grey place (x, y) px of the source frame, in the light of the face; None: none is named. pupil_distance_mm: of eyes
    that look far away, which sets the head's size; None: it is estimated. clips: of several clips of one head under
    different lights each as a subject of its own, named as in subject.yaml; all else is the first one's then.
    """

    folder: Path
    name: str
    video: Path
    focal_length_px: float | None = None
    focal_length_mm: float | None = None
    sensor_width_mm: float | None = None
    transfer: str = "srgb"
    moves: str = "head"
    landmarks: Path | None = None
    poses: Path | None = None
    hold_poses: bool = False
    chart: ChartPlace = AUTO
    grey: tuple[float, float] | None = None
    pupil_distance_mm: float | None = None
    clips: tuple[Subject, ...] = ()

    def content(self) -> dict[str, object]:
        """All that every stage depends on, independent of where the folder lies."""
        keys = ("focal_length_px", "focal_length_mm", "sensor_width_mm", "transfer", "moves")
        own: dict[str, object] = {key: getattr(self, key) for key in keys}
        if self.pupil_distance_mm is not None:
            own["pupil_distance_mm"] = self.pupil_distance_mm
        return own | {"clips": [[clip.name, clip.content()] for clip in self.clips]} if self.clips else own

    def clip(self, name: str, where: str) -> Subject:
        """The clip of that name; InputError where there is none. where: what names it."""
        for clip in self.clips:
            if clip.name == name:
                return clip
        if not self.clips:
            raise InputError("this subject has one clip", where=where, got=name, hint="leave the name out")
        raise unknown_name("clip", name, [clip.name for clip in self.clips], where)

    def video_name(self) -> str:
        """The video's path inside the folder."""
        return self.video.relative_to(self.folder).as_posix()

    def video_files(self) -> list[Path]:
        """The file, or the files of the image sequence in order; empty where there is none."""
        if not is_sequence(self.video.name):
            return [self.video] if self.video.is_file() else []
        pattern = re.compile(_number_pattern(self.video.name))
        numbered = [(pattern.fullmatch(path.name), path) for path in _listing(self.video.parent)]
        return [path for _, path in sorted((int(m.group(1)), path) for m, path in numbered if m)]


def is_sequence(name: str) -> bool:
    """Whether a file name holds a printf counter."""
    return _COUNTER.search(name) is not None


def _number_pattern(name: str) -> str:
    counter = _COUNTER.search(name)
    return re.escape(name[: counter.start()]) + r"(\d+)" + re.escape(name[counter.end():])


def _listing(folder: Path) -> list[Path]:
    return [path for path in folder.iterdir() if path.is_file()] if folder.is_dir() else []


def load_subject(folder: Path) -> Subject:
    """Reads and checks folder/subject.yaml and that the video is there; InputError otherwise."""
    try:
        return _load(Path(folder).absolute())
    except OSError as error:
        raise InputError("cannot be read", where=str(error.filename or folder), got=error.strerror) from error


def _load(folder: Path) -> Subject:
    path = folder / "subject.yaml"
    if not folder.is_dir():
        raise InputError("no such folder", where=str(folder), hint=_NEW)
    if not path.is_file():
        raise InputError("no subject.yaml in this folder", where=str(folder), hint=_NEW)
    name = folder.resolve().name
    if not name.isprintable() or not name:
        raise InputError("the folder's name cannot be used", where=str(folder), expected="printable letters in UTF-8",
                         hint="rename it")
    check_link(path, folder)
    content = check_keys(read_yaml(path), (*_OF_A_CLIP, *_OF_ALL), str(path))
    capture = check_keys(content.get("capture"), ("moves",), f"{path}: capture")
    moves = _choice(capture.get("moves", "head"), MOVES, f"{path}: capture.moves")
    if content.get("clips") is None:
        return _clip(folder, name, content, moves, f"{path}: ")
    clips = tuple(_clip(folder, key, given, moves, f"{path}: clips.{key}.") for key, given in _clips(content, path))
    videos = [clip.video for clip in clips]
    for clip in clips:
        if videos.count(clip.video) > 1:
            raise InputError("two clips of one video", where=f"{path}: clips.{clip.name}.video", got=clip.video_name(),
                             hint="give each clip a video of its own")
    return replace(clips[0], name=name, clips=clips)


def _clips(content: dict, path: Path) -> list[tuple[str, dict]]:
    """Names and settings of the clips; what they leave out of camera and colour the whole subject says."""
    where = f"{path}: clips"
    for key in ("video", "tracking", "chart", "grey"):
        if content.get(key) is not None:
            raise InputError(f"both {key} and clips", where=str(path),
                             hint=f"move {key} to where it belongs: clips: {{NAME: {{{key}: ...}}}}")
    named = check_keys(content["clips"], Anything(), where)
    for name in named:
        if not isinstance(name, str) or not _CLIP_NAME.match(name):
            raise InputError("not a clip's name", where=where, got=shown(name), expected="a short name in snake_case")
    if not 2 <= len(named) <= MOST_CLIPS:
        raise InputError("number of clips not allowed", where=where, got=len(named), expected=f"2 .. {MOST_CLIPS}",
                         hint="name one clip as video: FILE, without clips")
    common = {key: content[key] for key in ("camera", "colour", "head") if content.get(key) is not None}
    return [(name, common | check_keys(own, _OF_A_CLIP, f"{where}.{name}")) for name, own in named.items()]


def _clip(folder: Path, name: str, content: dict, moves: str, where: str) -> Subject:
    """One clip with all that is known of it. where: what stands before the keys in messages."""
    camera = _camera(check_keys(content.get("camera"), [p.name for p in _CAMERA], f"{where}camera"), f"{where}camera")
    colour = check_keys(content.get("colour"), ("transfer",), f"{where}colour")
    video = _video(folder, content.get("video"), f"{where}video")
    transfer = _choice(colour.get("transfer", "srgb"), TRANSFERS, f"{where}colour.transfer")
    given = _tracking(folder, content.get("tracking"), f"{where}tracking")
    chart = parse_chart(content.get("chart"), f"{where}chart")
    grey = parse_grey(content.get("grey"), moves, f"{where}grey")
    head = check_keys(content.get("head"), [p.name for p in _HEAD], f"{where}head")
    head = {p.name: p.parse(head.get(p.name), f"{where}head.{p.name}") for p in _HEAD}
    subject = Subject(folder, name, video, transfer=transfer, moves=moves, chart=chart, grey=grey,
                      **camera, **given, **head)
    _check_files(subject)
    return subject


def _camera(given: dict, where: str) -> dict[str, float | None]:
    camera = {p.name: p.parse(given.get(p.name), f"{where}.{p.name}") for p in _CAMERA}
    if camera["focal_length_px"] is not None and camera["focal_length_mm"] is not None:
        raise InputError("both focal_length_px and focal_length_mm", where=where, hint="keep one of them")
    if camera["focal_length_mm"] is not None and camera["sensor_width_mm"] is None:
        raise InputError("focal_length_mm without sensor_width_mm", where=where,
                         hint="add sensor_width_mm (36 for 'full frame equivalent' lengths)")
    return camera


def _choice(value: object, known: tuple[str, ...], where: str) -> str:
    if not isinstance(value, str) or value not in known:
        raise InputError("value not known", where=where, got=shown(value),
                         expected=" | ".join(known), hint=nearest(shown(value).strip("'\"").lower(), known))
    return str(value)


def _tracking(folder: Path, given: object, where: str) -> dict[str, object]:
    """Files of another tracker, and whether its poses are held."""
    given = check_keys(given, (*GIVEN, "hold_poses"), where)
    files = {name: inside(folder, given[name], f"{where}.{name}") for name in GIVEN if given.get(name) is not None}
    for name, file in files.items():
        if not file.is_file() or file.stat().st_size == 0:
            raise InputError("no such file, or empty", where=f"{where}.{name}", got=given[name])
        check_link(file, folder)
        with open(file, "rb"):
            pass
    hold = given.get("hold_poses", False)
    if not isinstance(hold, bool):
        raise InputError("value not known", where=f"{where}.hold_poses", got=shown(hold), expected="true | false")
    if hold and "poses" not in files:
        raise InputError("hold_poses without poses", where=where, hint="add poses: FILE.npz, or leave hold_poses out")
    return {**files, "hold_poses": hold}


def _video(folder: Path, value: object, where: str) -> Path:
    """The video's absolute path; an image sequence has one counter, in the file's name."""
    if not isinstance(value, str) or not value.strip():
        raise InputError("no video named", where=where, expected="a file in the subject's folder, e.g. clip.mp4")
    file = inside(folder, value, where)
    if len(_COUNTER.findall(value)) > len(_COUNTER.findall(file.name)) or len(_COUNTER.findall(value)) > 1:
        raise InputError("more than one counter, or one in a folder's name", where=where, got=value,
                         expected="one in the file's name, e.g. frames/%05d.png")
    return file


def _check_files(subject: Subject) -> None:
    where = str(subject.video)
    files = subject.video_files()
    if not files:
        raise InputError("no such video", where=where, hint="correct 'video' in subject.yaml or put the file there")
    if len(files) > MOST_FILES:
        raise InputError("too many images", where=where, got=len(files), expected=f"{MOST_FILES} or fewer",
                         hint="cut out the head turn")
    total = 0
    for file in files:
        check_link(file, subject.folder)
        with open(file, "rb"):  # whether this user may read it
            size = file.stat().st_size
        total += size
        if size == 0:
            raise InputError("the file is empty", where=str(file), hint="copy it from the camera again")
    if total > LARGEST_BYTES:
        raise InputError("the clip is too large", where=where, got=f"{total / 1e9:.0f} GB",
                         expected=f"{LARGEST_BYTES / 1e9:.0f} GB or less", hint="cut out the head turn")
