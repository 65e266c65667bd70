"""What is installed: every package with its licence, what it needs, and whether a run needs it. From metadata alone."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cache
from importlib import metadata

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = "limn"
_LONGEST_LICENCE = 80
# Words by which a licence's text or a loose name is known, most telling first.
_KNOWN = (
    ("GPL-3.0", r"\bGPL ?v?-?3|GNU GENERAL PUBLIC LICENSE\s+Version 3"), ("LGPL", r"\bLGPL|LESSER GENERAL PUBLIC"),
    ("GPL", r"\bGPL\b|GNU General Public"), ("MPL-2.0", r"MPL-?2|Mozilla Public License"),
    ("Apache-2.0", r"Apache"), ("BSD-3-Clause", r"BSD[- ]3|Neither the name|3-Clause"),
    ("BSD", r"\bBSD\b|Redistributions of"), ("MIT", r"\bMIT\b|Permission is hereby granted, free of charge"),
    ("PSF-2.0", r"\bPSF\b|Python Software Foundation"), ("Public Domain", r"Public Domain|Unlicense|CC0"),
)
_COPYLEFT = re.compile(r"(?<!L)(?<!Lesser )\bA?GPL", re.IGNORECASE)


@dataclass(frozen=True)
class Package:
    """An installed distribution. scope: run (what a run imports or starts), tests, dev or cluster."""

    name: str
    version: str
    licence: str
    needs: tuple[str, ...]
    scope: str

    @property
    def is_copyleft(self) -> bool:
        """Whether its licence would spread to what is distributed with it, and leaves no other choice."""
        choices = re.split(r"\s+OR\s+|, ", self.licence)
        return all(_COPYLEFT.search(choice) for choice in choices)


TESTS_ONLY = frozenset({"pymeshlab"})
"""An independent judge of meshes for tests; nothing else imports it."""
EXTRAS = ("dev", "cluster")


def installed() -> list[Package]:
    """All packages, by name."""
    found = {canonicalize_name(item.name): item for item in metadata.distributions() if item.name}
    needs = {name: _needs(item, found) for name, item in found.items()}
    runs = _reached([name for name in needs.get(ROOT, ()) if name not in TESTS_ONLY], needs) | {ROOT}
    extra = {group: _reached(_needs_of_extra(group, found), needs) for group in EXTRAS}
    packages = []
    for name, item in sorted(found.items()):
        scope = "run" if name in runs else "tests" if name in TESTS_ONLY else next(
            (group for group in EXTRAS if name in extra[group]), "other")
        packages.append(Package(item.name, item.version, licence_of(item), tuple(sorted(needs[name])), scope))
    return packages


def licence_of(item: metadata.Distribution) -> str:
    """The licence as the metadata states it, else as its text reads; 'unknown' where there is neither."""
    facts = item.metadata
    stated = (facts.get("License-Expression") or "").strip()
    if stated:
        return stated
    loose = (facts.get("License") or "").strip()
    classifiers = [text.rpartition("::")[2].strip() for text in facts.get_all("Classifier") or ()
                   if text.startswith("License ::") and not text.endswith("OSI Approved")]
    if loose and len(loose) <= _LONGEST_LICENCE:
        return _named(loose) or loose
    if classifiers:
        return ", ".join(dict.fromkeys(_named(text) or text for text in classifiers))
    texts = [loose, *_licence_texts(item)]
    return next((name for name in map(_named, texts) if name), "unknown")


def _licence_texts(item: metadata.Distribution) -> list[str]:
    names = [file for file in item.files or () if re.search(r"licen[cs]e|copying", file.name, re.IGNORECASE)]
    return [text for file in names if ".dist-info" in str(file) and (text := _read(file))]


def _read(file: metadata.PackagePath) -> str:
    try:
        return file.read_text(encoding="utf-8")
    except (OSError, ValueError):
        return ""


def _named(text: str) -> str:
    return next((name for name, pattern in _KNOWN if re.search(pattern, text)), "")


@cache
def _environment(extra: str) -> dict[str, str]:
    return {"extra": extra}


def _needs(item: metadata.Distribution, found: dict[str, metadata.Distribution], extra: str = "") -> set[str]:
    """Names of what it requires here, as far as that is installed."""
    wanted = set()
    for text in item.requires or ():
        requirement = Requirement(text)
        if requirement.marker is None or requirement.marker.evaluate(_environment(extra)):
            wanted.add(canonicalize_name(requirement.name))
    return wanted & found.keys()


def _needs_of_extra(extra: str, found: dict[str, metadata.Distribution]) -> set[str]:
    return _needs(found[ROOT], found, extra) - _needs(found[ROOT], found) if ROOT in found else set()


def _reached(names: object, needs: dict[str, set[str]]) -> set[str]:
    reached, waiting = set(), list(names)
    while waiting:
        name = waiting.pop()
        if name not in reached:
            reached.add(name)
            waiting += needs[name]
    return reached
