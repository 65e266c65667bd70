"""Snakemake's command line as a process that ends with its work: `python -m tools.cli.snakemake_process ...`.

Its scheduler leaves a timer of a second behind, for which the interpreter would wait.
"""

from __future__ import annotations

from snakemake.cli import main as snakemake

from shared.contract.interpreter import leave


def main() -> int:
    """Snakemake's exit code."""
    try:
        snakemake()
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else int(end.code is not None)
    return 0


if __name__ == "__main__":
    leave(main(), wait=False)
