"""Puts a bench's tables between their marks in a document: <!-- NAME: command --> ... <!-- end of NAME -->."""

from __future__ import annotations

import argparse
import re
from pathlib import Path

from shared.errors import InputError


def add_document(parser: argparse.ArgumentParser) -> None:
    """The argument --document."""
    parser.add_argument("--document", type=Path, metavar="FILE", help="also write the tables between the marks of FILE")


def with_marked(text: str, name: str, content: str, where: str) -> str:
    """The text with this content between the marks of this name. InputError where it has no such marks."""
    start, end = rf"<!-- {re.escape(name)}(?::[^\n]*)? -->\n", rf"<!-- end of {re.escape(name)} -->\n"
    pattern = re.compile(rf"({start}).*?({end})", re.DOTALL)
    if len(pattern.findall(text)) != 1:
        raise InputError("no place for the tables", where=where, expected=f"one pair of marks of {name!r}",
                         hint="see docs/performance.md")  # fmt: skip
    return pattern.sub(lambda found: found[1] + content + found[2], text)


def write_marked(path: Path, name: str, content: str) -> None:
    """The same for a file. InputError where it cannot be read or has no such marks."""
    if not path.is_file():
        raise InputError("no such document", where="--document", got=path)
    path.write_text(with_marked(path.read_text(encoding="utf-8"), name, content, str(path)), encoding="utf-8")
