"""What a stage's run and check receive."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import TypeVar

from shared.contract.declare import Stage
from shared.contract.manifest import PROVENANCE, read_manifest, read_record
from shared.contract.progress import Reporter
from shared.contract.subject import Subject
from shared.errors import InputError, LimnError

Item = TypeVar("Item")


class Parameters:
    """The stage's parameters as attributes; they cannot be changed."""

    def __init__(self, values: Mapping[str, object]) -> None:
        self.__dict__.update(values)

    def __setattr__(self, name: str, value: object) -> None:
        raise AttributeError(f"parameters are fixed: {name}")

    def __repr__(self) -> str:
        return f"Parameters({self.__dict__})"

    def as_dict(self) -> dict[str, object]:
        """{name: value}."""
        return dict(self.__dict__)


class Job:
    """One run of one stage.

    subject: facts of subject.yaml; of several clips, of the one that this run is about, or of all. params: the stage's
    parameters. out: the folder to write into; it is published when run and check have returned. threads: cores the
    stage may use.
    """

    def __init__(self, stage: Stage, subject: Subject, params: Mapping[str, object], out: Path,
                 folders: Mapping[str, Path], reporter: Reporter, threads: int) -> None:
        """folders: {stage: published folder} of the declared inputs, or {clip/stage: ...}."""
        self.stage, self.subject, self.params, self.out = stage, subject, Parameters(params), out
        self.threads = threads
        self._folders, self._reporter = dict(folders), reporter

    @property
    def clips(self) -> tuple[str, ...]:
        """Names of the clips that the stage joins; empty where there is but one."""
        return tuple(clip.name for clip in self.subject.clips)

    @property
    def input_names(self) -> tuple[str, ...]:
        """The inputs' names as in the manifest: stage, or clip/stage."""
        return tuple(self._folders)

    def input(self, stage: str, clip: str = "") -> Path:
        """The published folder of a declared input; clip: of which clip, the first one's by default."""
        of_clip = f"{clip or next(iter(self.clips), '')}/{stage}"
        for name in (stage, of_clip):
            if name in self._folders:
                return self._folders[name]
        raise LimnError(f"{self.stage.name} does not declare the input {stage!r}")

    def manifest(self, stage: str, clip: str = "") -> dict:
        """manifest.json of a declared input."""
        return _present(read_manifest(self.input(stage, clip)), self.input(stage, clip))

    def provenance(self, stage: str, clip: str = "") -> dict:
        """provenance.json of a declared input. For volatile outputs only: it is no part of the stage's key."""
        return _present(read_record(self.input(stage, clip) / PROVENANCE), self.input(stage, clip))

    def progress(self, iterable: Iterable[Item], label: str, total: int | None = None) -> Iterator[Item]:
        """The items, with a bar on a terminal and plain lines elsewhere."""
        return self._reporter.track(iterable, label, total)

    def note(self, text: str) -> None:
        """A line for the log."""
        self._reporter.note(text)

    def warn(self, text: str) -> None:
        """A warning: it stays in provenance.json and is shown at the end of the run."""
        self._reporter.warn(text)


def _present(record: dict | None, folder: Path) -> dict:
    if record is None:
        raise InputError("the stage's record is missing or damaged", where=str(folder), hint="run limn run again")
    return record
