"""`limn check` looks into the files of a head's export: sound ones, faulty ones, older ones."""

import shutil

import numpy as np
import pytest
from toy_export import write_toy_export

from shared.contract.sums import SUMS, write_sums
from shared.io.arrays import write_json
from shared.io.images import write_exr
from stages.export_usd import STAGE
from tools.limn import main


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    return write_toy_export(tmp_path_factory.mktemp("head"), plates=False, usdz=False)


@pytest.fixture
def export(original, tmp_path):
    return shutil.copytree(original, tmp_path / "anna" / "export")


def spoil(export):
    """A map that is published with values that no roughness has."""
    write_exr(export / "maps" / "roughness.exr", np.full((16, 16), 1.5), colour_space="data",
              attributes={"unit": "square root of GGX alpha", "content": "roughness"})


def check(capsys, *arguments):
    """(exit code, lines of stdout, lines of stderr)"""
    code = main(["check", *map(str, arguments)])
    out, err = capsys.readouterr()
    return code, out.splitlines(), err.splitlines()


def test_a_sound_export_is_a_line(export, capsys):
    code, lines, faults = check(capsys, export)
    assert code == 0 and faults == []
    assert lines[0] == f"{export}: not checked: head.usdz (not in this export)"
    assert lines[1].startswith(f"{export}: ") and "7 maps of 16 px" in lines[1] and len(lines) == 2
    assert check(capsys, export.parent)[1] == check(capsys, export.parents[1])[1] == lines


def test_a_fault_says_what_where_and_how_to_mend_it(export, capsys):
    spoil(export)
    write_sums(export)
    code, lines, faults = check(capsys, export)
    assert code == 2 and not any("as published" in line for line in lines)
    assert faults == [f"limn: {export}/maps/roughness.exr: values up to 1.5, expected at most 1; export again: "
                      "python -m stages.export_usd --subject SUBJECT --force"]
    assert check(capsys, export, "--hashes")[0] == 0


def test_what_is_not_as_published_is_one_line_and_stays_closed(export, capsys):
    spoil(export)
    code, lines, faults = check(capsys, export)
    assert code == 2 and len(faults) == 1 and "not as it was published" in faults[0]
    unchecked = ["maps/roughness.exr (not as published)", "head.usda (maps/roughness.exr is not as published)",
                 "head.usdz (not in this export)"]
    assert lines == [f"{export}: not checked: {', '.join(unchecked)}"]
    (export / "maps" / "roughness.exr").unlink()
    code, again, faults = check(capsys, export)
    assert code == 2 and again == lines and faults == [f"limn: {export}/maps/roughness.exr: the file is missing"]


def test_exports_of_older_versions_are_checked_as_far_as_they_go(export, capsys):
    """Version 6 of today's files passes; version 3 wrote no hashes, no units and no index of refraction."""
    write_json(export / "manifest.json", {"stage": "export_usd", "version": STAGE.version - 1})
    write_sums(export)
    code, lines, faults = check(capsys, export)
    assert (code, faults) == (0, []) and f"export_usd {STAGE.version - 1} wrote it, this is {STAGE.version}" in lines[0]
    (export / SUMS).unlink()
    code, lines, faults = check(capsys, export)
    assert code == 2 and "no SHA256SUMS here" in faults[0]
    write_json(export / "manifest.json", {"stage": "export_usd", "version": 3})
    code, lines, faults = check(capsys, export.parent)
    assert (code, faults) == (0, []) and "no SHA256SUMS (export_usd 3 wrote none)" in lines[-1]
    spoil(export)
    assert "values up to 1.5" in check(capsys, export)[2][0]


def test_one_faulty_export_does_not_hide_the_others(original, export, capsys):
    spoil(export)
    write_sums(export)
    code, lines, faults = check(capsys, export, original)
    assert code == 2 and len(faults) == 1 and str(original) in lines[-1] and "as published" in lines[-1]


def test_what_nobody_published_stays_closed(export, capsys):
    (export / "head.usdz").write_bytes(b"PK")
    (export / "maps" / "extra.exr").symlink_to("/dev/zero")
    code, lines, faults = check(capsys, export)
    assert (code, faults) == (0, [])
    assert "not checked: head.usdz, maps/extra.exr" in lines[0]
    assert "head.usdz (not as published)" in lines[1] and "as published" in lines[2]
