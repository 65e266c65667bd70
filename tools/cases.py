"""What a call of limn is about: the pipeline and the subjects, each with its run folder and its parameters, checked."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from shared.contract.folders import RunFolder
from shared.contract.pipeline import Pipeline, split_settings
from shared.contract.subject import Subject, load_subject
from shared.errors import InputError


class InputErrors(InputError):
    """Several faults of the input, each one line."""

    def __init__(self, errors: Sequence[InputError]) -> None:
        super().__init__("; ".join(map(str, errors)))
        self.errors = tuple(errors)


@dataclass(frozen=True)
class Case:
    """One subject with the folder that its run goes to."""

    subject: Subject
    run: RunFolder

    @property
    def name(self) -> str:
        """The subject's name."""
        return self.subject.name


def open_cases(folders: Sequence[Path], out: Path | None) -> list[Case]:
    """Subjects, checked; InputErrors with one line for each that is wrong."""
    cases, errors = [], []
    for folder in folders:
        try:
            subject = load_subject(folder)
            cases.append(Case(subject, RunFolder.of(subject.folder, subject.name, out)))
        except InputError as error:
            errors.append(error)
    roots = [case.run.root.resolve() for case in cases]
    errors += [InputError("given twice, or two subjects of one name", where=str(case.subject.folder), mend="rename one")
               for i, case in enumerate(cases) if roots[i] in roots[:i]]
    if errors:
        raise InputErrors(errors)
    return cases


def all_parameters(pipeline: Pipeline, preset: str | None, settings: Sequence[str]) -> dict[str, dict[str, object]]:
    """{stage: {parameter: value}} for a run; checks every preset and every setting."""
    pipeline.check()
    given: Mapping[str, Mapping[str, object]] = split_settings(settings, pipeline.stages)
    return {name: pipeline.parameters(stage, preset, given.get(name, {})) for name, stage in pipeline.stages.items()}
