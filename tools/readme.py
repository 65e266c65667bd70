"""Keeps the README's parameter table in step with the stages' declarations.

    python -m tools.readme     rewrites the table between its two marks
"""

from __future__ import annotations

from pathlib import Path

from shared.contract.declare import parameter_table
from shared.contract.pipeline import load_pipeline

README = Path(__file__).resolve().parents[1] / "README.md"
BEGIN, END = "<!-- parameters: limn parameters -->\n", "<!-- end of parameters -->\n"


def with_parameters(text: str) -> str:
    """The README's text with the table as the stages declare it now. ValueError when a mark is missing."""
    before, rest = text.split(BEGIN)
    _, after = rest.split(END)
    return before + BEGIN + parameter_table(list(load_pipeline(None).stages.values())) + END + after


def main() -> int:
    """Rewrites README.md."""
    README.write_text(with_parameters(README.read_text(encoding="utf-8")), encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
