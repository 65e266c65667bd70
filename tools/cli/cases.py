"""What a call of limn is about: the pipeline and the subjects, each with its run folder and its parameters, checked."""

from __future__ import annotations

import contextlib
import os
import sys
import traceback
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from shared.contract.declare import Stage
from shared.contract.folders import RunFolder
from shared.contract.pipeline import Pipeline, split_settings
from shared.contract.subject import Subject, load_subject
from shared.errors import InputError, refused, shown

LARGEST_LIST_BYTES = 1 << 24


class InputErrors(InputError):
    """Several faults of the input, each one line."""

    def __init__(self, errors: Sequence[InputError]) -> None:
        super().__init__("; ".join(map(str, errors)))
        self.errors = tuple(errors)


@dataclass(frozen=True)
class SubjectCase:
    """One subject with the folder that its run goes to; or one clip of a subject that has several: clip is its name."""

    subject: Subject
    run: RunFolder
    clip: str = ""

    @property
    def name(self) -> str:
        """The subject's name."""
        return self.subject.name

    def jobs(self, pipeline: Pipeline) -> list[tuple[SubjectCase, str]]:
        """What there is to do, in order: the case and the stage, where a case of several clips stands for the stages
        that work on all of them, and each clip is a case of its own for the others. Only what the pipeline wants."""
        clips = [SubjectCase(clip, self.run.of_clip(clip.name), clip.name) for clip in self.subject.clips]
        joint = pipeline.joint if clips else pipeline.steps
        steps = [name for name in pipeline.steps if name in pipeline.wanted]
        return [(case, name) for case in clips for name in steps if name not in joint] + [
            (self, name) for name in steps if name in joint]

    def inputs(self, stage: Stage) -> dict[str, Path]:
        """{name: folder} of what a stage of this case reads; of each clip as clip/name where it joins them."""
        return self.run.inputs(stage, [clip.name for clip in self.subject.clips])

    def label(self, stage: str) -> str:
        """The stage's name, with that of the clip where the subject has several."""
        return f"{self.clip}/{stage}" if self.clip else stage


@dataclass(frozen=True)
class Opened:
    """The subjects of a call. faults: (folder, what is wrong) of those that cannot be worked on. crashes: the same of
    those on which Limn itself failed."""

    cases: list[SubjectCase] = field(default_factory=list)
    faults: list[tuple[Path, InputError]] = field(default_factory=list)
    crashes: list[tuple[Path, str]] = field(default_factory=list)

    @contextlib.contextmanager
    def attempt(self, case: SubjectCase) -> Iterator[None]:
        """What goes wrong with one subject is kept for conclude(), so that it stops no other; traces go to stderr."""
        try:
            yield
        except InputError as error:
            self.faults.append((case.subject.folder, error))
        except BrokenPipeError:
            raise
        except OSError as error:
            self.faults.append((case.subject.folder, no_access(case, error)))
        except Exception as error:  # a bug, or a planted record that gets past the checks: never hidden
            traceback.print_exc()
            self.crashes.append((case.subject.folder, one_line(error)))

    def conclude(self) -> int:
        """Says what is wrong with which subjects; returns the exit code."""
        for _, error in self.faults:
            print(f"limn: {error}", file=sys.stderr)
        for folder, text in self.crashes:
            print(f"limn: {folder}: failed: {text}", file=sys.stderr)
        return 1 if self.crashes else 2 if self.faults else 0


def no_access(case: SubjectCase, error: OSError) -> InputError:
    """What to say where the subject's files cannot be read or written."""
    return refused(error, case.run.root, "check permissions and disk, or write elsewhere with --out DIR")


def one_line(error: Exception) -> str:
    """An unexpected error in one line."""
    return shown(f"{type(error).__name__}: {' '.join(str(error).split())}")


def find_subjects(folders: Sequence[Path], list_file: Path | None = None) -> list[Path]:
    """Subject folders: a folder without subject.yaml stands for those in it that have one; a list names one a line."""
    found: list[Path] = []
    for folder in [*folders, *(_listed(list_file) if list_file else ())]:
        found += _subjects_in(folder) or [folder]
    if not found:
        raise InputError("no subjects", hint="give folders with subject.yaml, a folder of such, or --list FILE")
    return found


def _subjects_in(folder: Path) -> list[Path]:
    """The subjects in a folder of subjects; what this user may not look into (lost+found) is none of them."""
    if _is_subject(folder) or not os.path.isdir(folder):
        return []
    try:
        inside = sorted(folder.iterdir())
    except OSError as error:
        raise InputError("cannot be read", where=str(folder), got=error.strerror, hint="check permissions") from error
    return [path for path in inside if _is_subject(path)]


def _is_subject(folder: Path) -> bool:
    return os.path.exists(folder / "subject.yaml")


def _listed(path: Path) -> list[Path]:
    """The folders that a list names, relative to it; '#' starts a comment."""
    try:
        with open(path, encoding="utf-8") as file:
            lines = file.read(LARGEST_LIST_BYTES).splitlines()
    except (OSError, ValueError) as error:
        raise InputError("cannot be read as a list of subjects", where=str(path), got=error) from error
    names = [line.partition("#")[0].strip() for line in lines]
    return [path.parent / name for name in names if name]


def open_cases(folders: Sequence[Path], out: Path | None) -> Opened:
    """The subjects, checked, and the faults; InputErrors where two of them would write to one place."""
    opened = Opened()
    for folder in folders:
        try:
            subject = load_subject(folder)
            opened.cases.append(SubjectCase(subject, RunFolder.of(subject.folder, subject.name, out)))
        except InputError as error:
            opened.faults.append((folder, error))
        except OSError as error:
            opened.faults.append((folder, refused(error, folder)))
    roots = [case.run.root.resolve() for case in opened.cases]
    twice = [InputError("given twice, or two subjects of one name", where=str(case.subject.folder), hint="rename one")
             for i, case in enumerate(opened.cases) if roots[i] in set(roots[:i])]
    if twice:
        raise InputErrors(twice)
    return opened


def all_parameters(pipeline: Pipeline, preset: str | None, settings: Sequence[str]) -> dict[str, dict[str, object]]:
    """{stage: {parameter: value}} for a run; checks every preset and every setting."""
    pipeline.check()
    given: Mapping[str, Mapping[str, object]] = split_settings(settings, pipeline.stages)
    return {name: pipeline.parameters(stage, preset, given.get(name, {})) for name, stage in pipeline.stages.items()}
