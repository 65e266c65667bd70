"""manifest.json: what a stage was told, what it read and what it made. Content only: same work, same bytes."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path, PurePosixPath

from shared.contract.chart_place import AUTO
from shared.contract.declare import Stage
from shared.contract.hashing import HashMemory, hash_file, hash_value
from shared.contract.models import models_folder
from shared.contract.shapes import describe
from shared.contract.subject import Subject
from shared.errors import InputError, LimnError

SCHEMA = 1
MANIFEST, PROVENANCE, LOG = "manifest.json", "provenance.json", "log.txt"
RECORDS = (MANIFEST, PROVENANCE, LOG)
SUBJECT_INPUT, VIDEO_INPUT, CHART_INPUT, GREY_INPUT = "subject.yaml", "video", "chart", "grey"


@dataclass(frozen=True)
class Work:
    """One stage's work, fully determined: the same Work gives the same bytes.

    inputs: {name: SHA-256}; of stages the digest of their outputs; None where a stage has yet to run.
    """

    stage: str
    version: int
    parameters: Mapping[str, object]
    inputs: Mapping[str, str | None]

    def content(self) -> dict[str, object]:
        """The manifest's part that is known before the work is done."""
        return {"schema": SCHEMA, "stage": self.stage, "version": self.version, "parameters": dict(self.parameters),
                "inputs": dict(self.inputs)}

    @property
    def key(self) -> str:
        """SHA-256 of the content."""
        return hash_value(self.content())

    def reasons(self, manifest: Mapping[str, object] | None) -> list[str]:
        """Why a folder with this manifest is not the result of this work; empty where it is.

        Inputs that are not known yet (None) give no reason.
        """
        if manifest is None:
            return ["never ran"]
        if manifest.get("schema") != SCHEMA:
            return ["made by another version of Limn"]
        reasons = []
        if manifest["version"] != self.version:
            reasons.append(f"stage version {manifest['version']} -> {self.version}")
        before, now = manifest["parameters"], self.parameters
        reasons += [f"parameter {name}: {_before(before, name)} -> {_before(now, name)}"
                    for name in sorted({*before, *now}) if _before(before, name) != _before(now, name)]
        read = manifest["inputs"]
        reasons += [f"input {name} changed" for name in sorted({*read, *self.inputs})
                    if read.get(name) != self.inputs.get(name) and self.inputs.get(name, "") is not None]
        return reasons


def _before(values: Mapping[str, object], name: str) -> str:
    return json.dumps(values[name]) if name in values else "absent"


def make_work(stage: Stage, parameters: Mapping[str, object], inputs: Mapping[str, str | None]) -> Work:
    """The work that a stage is to do."""
    return Work(stage.name, stage.version, dict(parameters), inputs)


def source_inputs(stage: Stage, subject: Subject, memory: HashMemory) -> dict[str, str]:
    """{name: SHA-256} of what the stage reads of the subject itself.

    That is its settings, of the first stage the clip and where a colour chart or a grey place is, and files of
    another tracker.
    """
    inputs = {SUBJECT_INPUT: hash_value(subject.content())}
    if stage.reads_source:
        files = [[path.name, memory.hash(path)] for path in subject.video_files()]
        inputs[VIDEO_INPUT] = hash_value([subject.video_name(), files])
        if subject.chart != AUTO:
            inputs[CHART_INPUT] = hash_value(asdict(subject.chart))
        if subject.grey is not None:
            inputs[GREY_INPUT] = hash_value(list(subject.grey))
    for name in stage.given:
        if (file := getattr(subject, name)) is not None:
            inputs[name] = hash_value([memory.hash(file), name == "poses" and subject.hold_poses])
    return inputs


def file_inputs(stage: Stage, parameters: Mapping[str, object], memory: HashMemory) -> dict[str, str]:
    """{parameter: SHA-256} of files that parameters name."""
    named = {p.name: Path(parameters[p.name]) for p in stage.parameters if p.file and parameters[p.name]}
    for name, path in named.items():
        if not path.is_file():
            raise InputError("no such file", where=f"--set {stage.name}.{name}", got=str(path))
    return {f"file {name}": memory.hash(path) for name, path in named.items()}


def model_inputs(stage: Stage, memory: HashMemory) -> dict[str, str]:
    """{model: SHA-256} of the models that the stage reads."""
    paths = {name: models_folder() / name for name in stage.models}
    for path in paths.values():
        if not path.is_file():
            raise InputError("the models are not set up", where=str(path), got="no such file", hint="run make setup")
    return {f"model {name}": memory.hash(path) for name, path in paths.items()}


def own_inputs(stage: Stage, subject: Subject, parameters: Mapping[str, object], memory: HashMemory) -> dict[str, str]:
    """{name: SHA-256} of all that the stage reads besides the folders of other stages."""
    return source_inputs(stage, subject, memory) | file_inputs(stage, parameters, memory) | model_inputs(stage, memory)


def outputs_digest(manifest: Mapping[str, object]) -> str:
    """SHA-256 over the names and hashes of all outputs: what later stages depend on."""
    return hash_value({name: entry.get("sha256", "") for name, entry in manifest["outputs"].items()
                       if not entry.get("volatile")})


def output_entries(stage: Stage, folder: Path) -> dict[str, dict[str, object]]:
    """{file: entry} of all that the stage wrote; LimnError for a file nobody declared or an output that is missing."""
    entries = {}
    files = sorted(path for path in folder.rglob("*") if not path.is_dir())
    names = [path.relative_to(folder).as_posix() for path in files]
    for path, name in zip(files, names, strict=True):
        if name in RECORDS:
            continue
        output = stage.output_of(name)
        if output is None:
            raise LimnError(f"{stage.name}: wrote {name}, which is not among its declared outputs")
        entry: dict[str, object] = {"volatile": True} if output.volatile else {
            "sha256": hash_file(path), "bytes": path.stat().st_size}
        if not output.volatile:
            entry |= describe(path)
        described = {"unit": output.unit, "space": output.space, "colour_space": output.colour_space}
        entries[name] = entry | {key: value for key, value in described.items() if value}
    missing = [o.path for o in stage.outputs if not o.optional and not any(o.matches(name) for name in entries)]
    if missing:
        raise LimnError(f"{stage.name}: did not write {', '.join(missing)} (declare optional=True what may be absent)")
    return entries


def read_record(path: Path) -> dict | None:
    """A manifest or provenance; None where it is absent or not readable as one."""
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None
    return record if isinstance(record, dict) else None


def read_manifest(folder: Path) -> dict | None:
    """The folder's manifest; None where it is absent or damaged, or the folder is a link."""
    manifest = None if folder.is_symlink() else read_record(folder / MANIFEST)
    return manifest if manifest is not None and _is_manifest(manifest) else None


def _is_manifest(record: Mapping[str, object]) -> bool:
    """Whether the record has all that a manifest needs, each of its kind, and names files of its own folder only."""
    kinds = {"schema": int, "stage": str, "version": int, "parameters": dict, "inputs": dict, "outputs": dict}
    if not all(isinstance(record.get(name), kind) for name, kind in kinds.items()):
        return False
    for name, entry in record["outputs"].items():
        path = PurePosixPath(name)
        if not isinstance(entry, dict) or path.is_absolute() or not {"..", "."}.isdisjoint(name.split("/")):
            return False
        if not name.isprintable() or not entry.get("volatile") and not _is_hashed(entry):
            return False
    return True


def _is_hashed(entry: Mapping[str, object]) -> bool:
    return isinstance(entry.get("sha256"), str) and isinstance(entry.get("bytes"), int)


def write_record(path: Path, record: Mapping[str, object]) -> None:
    """JSON with sorted keys, one spelling of the same content."""
    path.write_text(json.dumps(record, indent=1, sort_keys=True, allow_nan=False) + "\n", encoding="utf-8")


def volatile_entries(folder: Path, outputs: Mapping[str, Mapping[str, object]]) -> dict[str, dict[str, object]]:
    """{file: entry} of the volatile outputs, for provenance.json: so that damage to them is seen, too."""
    return {name: {"bytes": (folder / name).stat().st_size, "sha256": hash_file(folder / name)}
            for name, entry in outputs.items() if entry.get("volatile")}


def _is_sound(path: Path, entry: Mapping[str, object], memory: HashMemory) -> bool:
    return path.stat().st_size == entry["bytes"] and memory.hash(path) == entry["sha256"]


def damage(folder: Path, manifest: Mapping[str, object], memory: HashMemory) -> list[str]:
    """What is wrong with the published files: missing, or no longer what the manifest says, of volatile ones what
    provenance.json says."""
    provenance = read_record(folder / PROVENANCE)
    if provenance is None:
        return [f"file {PROVENANCE} is missing or damaged"]
    written = provenance.get("volatile")
    faults = []
    for name, entry in manifest["outputs"].items():
        path = folder / name
        if entry.get("volatile"):
            entry = written.get(name) if isinstance(written, dict) else None
        if path.is_symlink() or not path.is_file():
            faults.append(f"file {name} is missing")
        elif not isinstance(entry, dict) or not _is_hashed(entry):
            faults.append(f"file {name} is not on record")
        elif not _is_sound(path, entry, memory):
            faults.append(f"file {name} is damaged")
    if len(faults) > 2:
        faults[2:] = [f"{len(faults) - 2} more files missing or damaged"]
    return faults
