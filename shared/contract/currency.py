"""Whether a published stage folder is the result of the work that is asked for, and why not."""

from __future__ import annotations

from collections.abc import Mapping

from shared.contract.declare import Stage
from shared.contract.folders import RunFolder
from shared.contract.hashing import HashMemory
from shared.contract.manifest import (
    Work,
    damage,
    make_work,
    outputs_digest,
    own_inputs,
    read_manifest,
)
from shared.contract.subject import Subject
from shared.errors import InputError


def input_hashes(stage: Stage, subject: Subject, run: RunFolder, parameters: Mapping[str, object],
                 memory: HashMemory) -> dict[str, str]:
    """{name: SHA-256} of all that the stage reads; InputError where an input stage has no sound result."""
    inputs = own_inputs(stage, subject, parameters, memory)
    for name, folder in run.inputs(stage, [clip.name for clip in subject.clips]).items():
        manifest = read_manifest(folder)
        faults = ["has no result yet"] if manifest is None else damage(folder, manifest, memory)
        if faults:
            raise InputError(f"input {name}: {faults[0]}", where=str(folder), hint="limn run makes it again")
        inputs[name] = outputs_digest(manifest)
    return inputs


def work_to_do(stage: Stage, subject: Subject, run: RunFolder, parameters: Mapping[str, object],
               memory: HashMemory) -> Work:
    """The stage's work on the inputs as they lie on disk."""
    return make_work(stage, parameters, input_hashes(stage, subject, run, parameters, memory))


def reasons_to_run(work: Work, run: RunFolder, memory: HashMemory) -> list[str]:
    """Why the stage has to run; empty where its folder is current."""
    folder = run.published(work.stage)
    manifest = read_manifest(folder)
    return work.reasons(manifest) or damage(folder, manifest, memory)
