"""Licences, advisories and the bill of materials, from the metadata of what is installed."""

import json
import re
import zipfile
from pathlib import Path

import pytest

from shared.errors import InputError
from tools.setup.audit import (
    bundled_notes,
    changed_files,
    is_affected,
    licence_findings,
    main,
    read_advisories,
    vulnerabilities,
)
from tools.setup.packages import Package, installed
from tools.setup.sbom import bill

PACKAGES = [Package("limn", "0.1.0", "Apache-2.0", ("toy-lib",), "run"),
            Package("toy_lib", "1.4.2", "MIT", (), "run"), Package("viral", "2.0", "GPL-3.0", (), "run"),
            Package("choice", "2.0", "BSD, GPL", (), "run"), Package("lesser", "1.0", "LGPL", (), "run"),
            Package("builder", "1.0", "GPL-3.0", (), "set-up"), Package("odd", "1.0", "unknown", (), "run")]


def advisory(**affected):
    return {"id": "TOY-1", "summary": "overflow", "affected": [
        {"package": {"ecosystem": "PyPI", "name": "Toy.Lib"}, **affected}]}


def events(*pairs):
    return {"ranges": [{"type": "ECOSYSTEM", "events": [dict([pair]) for pair in pairs]}]}


@pytest.mark.parametrize("affected, expected", [
    (events(("introduced", "0"), ("fixed", "1.4.3")), True), (events(("introduced", "0"), ("fixed", "1.4.2")), False),
    (events(("introduced", "1.5")), False), (events(("introduced", "1.0"), ("last_affected", "1.4.2")), True),
    (events(("introduced", "1.0"), ("last_affected", "1.4.1")), False), ({"versions": ["1.4.2"]}, True),
    (events(("introduced", "2.0"), ("fixed", "2.1"), ("introduced", "1.4"), ("fixed", "1.4.9")), True),
    ({"ranges": [{"type": "GIT", "events": [{"introduced": "0"}]}]}, False)])
def test_versions_against_ranges(affected, expected):
    assert is_affected("1.4.2+cpu", affected) is expected
    found = vulnerabilities(PACKAGES, [advisory(**affected)])
    assert found == (["toy_lib 1.4.2: TOY-1 overflow"] if expected else [])


def test_withdrawn_and_foreign_advisories_do_not_count():
    everything = events(("introduced", "0"))
    withdrawn = advisory(**everything) | {"withdrawn": "2026-01-01T00:00:00Z"}
    foreign = {"id": "X", "affected": [{"package": {"ecosystem": "npm", "name": "toy-lib"}, **everything}]}
    assert vulnerabilities(PACKAGES, [withdrawn, foreign]) == []


def test_advisories_come_from_a_folder_or_a_zip(tmp_path):
    given = advisory(**events(("introduced", "0")))
    (tmp_path / "TOY-1.json").write_text(json.dumps(given))
    with zipfile.ZipFile(tmp_path / "all.zip", "w") as archive:
        archive.writestr("TOY-1.json", json.dumps(given))
    assert list(read_advisories(tmp_path)) == list(read_advisories(tmp_path / "all.zip")) == [given]
    with pytest.raises(InputError, match="OSV JSON"):
        list(read_advisories(tmp_path / "gone.zip"))


def test_only_licences_that_bind_a_run_are_findings():
    assert [text.split()[0] for text in licence_findings(PACKAGES)] == ["viral", "odd"]


def test_installed_packages_have_known_licences(capsys, tmp_path):
    packages = {package.name: package for package in installed()}
    assert packages["numpy"].scope == "run" and packages["pytest"].scope == "dev"
    assert packages["pymeshlab"].scope == "tests" and packages["pymeshlab"].is_copyleft
    assert licence_findings(packages.values()) == []
    (tmp_path / "TOY-1.json").write_text(json.dumps({"id": "TOY-2", "affected": [
        {"package": {"ecosystem": "PyPI", "name": "numpy"}, **events(("introduced", "0"))}]}))
    arguments = ["--quick", "--advisories", str(tmp_path), "--sbom", str(tmp_path / "sub" / "sbom.json")]
    assert main(arguments) == 1 and f"FINDING: numpy {packages['numpy'].version}: TOY-2" in capsys.readouterr().out
    written = json.loads((tmp_path / "sub" / "sbom.json").read_text())
    assert {component["name"] for component in written["components"]} >= {"numpy", "torch", "snakemake"}


def test_bill_of_materials_is_consistent():
    made = bill(PACKAGES)
    refs = [component["bom-ref"] for component in (made["metadata"]["component"], *made["components"])]
    assert made["bomFormat"] == "CycloneDX" and len(set(refs)) == len(refs)
    edges = {edge["ref"]: edge["dependsOn"] for edge in made["dependencies"]}
    assert edges["pkg:pypi/limn@0.1.0"] == ["pkg:pypi/toy-lib@1.4.2"] and set(edges) <= set(refs)
    licences = {component["name"]: component["licenses"][0] for component in made["components"]}
    assert licences["toy_lib"] == {"expression": "MIT"} and licences["odd"] == {"license": {"name": "unknown"}}


def toy_distribution(folder, name, files):
    """An installed package of these files."""
    info = folder / f"{name}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    for path, data in files.items():
        (folder / path).parent.mkdir(exist_ok=True)
        (folder / path).write_bytes(data)
    (info / "RECORD").write_text("".join(f"{path},,\n" for path in files))


def test_copyleft_in_wheels_is_noted_with_what_loads_it(tmp_path, monkeypatch):
    toy_distribution(tmp_path, "decoder", {
        "decoder.libs/libx264-12ab.so.165": b"\x7fELF", "decoder.libs/libz-1.so": b"",
        "decoder.libs/libavcodec-34cd.so.62": b"..libx264-12ab.so.165.."})
    toy_distribution(tmp_path, "solver", {"solver/_core.so": b"/build/v7/CHOLMOD/Supernodal/cholmod_super_numeric.c"})
    toy_distribution(tmp_path, "plain", {"plain/_core.so": b"/build/CHOLMOD/Check/cholmod_check.c"})
    monkeypatch.setattr("sys.path", [str(tmp_path)])
    assert bundled_notes() == [
        "note: decoder 1.0 brings libx264 (GPL-2.0), loaded with libavcodec",
        "note: solver 1.0 brings CHOLMOD's Supernodal (GPL-2.0-or-later), built in"]


def test_the_page_on_licences_says_what_is_installed():
    text = (Path(__file__).resolve().parents[2] / "docs" / "licences.md").read_text(encoding="utf-8")
    for package in installed():
        if package.scope == "run" and not re.match(r"(Apache|BSD|MIT|PSF|ISC|Zlib)", package.licence):
            assert f"`{package.name}`" in text, package
    for note in bundled_notes():
        name, version = note.split()[1:3]
        assert f"`{name}` {version}" in text, note


def test_changed_files_are_noticed(tmp_path, monkeypatch):
    folder = tmp_path / "toy-1.0.dist-info"
    folder.mkdir()
    (tmp_path / "toy.py").write_text("x = 1\n")
    (folder / "METADATA").write_text("Metadata-Version: 2.1\nName: toy\nVersion: 1.0\n")
    (folder / "RECORD").write_text("toy.py,sha256=AAAA,6\ngone.py,sha256=AAAA,6\ntoy-1.0.dist-info/RECORD,,\n")
    monkeypatch.setattr("sys.path", [str(tmp_path)])
    assert changed_files() == ["toy 1.0: toy.py was changed since it was installed", "toy 1.0: gone.py is missing"]
