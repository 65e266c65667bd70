"""What a stage declares: name, version, inputs, outputs, parameters.

One declaration gives the command line, the validation, the cache key, the manifest, docs/parameters.md and
docs/files.md.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import PurePosixPath

from shared.contract.wording import unknown_name
from shared.errors import InputError, shown

_NAME = re.compile(r"[a-z][a-z0-9_]*\Z")
_COUNTER = re.compile(r"%(?:0?\d+)?d")
_TRUE, _FALSE, _NONE = ("true", "yes", "on", "1"), ("false", "no", "off", "0"), ("none", "null", "")
_KIND = {int: "a whole number", float: "a number", bool: "true or false", str: "text"}


@dataclass(frozen=True)
class Parameter:
    """One setting of a stage. A default of None means 'not set' and lets users give none.

    type: int, float, bool or str. help: one sentence. unit: '' for counts, ratios and names. minimum, maximum:
    inclusive. choices: all allowed values. file: the text names a file; only a command line may do that, never
    pipeline.yaml, and the file's content counts as an input. Its path becomes absolute. former: the name that it had
    before, which is refused with a line that names the new one.
    """

    name: str
    type: type
    default: object
    help: str
    unit: str = ""
    minimum: float | None = None
    maximum: float | None = None
    choices: tuple = ()
    file: bool = False
    former: str = ""

    def __post_init__(self) -> None:
        if not _NAME.match(self.name) or self.type not in _KIND or not self.help:
            raise ValueError(f"parameter {self.name!r} needs a snake_case name, int|float|bool|str and a sentence")
        object.__setattr__(self, "default", self.parse(self.default, f"default of {self.name}"))

    def parse(self, value: object, where: str) -> object:
        """`value`, from Python, YAML or a command line, as this parameter's type and in its range; else InputError."""
        if value is None or (isinstance(value, str) and value.lower() in _NONE and self.default is None):
            if self.default is None:
                return None
            raise InputError("no value", where=where, expected=self.expected)
        typed = self._typed(value)
        if typed is None or not self._allowed(typed):
            raise InputError("value not allowed", where=where, got=shown(value), expected=self.expected)
        return typed

    def _typed(self, value: object) -> object | None:
        """`value` as int, float, bool or str; None when it is no such thing."""
        if self.type is bool:
            text = str(value).lower()
            return True if text in _TRUE else False if text in _FALSE else None
        if isinstance(value, bool) or not isinstance(value, int | float | str):
            return None
        try:
            if self.type is str:
                return os.path.abspath(str(value)) if self.file and value else str(value)
            number = float(value)
            if not math.isfinite(number) or (self.type is int and number != int(number)):
                return None
            return int(value) if self.type is int and isinstance(value, str) and "e" not in value.lower() else (
                self.type(number))
        except (ValueError, OverflowError):
            return None

    def _allowed(self, value: object) -> bool:
        if self.choices:
            return value in self.choices
        if self.minimum is not None and value < self.minimum:
            return False
        return self.maximum is None or value <= self.maximum

    @property
    def expected(self) -> str:
        """Type, range and unit in words."""
        if self.choices:
            return "one of " + ", ".join(map(str, self.choices))
        return " ".join(part for part in (_KIND[self.type], self.range, self.unit) if part)

    @property
    def range(self) -> str:
        """The allowed interval, '' where there is none."""
        low, high = self.minimum, self.maximum
        if low is not None and high is not None:
            return f"{low:g} .. {high:g}"
        return f">= {low:g}" if low is not None else f"<= {high:g}" if high is not None else ""


@dataclass(frozen=True)
class ParameterGroup:
    """Parameters that count in one case only. What lists parameters leaves them out until asked for the group.

    case: which case, as a clause that ends 'parameters ...'.
    """

    name: str
    case: str
    parameters: tuple[Parameter, ...]


@dataclass(frozen=True)
class Field:
    """One entry of a JSON or NPZ file.

    path: the keys that lead to it: `crop.scale`; `frames[].file` of every item of a list; `segments.<segment>.albedo`
    where the key itself varies; `parameters.**` is `parameters` with everything below it. kind: number, int, text,
    bool, number or null, or an array's NumPy type; '' for an entry that only holds others. shape: of arrays and lists,
    numbers and letters separated by commas. unit: '' for counts, ratios and names. optional: may be absent, with all
    below it.
    """

    path: str
    help: str
    kind: str = "number"
    shape: str = ""
    unit: str = ""
    optional: bool = False


@dataclass(frozen=True)
class Output:
    """A file of a stage's folder, or many by a pattern (`frames/*.png` or `frames/%06d.png`).

    volatile: holds times or the like, so its bytes say nothing about the result: listed, never hashed.
    optional: may be absent. unit, space, colour_space: go into the manifest. fields: what a JSON or NPZ file holds.
    """

    path: str
    help: str
    unit: str = ""
    space: str = ""
    colour_space: str = ""
    volatile: bool = False
    optional: bool = False
    fields: tuple[Field, ...] = ()

    def matches(self, relative: str) -> bool:
        """Whether the file (posix path inside the stage's folder) is this output."""
        pattern = PurePosixPath(_COUNTER.sub("*", self.path)).parts
        parts = PurePosixPath(relative).parts
        return len(parts) == len(pattern) and all(map(fnmatchcase, parts, pattern))


EXPORT = "export"


def folder_of(name: str) -> str:
    """Where the stage of this name publishes, relative to the run's folder."""
    return EXPORT if name.startswith("export_") else f"work/{name}"


_RETIRED = {"seed": "leave it out: nothing in the stage is random"}
"""What every stage once had, and what to do now."""


@dataclass(frozen=True)
class Stage:
    """Declaration of one stage.

    inputs: stages whose folders are read. A stage without inputs reads the subject's video. given: files of the subject
    that are read where subject.yaml names them. models: files of the models folder that are read, see models.py. A
    stage named export_* publishes to `export/`, all others to `work/<name>/`. joins: inputs of which the stage reads
    every clip's, where a subject has several clips; a stage that joins nothing then runs for each clip by itself.
    groups: parameters that count in one case only; they join the others. retired: (name, what to do instead) of
    parameters that are no more, with which they are refused.
    """

    name: str
    version: int
    help: str
    inputs: tuple[str, ...]
    outputs: tuple[Output, ...]
    parameters: tuple[Parameter, ...] = ()
    given: tuple[str, ...] = ()
    joins: tuple[str, ...] = ()
    models: tuple[str, ...] = ()
    groups: tuple[ParameterGroup, ...] = ()
    retired: tuple[tuple[str, str], ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "inputs", tuple(self.inputs))
        object.__setattr__(self, "outputs", tuple(self.outputs))
        grouped = tuple(p for group in self.groups for p in group.parameters)
        object.__setattr__(self, "parameters", (*self.parameters, *grouped))
        names = [p.name for p in self.parameters] + [p.former for p in self.parameters if p.former]
        names += [name for name, _ in self.retired]
        if not set(self.joins) <= set(self.inputs):
            raise ValueError(f"stage {self.name!r} joins what is not among its inputs")
        if not _NAME.match(self.name) or not self.help or not self.outputs or len(set(names)) != len(names):
            raise ValueError(f"stage {self.name!r} needs a snake_case name, a sentence, outputs, unique parameters")

    @property
    def reads_source(self) -> bool:
        """Whether the stage reads the subject's video itself."""
        return not self.inputs

    @property
    def folder(self) -> str:
        """Where the stage publishes, relative to the run's folder."""
        return folder_of(self.name)

    @property
    def common(self) -> tuple[Parameter, ...]:
        """The parameters that count in any case: those of no group."""
        return self.parameters[: len(self.parameters) - sum(len(group.parameters) for group in self.groups)]

    def defaults(self) -> dict[str, object]:
        """{parameter: default}."""
        return {p.name: p.default for p in self.parameters}

    def parse(self, values: Mapping[str, object], where: str) -> dict[str, object]:
        """Given values, checked and typed; InputError for the first that is unknown, of a wrong type or out of range.

        where: what the values come from, in words; the parameter's name is added.
        """
        known = {p.name: p for p in self.parameters}
        renamed = {p.former: p.name for p in self.parameters if p.former}
        for name in values:
            if name in renamed:
                raise InputError(f"parameter {self.name}.{name} has another name now", where=where,
                                 hint=f"write {self.name}.{renamed[name]}")
            if name not in known and (instead := {**_RETIRED, **dict(self.retired)}.get(name)):
                raise InputError(f"parameter {self.name}.{name} is no more", where=where, hint=instead)
            if name not in known:
                raise unknown_name("parameter", f"{self.name}.{name}", [f"{self.name}.{key}" for key in known], where)
        return {name: known[name].parse(value, f"{where}: {self.name}.{name}") for name, value in values.items()}

    def output_of(self, relative: str) -> Output | None:
        """The declared output that a file of the folder belongs to."""
        return next((output for output in self.outputs if output.matches(relative)), None)


def parameter_table(parameters: Mapping[str, Sequence[Parameter]]) -> str:
    """Markdown table of {stage: parameters}, for `limn parameters` and docs/parameters.md."""
    rows = ["| stage | parameter | default | range | unit | what |", "|---|---|---|---|---|---|"]
    for stage, own in parameters.items():
        for p in own:
            allowed = ", ".join(f"`{c}`" for c in p.choices) or p.range
            default = "none" if p.default is None else str(p.default).lower() if p.type is bool else p.default
            rows.append(f"| {stage} | `{p.name}` | `{default}` | {allowed} | {p.unit} | {p.help} |")
    return "\n".join(rows) + "\n"
