"""What a stage is: its declaration, its command line, its manifest. Imports nothing heavy.

A stage file declares `STAGE = Stage(...)`, defines `run(job)` and `check(job)` and ends with
`raise SystemExit(main(STAGE, run, check))`. Keep torch, cv2 and the like out of its top level (import them where they
are used): a stage whose result is current then answers at once.

Read in this order: wording, declare, records, shapes, chart_place, grey_place, confine, subject, models, hashing,
manifest, folders, needs, source, pipeline, progress, job, currency, drift, machine, provenance, sums, disk, limits,
cache_folder, interpreter, request, execute, cli, launch, fork_server, fork_client.
May import: errors.
"""

from shared.contract.cli import main
from shared.contract.declare import Output, Parameter, ParameterGroup, Stage
from shared.contract.job import Job
from shared.contract.subject import Subject, load_subject

__all__ = ["Job", "Output", "Parameter", "ParameterGroup", "Stage", "Subject", "load_subject", "main"]
