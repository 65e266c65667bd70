"""subject.yaml, pipeline.yaml and folders that try something."""

from __future__ import annotations

import os
from pathlib import Path

from toy_video import write_video

from bad_inputs.cases import CAMERA, case
from bad_inputs.clips import head

BOMB = "".join(f"a{i + 1}: &a{i + 1} [{', '.join([f'*a{i}'] * 9)}]\n" for i in range(9))
BOMB = "a0: &a0 [lol, lol, lol]\n" + BOMB
CANARY = "canary"
"""A file of this name appears where something was executed that should not have been."""


def clip(folder):
    """A sound clip."""
    return write_video(folder / "clip.mp4", head())


def subject(text):
    """A maker of a subject with a sound clip and this subject.yaml."""
    def make(folder):
        clip(folder)
        data = text if isinstance(text, bytes) else text.encode()
        (folder / "subject.yaml").write_bytes(data)
    return make


SUBJECTS = {
    "unknown keys": (f"video: clip.mp4\n{CAMERA}lense: {{}}\n", "unknown key"),
    "a list for a mapping": ("video: clip.mp4\ncamera: [1, 2]\n", "not a mapping"),
    "a mapping for a name": ("video: {a: 1}\n", "no video named"),
    "text for a number": ("video: clip.mp4\ncamera: {focal_length_px: wide}\n", "a number"),
    "a date for a number": ("video: clip.mp4\ncamera: {focal_length_px: 2020-01-01}\n", "a number"),
    "NaN for a number": ("video: clip.mp4\ncamera: {focal_length_px: .nan}\n", "a number"),
    "infinity for a number": ("video: clip.mp4\ncamera: {focal_length_px: .inf}\n", "a number"),
    "a number beyond all floats": ("video: clip.mp4\ncamera: {focal_length_px: 1.0e+400}\n", "a number"),
    "a number of 40,000 digits": (f"video: clip.mp4\ncamera: {{focal_length_px: 0x{'f' * 40_000}}}\n", "a number"),
    "a grey place of 400 digits": (f"video: clip.mp4\n{CAMERA}grey: [{'9' * 400}, 2]\n", "not a number of pixels"),
    "a truth value that is none": ("video: clip.mp4\ncapture: {moves: !!bool perhaps}\n", "not valid YAML"),
    "a whole number of no digits": ('video: clip.mp4\ncamera: {focal_length_px: !!int ""}\n', "not valid YAML"),
    "a date that is none": ("video: clip.mp4\ncapture: {moves: !!timestamp soon}\n", "not valid YAML"),
    "a negative length": ("video: clip.mp4\ncamera: {focal_length_px: -900}\n", "10 .. 1e"),
    "a YAML bomb": (f"{BOMB}video: clip.mp4\n", "aliases"),
    "a YAML bomb in a value": ("video: clip.mp4\ncamera: &a [*a, *a]\n", "aliases"),
    "50,000 brackets": (f"video: {'[' * 50_000}\n", "not valid YAML"),
    "ten megabytes of settings": ("video: clip.mp4\n" + "# padding\n" * 1_000_000, "too large"),
    "6,500 keys": ("video: clip.mp4\n" + "".join(f"k{i}: 1\n" for i in range(6_500)), "unknown key"),
    "a key given twice": ("video: clip.mp4\nvideo: other.mp4\n", "given twice"),
    "a Python tag": (f"video: !!python/object/apply:os.system ['touch {CANARY}']\n", "not valid YAML"),
    "UTF-16": ("video: clip.mp4\n".encode("utf-16"), "not a text file"),
    "nothing but zeros": (bytes(1000), "not valid YAML"),
    "an absolute path": ("video: /etc/passwd\n", "leaves the subject's folder"),
    "a path upwards": ("video: ../../etc/passwd\n", "leaves the subject's folder"),
    "a NUL in the path": ('video: "clip.mp4\\0.txt"\n', "not a file's name"),
    "an escape code in the path": ('video: "\\e[2J.mp4"\n', "not a file's name"),
    "half a letter in the path": ('video: "\\ud800.mp4"\n', "not a file's name"),
    "a name of 5,000 letters": (f"video: {'x' * 5000}.mp4\n", "not a file's name"),
    "an unknown transfer function": ("video: clip.mp4\ncolour: {transfer: [srgb]}\n", "value not known"),
}
for _name, (_text, _words) in SUBJECTS.items():
    case(_name, _words, "limn")(subject(_text))


@case("a link to a file elsewhere", "symbolic link leads out", "limn")
def link_out(folder):
    (folder / "clip.mp4").symlink_to(clip(_beside(folder)))


@case("a link to a folder elsewhere", "symbolic link leads out", "limn")
def folder_link(folder):
    (folder / "frames").symlink_to(clip(_beside(folder)).parent)
    (folder / "subject.yaml").write_text("video: frames/clip.mp4\n")


@case("subject.yaml is a link", "symbolic link leads out", "limn")
def settings_link(folder):
    clip(folder)
    (folder / "subject.yaml").symlink_to("/etc/passwd")


@case("work is a link", "in place of results", "limn")
def work_link(folder):
    clip(folder)
    (folder / "work").symlink_to(_beside(folder))
    return ["--in-place"]


@case("the lock is a link", "in place of results", "limn")
def lock_link(folder):
    clip(folder)
    (folder / "work").mkdir()
    precious = _beside(folder) / "precious"
    precious.write_text("keep me")
    (folder / "work" / ".run.lock").symlink_to(precious)
    return ["--in-place"]


@case("a line break in the folder's name", "name cannot be used", "limn")
def line_break(folder):
    _renamed(folder, os.fsencode(folder.parent / "two\nlines"))
    return ["--subject", str(folder.parent / "two\nlines")]


@case("a folder's name that is not UTF-8", "name cannot be used", "limn")
def not_utf8(folder):
    _renamed(folder, os.fsencode(folder.parent) + b"/\xff\xfe")
    return ["--subject", os.fsdecode(os.fsencode(folder.parent) + b"/\xff\xfe")]


def _beside(folder: Path) -> Path:
    other = folder.with_name(folder.name + "_beside")
    other.mkdir()
    return other


def _renamed(folder: Path, name: bytes) -> None:
    """A sound subject in a folder of that name; the one that was asked for stays, sound and unused."""
    os.mkdir(name)
    clip(folder)
    for target in (name, os.fsencode(folder)):
        with open(target + b"/subject.yaml", "w") as file:
            file.write("video: clip.mp4\n")
    os.link(os.fsencode(folder) + b"/clip.mp4", name + b"/clip.mp4")


STAGE = "  sample_frames: {needs: []}\n"
PIPELINES = {
    "pipeline: stages of its own": ("package: own\nstages:\n  steal: {}\n", "code that would be run"),
    "pipeline: a package upwards": ("package: ../own\nstages:\n  steal: {}\n", "not a Python package"),
    "pipeline: a stage upwards": ("stages:\n  ../own/steal: {}\n", "not a stage's name"),
    "pipeline: an unknown stage": ("stages:\n  steal: {}\n", "no such stage"),
    "pipeline: a circle": ("stages:\n  a: {needs: [b]}\n  b: {needs: [a]}\n", "circle"),
    "pipeline: a bomb": (f"{BOMB}stages: *a9\n", "aliases"),
    "pipeline: negative memory": (f"stages:\n{STAGE.replace('[]}', '[], resources: {mem_mb: -1}}')}", "resources"),
    "pipeline: a size that is a file's name": (
        "stages:\n  sample_frames: {}\n  track_landmarks: {needs: [sample_frames]}\n"
        "  init_albedo: {needs: [sample_frames, track_landmarks]}\n"
        "  inverse_render: {needs: [sample_frames, track_landmarks, init_albedo]}\n"
        "sizes: {map_px: inverse_render.mesh}\n", "not a number"),
    "pipeline: a preset that is a number": (f"stages:\n{STAGE}presets: {{standard: 3}}\n", "not a mapping"),
    "pipeline: a value out of range": (
        f"stages:\n{STAGE}presets: {{standard: {{sample_frames: {{max_size: 1.0e+9}}}}}}\n", "128 .. 4096"),
    "pipeline: a file named in it": (
        "stages:\n  sample_frames: {}\n  track_landmarks: {needs: [sample_frames]}\n"
        "  init_albedo: {needs: [sample_frames, track_landmarks]}\n"
        "  inverse_render: {needs: [sample_frames, track_landmarks, init_albedo]}\n"
        "presets: {standard: {inverse_render: {mesh: /etc/passwd}}}\n", "on the command line only"),
}


def pipeline(text):
    """A maker of a sound subject and of this pipeline.yaml beside it, with code that leaves a trace."""
    def make(folder):
        clip(folder)
        other = _beside(folder)
        (other / "own").mkdir()
        code = f"open({str(folder.parent / CANARY)!r}, 'w')\n"
        (other / "own" / "__init__.py").write_text(code)
        (other / "own" / "steal.py").write_text(f"{code}STAGE = open({str(folder.parent / CANARY)!r}, 'w')\n")
        (other / "pipeline.yaml").write_text(text)
        return ["--pipeline", other / "pipeline.yaml"]
    return make


for _name, (_text, _words) in PIPELINES.items():
    case(_name, _words, "limn")(pipeline(_text))
