"""What a case is, and all of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

CAMERA = "camera: {focal_length_mm: 60, sensor_width_mm: 22.3}\n"
CASES: dict[str, Case] = {}


@dataclass(frozen=True)
class Case:
    """make(folder) fills the subject's folder and may return arguments of `limn run`.

    words: what the one line says where the input is refused; "" where a result is due. at: "limn" for what is refused
    before anything starts, else the stage that refuses.
    """

    name: str
    make: Callable[[Path], list[str] | None]
    words: str
    at: str

    def build(self, folder: Path) -> list[str]:
        """The subject in a folder that does not exist yet, subject.yaml too unless the case wrote one -> arguments."""
        folder.mkdir(parents=True)
        arguments = self.make(folder) or []
        if not (folder / "subject.yaml").exists():
            write_settings(folder, next(clip.name for clip in sorted(folder.iterdir()) if clip.name != "work"))
        return [str(argument) for argument in arguments]


def write_settings(folder: Path, video: str, more: str = "") -> None:
    """subject.yaml; video may hold any printable letters."""
    quoted = "'" + video.replace("'", "''") + "'"
    (folder / "subject.yaml").write_text(f"video: {quoted}\n{CAMERA}{more}", encoding="utf-8")


def case(name: str, words: str = "", at: str = "sample_frames"):
    """Registers a function as the maker of a case."""
    def register(make):
        CASES[name] = Case(name, make, words, at if words else "")
        return make
    return register


from bad_inputs import clips, imports, pictures, settings  # noqa: E402, F401  they register their cases here
