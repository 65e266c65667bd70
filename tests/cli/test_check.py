"""SHA256SUMS of a published result, and `limn check` on copies of it."""

import os
import shutil
import subprocess
import sys

import pytest
from toy_runs import REPOSITORY, tree

from shared.contract.hashing import hash_file
from shared.contract.sums import SUMS, read_sums
from shared.errors import InputError
from tools.limn import main


@pytest.fixture
def published(toy_run):
    """A finished toy run's folder."""
    return toy_run[0]


@pytest.fixture
def export(published, tmp_path):
    """A copy of its export folder alone, elsewhere, under another name."""
    return shutil.copytree(published / "export", tmp_path / "delivery")


def faults(capsys, *folders):
    """The lines on stderr of a check that finds something."""
    assert main(["check", *map(str, folders)]) == 2
    return capsys.readouterr().err.splitlines()


def test_list_covers_every_file_and_reads_as_others_write_it(published):
    export = published / "export"
    sums = read_sums(export)
    assert set(sums) == {name for name in tree(export) if name != SUMS} >= {"manifest.json", "log.txt", "report.html"}
    assert not (published / "work" / "read_text" / SUMS).exists()
    if shutil.which("sha256sum"):
        subprocess.run(["sha256sum", "--check", "--strict", "--quiet", SUMS], cwd=export, check=True)


def test_a_copy_anywhere_passes(published, export, capsys):
    assert main(["check", str(export), str(published), str(published.parent)]) == 0
    out, digest = capsys.readouterr().out, hash_file(export / SUMS)
    assert out.count("files are as published") == 3 and out.count(digest) == 3 and str(export) in out


def test_check_needs_nothing_but_the_folder(export, tmp_path):
    code = "import sys; from tools.limn import main; code = main(['check', sys.argv[1]]);" \
           "assert not {'numpy', 'cv2', 'stages'} & set(sys.modules); sys.exit(code)"
    environment = {"PYTHONPATH": str(REPOSITORY), "HOME": "/nonexistent"}
    subprocess.run([sys.executable, "-c", code, str(export)], cwd=tmp_path, env=environment, check=True)


@pytest.mark.parametrize("name", ["page.txt", "report.html", "manifest.json", "provenance.json", "log.txt"])
def test_every_kind_of_damage_is_a_line(export, capsys, name):
    data = bytearray((export / name).read_bytes())
    data[len(data) // 2] ^= 1
    (export / name).write_bytes(data)
    lines = faults(capsys, export)
    assert len(lines) == 1 and f"{export / name}: the file is not as it was published" in lines[0]
    (export / name).unlink()
    assert faults(capsys, export) == [f"limn: {export / name}: the file is missing"]


def test_links_are_no_files(export, tmp_path, capsys):
    (export / "page.txt").rename(tmp_path / "page.txt")
    (export / "page.txt").symlink_to(tmp_path / "page.txt")
    assert faults(capsys, export) == [f"limn: {export / 'page.txt'}: a link in place of the file"]
    (export / "page.txt").unlink()
    os.mkfifo(export / "page.txt")
    assert "the file is missing" in faults(capsys, export)[0]


def test_what_is_not_listed_is_said_and_no_fault(export, capsys):
    (export / "note.txt").write_text("seen by me")
    assert main(["check", str(export)]) == 0
    assert f"{export}: not published with it, not checked: note.txt" in capsys.readouterr().out


@pytest.mark.parametrize("line, hint", [
    ("", "no list of hashes"), ("0" * 63 + "  page.txt", "not a hash and a file"),
    ("page.txt", "not a hash and a file"), ("\x00\xff", "not a hash and a file"),
    *(("0" * 64 + f"  {name}", "not a file of this folder")
      for name in ("../page.txt", "/etc/passwd", "a//b", "a\tb\x07"))])
def test_lists_from_strangers(export, capsys, line, hint):
    (export / SUMS).write_text(line)
    lines = faults(capsys, export)
    assert len(lines) == 1 and hint in lines[0] and SUMS in lines[0]


def test_a_name_that_no_disk_can_hold(export, capsys):
    (export / SUMS).write_text("0" * 64 + "  " + "n" * 300)
    assert "cannot be read" in faults(capsys, export)[0]


def test_one_bad_export_does_not_hide_the_others(published, export, tmp_path, capsys):
    (export / "page.txt").unlink()
    empty = tmp_path / "empty"
    empty.mkdir()
    assert main(["check", str(empty), str(export), str(tmp_path / "gone"), str(published)]) == 2
    out, err = capsys.readouterr()
    assert out.count("\n") == 1 and str(published) in out and err.count("\n") == 3
    assert "no SHA256SUMS here" in err and "no such folder" in err and "page.txt: the file is missing" in err


def test_a_list_that_is_no_text_or_a_link(export, tmp_path):
    (export / SUMS).write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="cannot be read as a list of hashes"):
        read_sums(export)
    (export / SUMS).rename(tmp_path / SUMS)
    (export / SUMS).symlink_to(tmp_path / SUMS)
    with pytest.raises(InputError, match="no SHA256SUMS here"):
        read_sums(export)
