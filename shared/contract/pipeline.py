"""pipeline.yaml: which stages there are, what they need, and the presets."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

from shared.contract.confine import is_trusted
from shared.contract.declare import Parameter, Stage
from shared.contract.needs import parse_needs, parse_sizes
from shared.contract.source import read_declaration
from shared.contract.wording import Anything, check_keys, nearest, read_yaml, unknown_name
from shared.errors import InputError, shown

REPOSITORY = Path(__file__).resolve().parents[2]
DEFAULT_PIPELINE = REPOSITORY / "pipeline.yaml"
_NAME = re.compile(r"[a-z][a-z0-9_]{0,63}\Z")
_THREADS = Parameter("threads", int, None, "Cores of one job.", "cores", 1, 4096)
_LIMIT = Parameter("limit", float, None, "Threshold of a quality gate.", "", -1e9, 1e9)


@dataclass(frozen=True)
class Step:
    """A stage as pipeline.yaml places it. threads: None for all cores. resources: {kind: {term: coefficient}}, see
    needs.py.
    """

    needs: tuple[str, ...]
    threads: int | None = None
    resources: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    parameters: Mapping[str, object] = field(default_factory=dict)


@dataclass(frozen=True)
class Gate:
    """What a good result keeps to, inclusive."""

    least: float | None = None
    most: float | None = None

    def holds(self, value: float) -> bool:
        """Whether a measured value is good enough; what is no number is not."""
        low = self.least is None or value >= self.least
        return low and (self.most is None or value <= self.most) and value == value

    @property
    def limit(self) -> str:
        """The limits in words."""
        ends = ((self.least, "more"), (self.most, "less"))
        return " and ".join(f"{limit:g} or {word}" for limit, word in ends if limit is not None)


@dataclass(frozen=True)
class Pipeline:
    """The content of pipeline.yaml. steps are in an order in which each follows what it needs. last: the stage to stop
    after, '' for the whole pipeline.
    """

    path: Path
    package: str
    steps: Mapping[str, Step]
    presets: Mapping[str, Mapping[str, Mapping[str, object]]]
    default_preset: str
    sizes: Mapping[str, str] = field(default_factory=dict)
    gates: Mapping[str, Gate] = field(default_factory=dict)
    last: str = ""

    def until(self, stage: str) -> Pipeline:
        """The same pipeline, of which only this stage and what it needs is wanted; InputError for an unknown one."""
        if stage not in self.steps:
            raise unknown_name("stage", stage, self.steps, "--until")
        return replace(self, last=stage)

    @cached_property
    def wanted(self) -> frozenset[str]:
        """The stages that are to be done: all, or `last` and what it needs."""
        found, open_ends = set(), [self.last] if self.last else list(self.steps)
        while open_ends:
            name = open_ends.pop()
            if name not in found:
                found.add(name)
                open_ends += self.steps[name].needs
        return frozenset(found)

    @cached_property
    def root(self) -> Path:
        """The folder that holds the stages' package: beside pipeline.yaml, else the repository.

        InputError for a package beside a pipeline.yaml for whose folder nobody vouches: its stages are code.
        """
        own = self.path.parent.joinpath(*self.package.split("."))
        if not own.is_dir() or self.path.parent == REPOSITORY:
            return REPOSITORY
        if self.package == "stages":
            return REPOSITORY
        if not is_trusted(own):
            raise InputError("stages of its own are code that would be run", where=str(self.path), got=str(own),
                             hint=f"if you know them: --trust {self.path.parent}")
        return self.path.parent

    @property
    def code_roots(self) -> tuple[Path, ...]:
        """Where code of the stages may lie: in the repository, and beside pipeline.yaml."""
        return tuple(dict.fromkeys((REPOSITORY, self.path.parent)))

    @cached_property
    def stages(self) -> dict[str, Stage]:
        """The declarations, checked against the steps."""
        declared = {name: read_declaration(self.stage_file(name)) for name in self.steps}
        for name, stage in declared.items():
            if set(stage.inputs) != set(self.steps[name].needs):
                raise InputError("needs differ from what the stage declares", where=f"{self.path}: stages.{name}",
                                 got=list(self.steps[name].needs), expected=list(stage.inputs))
        folders = [stage.folder for stage in declared.values()]
        if len(set(folders)) != len(folders):
            raise InputError("more than one stage publishes to export/", where=str(self.path))
        return declared

    @cached_property
    def joint(self) -> frozenset[str]:
        """The stages that work on all clips of a subject together; all others run for each clip by itself."""
        joint: set[str] = set()
        for name, stage in self.stages.items():
            if stage.joins or joint & set(stage.inputs):
                joint.add(name)
                each = [need for need in stage.inputs if need not in joint]
                if set(each) != set(stage.joins):
                    raise InputError("joins other inputs than those that run for each clip", got=list(stage.joins),
                                     where=str(self.stage_file(name)), expected=each)
        return frozenset(joint)

    def stage_file(self, name: str) -> Path:
        """The stage's source file."""
        return self.root.joinpath(*self.package.split("."), f"{name}.py")

    def parameters(self, stage: Stage, preset: str | None, given: Mapping[str, object]) -> dict[str, object]:
        """All parameters of the stage: defaults, then its step's, then the preset's, then the given ones."""
        preset = preset or self.default_preset
        if preset not in self.presets:
            raise unknown_name("preset", preset, self.presets, str(self.path))
        step = self.steps.get(stage.name)
        where = f"{self.path}: stages.{stage.name}.parameters"
        values = stage.defaults() | _without_files(stage, step.parameters if step else {}, where)
        values |= _without_files(stage, self.presets[preset].get(stage.name, {}), f"{self.path}: presets.{preset}")
        return values | stage.parse(given, "--set")

    def check(self) -> None:
        """Every stage's declaration and every value of every preset; InputError for the first that is wrong."""
        for preset in self.presets:
            for stage in self.stages.values():
                self.parameters(stage, preset, {})


def _without_files(stage: Stage, values: Mapping[str, object], where: str) -> dict[str, object]:
    """Values of pipeline.yaml, parsed; InputError where one names a file, which only the operator may."""
    for name in (p.name for p in stage.parameters if p.file and values.get(p.name)):
        raise InputError("a file may be named on the command line only", where=f"{where}: {stage.name}.{name}",
                         hint=f"leave it out here and add --set {stage.name}.{name}=FILE")
    return stage.parse(values, where)


def load_pipeline(path: Path | None = None) -> Pipeline:
    """Reads pipeline.yaml (the repository's by default) and checks its structure; InputError where it is wrong."""
    path = Path(path).absolute() if path else DEFAULT_PIPELINE
    if not path.is_file():
        raise InputError("no such file", where=str(path), hint="give the pipeline with --pipeline FILE")
    known = ("package", "stages", "presets", "default_preset", "sizes", "gates")
    content = check_keys(read_yaml(path), known, str(path))
    given = check_keys(content.get("stages"), Anything(), f"{path}: stages")
    for name in given:
        if not _is_name(name):
            raise InputError("not a stage's name", where=f"{path}: stages", got=shown(name), expected="snake_case")
    steps = {name: _step(value, f"{path}: stages.{name}") for name, value in given.items()}
    if not steps:
        raise InputError("no stages", where=str(path))
    steps = _in_order(steps, path)
    presets = check_keys(content.get("presets"), Anything(), f"{path}: presets")
    presets = {str(name): _preset(value, steps, f"{path}: presets.{shown(name)}") for name, value in presets.items()}
    default, package = content.get("default_preset", "standard"), content.get("package", "stages")
    for key, value in (("default_preset", default), ("package", package)):
        if not isinstance(value, str):
            raise InputError("not a name", where=f"{path}: {key}", got=shown(value))
    if not all(map(_is_name, package.split("."))):
        raise InputError("not a Python package's name", where=f"{path}: package", got=shown(package))
    presets = presets or {default: {}}
    if default not in presets:
        raise unknown_name("preset", default, presets, f"{path}: default_preset")
    gates = check_keys(content.get("gates"), Anything(), f"{path}: gates")
    gates = {str(name): _gate(value, f"{path}: gates.{shown(name)}") for name, value in gates.items()}
    return Pipeline(path, package, steps, presets, default, parse_sizes(content.get("sizes"), f"{path}: sizes"), gates)


def _gate(value: object, where: str) -> Gate:
    given = check_keys(value, ("least", "most"), where)
    limits = {name: _LIMIT.parse(limit, f"{where}.{name}") for name, limit in given.items()}
    if not any(limit is not None for limit in limits.values()):
        raise InputError("a gate without limits", where=where, hint="give least: or most:")
    return Gate(**limits)


def _is_name(value: object) -> bool:
    return isinstance(value, str) and _NAME.match(value) is not None


def _step(value: object, where: str) -> Step:
    given = check_keys(value, ("needs", "threads", "resources", "parameters"), where)
    needs = given.get("needs") or []
    if not isinstance(needs, list):
        raise InputError("not a list of stages", where=f"{where}.needs", got=shown(needs))
    requested = parse_needs(given.get("resources"), f"{where}.resources")
    threads = _THREADS.parse(given.get("threads"), f"{where}.threads")
    parameters = check_keys(given.get("parameters"), Anything(), f"{where}.parameters")
    return Step(tuple(map(str, needs)), threads, requested, parameters)


def _in_order(steps: Mapping[str, Step], path: Path) -> dict[str, Step]:
    for name, step in steps.items():
        for need in step.needs:
            if need not in steps:
                raise unknown_name("stage", need, steps, f"{path}: stages.{name}.needs")
    try:
        order = tuple(TopologicalSorter({name: step.needs for name, step in steps.items()}).static_order())
    except CycleError as error:
        circle = " -> ".join(error.args[1])
        raise InputError("stages need each other in a circle", where=str(path), got=circle) from error
    return {name: steps[name] for name in order}


def _preset(value: object, steps: Mapping[str, Step], where: str) -> dict[str, Mapping[str, object]]:
    given = check_keys(value, Anything(), where)
    for name in given:
        if name not in steps:
            raise unknown_name("stage", name, steps, where)
    return {name: check_keys(settings, Anything(), f"{where}.{name}") for name, settings in given.items()}


def split_settings(settings: Iterable[str], stages: Iterable[str]) -> dict[str, dict[str, str]]:
    """['stage.key=value', ...] -> {stage: {key: value}}; InputError for what is not of that form."""
    stages = tuple(stages)
    values: dict[str, dict[str, str]] = {}
    for setting in settings:
        name, equals, value = setting.partition("=")
        stage, dot, key = name.strip().partition(".")
        if not equals or not dot or not key:
            raise InputError("setting not understood", where="--set", got=setting, expected="stage.key=value",
                             hint="" if dot else f"stages: {', '.join(stages)}")
        if stage not in stages:
            raise InputError(f"unknown stage {stage!r}", where="--set", hint=nearest(stage, stages))
        values.setdefault(stage, {})[key] = value.strip()
    return values
