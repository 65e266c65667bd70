"""Licences, integrity and known vulnerabilities of what is installed.

    python -m tools.setup.audit [--sbom FILE] [--advisories PATH] [--quick]

Needs no network. Vulnerabilities are matched against advisories in the OSV format that lie on disk: a folder of JSON
files or a zip of them (osv.dev offers one for all of PyPI); without --advisories that part is said to be left out.
Every installed file is compared with the hash that its package's RECORD states (--quick: not).
Exit code 1 for a licence that a commercial user could not accept among what a run needs, for files that were changed,
and for known vulnerabilities.
"""

from __future__ import annotations

import argparse
import base64
import hashlib
import json
import mmap
import sys
import zipfile
from collections.abc import Iterable, Iterator, Sequence
from importlib import metadata
from pathlib import Path

from packaging.utils import canonicalize_name
from packaging.version import InvalidVersion, Version

from shared.errors import InputError
from tools.setup.packages import Package, installed
from tools.setup.sbom import write_sbom

COPYLEFT_LIBRARIES = {
    "libx264": "GPL-2.0", "libx265": "GPL-2.0", "libxvidcore": "GPL-2.0", "libpostproc": "GPL-2.0",
    "libreadline": "GPL-3.0", "libgsl": "GPL-3.0", "libCGAL": "GPL-3.0", "libfftw3": "GPL-2.0",
}
BUILT_IN = {
    b"/CHOLMOD/Supernodal/": "CHOLMOD's Supernodal (GPL-2.0-or-later), built in",
    b"/CHOLMOD/MatrixOps/": "CHOLMOD's MatrixOps (GPL-2.0-or-later), built in",
    b"/SPQR/Source/": "SPQR (GPL-2.0-or-later), built in",
}
"""Paths of sources that a compiler leaves in what it makes."""


def main(arguments: list[str] | None = None) -> int:
    """Prints the table and the findings."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sbom", type=Path, metavar="FILE", help="write a CycloneDX bill of materials")
    parser.add_argument("--advisories", type=Path, metavar="PATH", help="advisories in the OSV format, folder or zip")
    parser.add_argument("--quick", action="store_true", help="do not read every installed file")
    options = parser.parse_args(arguments)
    packages = installed()
    print("\n".join([*table_lines(packages), *bundled_notes()]))
    try:
        findings = [*licence_findings(packages), *([] if options.quick else changed_files())]
        if options.advisories:
            findings += vulnerabilities(packages, read_advisories(options.advisories))
        else:
            print("vulnerabilities: left out, no --advisories given")
        if options.sbom:
            options.sbom.parent.mkdir(parents=True, exist_ok=True)
            write_sbom(options.sbom, packages)
            print(f"bill of materials: {options.sbom}")
    except InputError as error:
        print(f"audit: {error}", file=sys.stderr)
        return 2
    for finding in findings:
        print(f"FINDING: {finding}")
    print(f"{len(packages)} packages, {len(findings)} findings")
    return 1 if findings else 0


def table_lines(packages: Iterable[Package]) -> list[str]:
    """Name, version, scope, licence."""
    rows = [("package", "version", "scope", "licence"), *((p.name, p.version, p.scope, p.licence) for p in packages)]
    widths = [max(len(row[i]) for row in rows) for i in range(3)]
    return ["  ".join([*(cell.ljust(width) for cell, width in zip(row, widths, strict=False)), row[3]]) for row in rows]


def licence_findings(packages: Iterable[Package]) -> list[str]:
    """Packages that a run needs whose licence is unknown or strongly copyleft."""
    return [f"{p.name} {p.version}: licence {p.licence}, and a run needs it" for p in packages
            if p.scope == "run" and (p.is_copyleft or p.licence == "unknown")]


def bundled_notes() -> list[str]:
    """Copyleft libraries that wheels bring along, as files or built in, which their metadata does not say.

    It matters to whoever passes an installation on; docs/licences.md says what it means.
    """
    notes = []
    for item in metadata.distributions():
        libraries = [Path(file.locate()) for file in item.files or () if ".so" in file.name]
        found = [note for path in libraries if (note := _as_file(path, libraries))]
        found += sorted({BUILT_IN[mark] for path in libraries for mark in marks_in(path, BUILT_IN)})
        if found:
            notes.append(f"note: {item.name} {item.version} brings {'; '.join(found)}")
    return sorted(notes)


def _as_file(path: Path, siblings: Sequence[Path]) -> str:
    """What a library's name says of its licence, and which libraries beside it load it; '' where it says nothing."""
    name = path.name.partition("-")[0].partition(".")[0]
    if name not in COPYLEFT_LIBRARIES:
        return ""
    users = sorted(other.name.partition("-")[0] for other in siblings
                   if other != path and marks_in(other, [path.name.encode()]))
    return f"{name} ({COPYLEFT_LIBRARIES[name]})" + (f", loaded with {', '.join(users)}" if users else "")


def marks_in(path: Path, marks: Iterable[bytes]) -> list[bytes]:
    """Those byte strings that a file holds; none where it cannot be read."""
    try:
        with open(path, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            return [mark for mark in marks if data.find(mark) >= 0]
    except (OSError, ValueError):  # gone, or empty
        return []


def changed_files() -> list[str]:
    """Installed files that are missing or not what their package's RECORD says."""
    findings = []
    for item in metadata.distributions():
        for file in item.files or ():
            if file.hash is None or file.suffix == ".pyc":
                continue
            try:
                digest = hashlib.new(file.hash.mode, Path(file.locate()).read_bytes()).digest()
            except OSError:
                findings.append(f"{item.name} {item.version}: {file} is missing")
                continue
            if base64.urlsafe_b64encode(digest).rstrip(b"=").decode() != file.hash.value:
                findings.append(f"{item.name} {item.version}: {file} was changed since it was installed")
    return findings


def read_advisories(path: Path) -> Iterator[dict]:
    """Advisories of a folder or a zip; InputError where there is neither."""
    try:
        if path.is_dir():
            for file in sorted(path.rglob("*.json")):
                yield json.loads(file.read_text(encoding="utf-8"))
        else:
            with zipfile.ZipFile(path) as archive:
                for name in sorted(archive.namelist()):
                    yield json.loads(archive.read(name))
    except (OSError, ValueError, zipfile.BadZipFile) as error:
        raise InputError("no advisories that can be read", where=str(path), got=error,
                         expected="a folder or a zip of OSV JSON files") from error


def vulnerabilities(packages: Iterable[Package], advisories: Iterable[dict]) -> list[str]:
    """Advisories that hold for an installed version and were not withdrawn."""
    here = {canonicalize_name(package.name): package for package in packages}
    findings = []
    for advisory in advisories:
        for affected in advisory.get("affected", ()) if not advisory.get("withdrawn") else ():
            about = affected.get("package", {})
            package = here.get(canonicalize_name(about.get("name", ""))) if about.get("ecosystem") == "PyPI" else None
            if package and is_affected(package.version, affected):
                text = f"{package.name} {package.version}: {advisory.get('id')} {advisory.get('summary', '')}".strip()
                findings.append(text)
    return sorted(set(findings))


def is_affected(version: str, affected: dict) -> bool:
    """Whether a version is listed, or lies in one of the ranges (OSV schema, `affected`)."""
    public = version.partition("+")[0]
    if public in affected.get("versions", ()):
        return True
    ranges = [found for found in affected.get("ranges", ()) if found.get("type") == "ECOSYSTEM"]
    return any(_in_range(Version(public), found.get("events", ())) for found in ranges)


def _in_range(version: Version, events: Iterable[dict]) -> bool:
    """OSV's evaluation: events in order of their versions; introduced opens, fixed and last_affected close."""
    ordered = []
    for event in events:
        for kind, text in event.items():
            try:
                ordered.append((Version("0" if text == "0" else text), kind))
            except InvalidVersion:
                continue
    inside = False
    for at, kind in sorted(ordered, key=lambda entry: entry[0]):
        if kind == "introduced" and version >= at:
            inside = True
        elif (kind == "fixed" and version >= at) or (kind == "last_affected" and version > at):
            inside = False
    return inside


if __name__ == "__main__":
    raise SystemExit(main())
