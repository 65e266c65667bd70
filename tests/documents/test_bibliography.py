"""What the code cites is in the bibliography, and the bibliography holds nothing else."""

import ast
import re

import pytest

from shared.report.references import REFERENCES
from tools.documents.readme import README

REPOSITORY = README.parent
FILES = sorted(path for package in ("shared", "stages", "tools") for path in (REPOSITORY / package).rglob("*.py")
               if path.name != "references.py")
_CITED = re.compile(r"\[([A-Z][a-z]+(?:19|20)\d\d)\]")
_IN_TEXT = re.compile(r"[{\"]([A-Z][a-z]+(?:19|20)\d\d)[}\"]")
_UNKEYED = re.compile(r"\bet al\b|\b[A-Z][a-z]+(?: and [A-Z][a-z]+)?,? \(?(?:19|20)\d\d\b")
_MONTHS = "January|February|March|April|May|June|July|August|September|October|November|December"


def cited_keys(path):
    text = path.read_text(encoding="utf-8")
    return set(_CITED.findall(text)) | set(_IN_TEXT.findall(text))


def docstrings(path):
    nodes = ast.walk(ast.parse(path.read_bytes()))
    kinds = ast.Module, ast.ClassDef, ast.FunctionDef
    return [text for node in nodes if isinstance(node, kinds) and (text := ast.get_docstring(node))]


def test_every_key_is_in_the_bibliography():
    unknown = {path.name: keys for path in FILES if (keys := cited_keys(path) - REFERENCES.keys())}
    assert unknown == {}


def test_every_entry_is_cited_and_there_once():
    assert REFERENCES.keys() - set().union(*map(cited_keys, FILES)) == set()
    assert len(set(REFERENCES.values())) == len(REFERENCES) and list(REFERENCES) == sorted(REFERENCES)


@pytest.mark.parametrize("key", REFERENCES)
def test_a_key_is_the_first_author_and_the_year(key):
    author, year = key[:-4], key[-4:]
    plain = REFERENCES[key].translate(str.maketrans({"ö": "oe", "ü": "ue"}))
    assert plain.replace("Moelder", "Molder").lower().startswith(author.lower()) and year in REFERENCES[key]


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.relative_to(REPOSITORY).as_posix())
def test_docstrings_cite_by_key(path):
    found = [match.group() for text in docstrings(path) for match in _UNKEYED.finditer(text)]
    assert [text for text in found if not re.match(_MONTHS, text)] == []
