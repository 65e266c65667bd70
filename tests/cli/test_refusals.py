"""What the system refuses, and names that lead nowhere: one line, exit code 2, and no other subject is stopped."""

import pytest
from toy_runs import make_subject

from shared.errors import InputError
from tools.cli.engine import profile_folder
from tools.cli.workflow import default_summary
from tools.limn import main

LONG = "x" * 300


@pytest.mark.parametrize("arguments", [
    ["validate", LONG], ["plan", LONG], ["check", LONG], ["turntable", LONG], ["new", LONG],
    ["plan", "anna", "--pipeline", LONG], ["parameters", "--pipeline", LONG],
    ["overview", "anna", "--page", "file/page.html"], ["run", "anna", "--summary", "file/summary.json"],
    ["run", "anna", "--profile", "no_such_profile"]], ids=lambda words: " ".join(words).replace(LONG, "LONG"))
def test_names_that_lead_nowhere_are_one_line(tmp_path, monkeypatch, capsys, arguments):
    make_subject(tmp_path / "anna")
    (tmp_path / "file").write_text("")
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    error = capsys.readouterr().err
    assert error.startswith("limn: ") and error.count("\n") == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["anna", "file"]
    assert not (tmp_path / "anna" / "work").exists()


def test_a_name_too_long_stops_no_other_subject(pipeline, tmp_path, capsys):
    subject = make_subject(tmp_path / "anna")
    assert main(["plan", LONG, str(subject), "--pipeline", str(pipeline)]) == 2
    out, err = capsys.readouterr()
    assert "anna" in out and err.count("\n") == 1


def test_profiles_are_this_repository_s_folders_or_those_of_snakemake(tmp_path, monkeypatch):
    assert profile_folder("slurm").endswith("profiles/slurm")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    (tmp_path / "mine").mkdir()
    (tmp_path / "config" / "snakemake" / "ours").mkdir(parents=True)
    assert profile_folder("mine") == str(tmp_path / "mine")
    assert profile_folder("ours") == str(tmp_path / "config" / "snakemake" / "ours")
    with pytest.raises(InputError, match="no such profile; got theirs; expected generic, slurm or a folder"):
        profile_folder("theirs")


def test_a_summary_needs_a_folder(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="lies in no folder"):
        default_summary([tmp_path], None, tmp_path / "file" / "summary.json")
    assert default_summary([tmp_path], None, tmp_path / "new" / "summary.json") == tmp_path / "new" / "summary.json"
