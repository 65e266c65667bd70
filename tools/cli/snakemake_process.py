"""Snakemake's command line as a process that ends with its work: `python -m tools.cli.snakemake_process ...`.

Its scheduler leaves a timer of a second behind, for which the interpreter would wait.
"""

from __future__ import annotations

import sys

from shared.contract.interpreter import leave

_UNUSED = ("numpy", "requests")
"""Imported where they are installed, but not needed, by what reads profiles and addresses: a quarter of a second before
the first stage starts. Plug-ins of a cluster may need them."""


def main() -> int:
    """Snakemake's exit code."""
    if "--profile" not in sys.argv:
        sys.modules.update(dict.fromkeys(_UNUSED))  # as if they were not installed
    from snakemake.cli import main as snakemake

    try:
        snakemake()
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else int(end.code is not None)
    return 0


if __name__ == "__main__":
    leave(main(), wait=False)
