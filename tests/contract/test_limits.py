"""A stage that takes far more memory or time than expected is ended with one line; all others go on."""

import os

import pytest
from toy_runs import copy_pipeline, limn, make_subject, tree

from shared.contract.folders import RunFolder
from shared.contract.limits import EXPECTED_MB, EXPECTED_MINUTES, FACTOR, LEAST_MB, Limits, hold_to_limits
from shared.errors import InputError

BY_DECODER = "import ctypes; hog = bytearray(b'x' * 500_000_000); ctypes.PyDLL(None).sleep(60)"
"""As decoders do: the interpreter's lock is held all the while."""
BY_CHILD = ("import subprocess, sys; code = \"hog = bytearray(b'x' * 500_000_000); import time; time.sleep(60)\"; "
            "subprocess.run([sys.executable, '-c', code])")
ASLEEP = "import time; time.sleep(60)"


def spoilt_pipeline(folder, code, needs):
    """The toy pipeline, whose first stage does this where its text is the word `spoil`."""
    pipeline = copy_pipeline(folder)
    stage = folder / "toy" / "read_text.py"
    source = stage.read_text()
    marker = '    if "no face" in text:'
    assert marker in source
    stage.write_text(source.replace(marker, f'    if text == "spoil":\n        {code}\n{marker}'))
    settings = pipeline.read_text()
    pipeline.write_text(settings.replace("read_text: {needs: []}", f"read_text: {{needs: [], resources: {needs}}}"))
    return pipeline


CASES = {
    "memory": (BY_DECODER, "{mem_mb: 60}", "0.08", "limit of 240 MB"),
    "memory of a child": (BY_CHILD, "{mem_mb: 60}", "0.08", "limit of 240 MB"),
    "minutes": (ASLEEP, "{runtime: 1}", "0.002", "limit of 0.02 minutes"),
}


@pytest.mark.parametrize("name", CASES)
def test_a_stage_beyond_its_limit_ends_with_one_line(tmp_path, name):
    code, needs, factor, words = CASES[name]
    pipeline = spoilt_pipeline(tmp_path / "pipeline", code, needs)
    subject = make_subject(tmp_path / "subjects" / "spoilt", text="spoil")
    sound = make_subject(tmp_path / "subjects" / "sound")
    arguments = ("--pipeline", pipeline, "--trust", pipeline.parent, "--out", tmp_path / "out", "--cores", "2")
    both = (subject, sound) if "memory" in name else (subject,)
    exit_code, output = limn("run", *both, *arguments, **{FACTOR: factor})
    assert (tmp_path / "out" / "sound" / "export" / "manifest.json").is_file() or sound not in both
    assert exit_code == 1 and "Traceback" not in output
    line = next(line for line in output.splitlines() if words in line)
    assert "read_text" in line and FACTOR in line and "pipeline.yaml" in line
    left = tree(tmp_path / "out" / "spoilt" / "work")
    assert "read_text.failed/log.txt" in left and not any("tmp-" in path for path in left)
    assert words in (tmp_path / "out" / "spoilt" / "work" / "read_text.failed" / "log.txt").read_text()


def test_without_limits_it_goes_on(tmp_path):
    pipeline = spoilt_pipeline(tmp_path / "pipeline", "hog = bytearray(b'x' * 500_000_000); import time; time.sleep(1)",
                               "{mem_mb: 60}")
    subject = make_subject(tmp_path / "subject", text="spoil")
    arguments = ("--pipeline", pipeline, "--trust", pipeline.parent, "--out", tmp_path / "out")
    exit_code, output = limn("run", subject, *arguments, **{FACTOR: "0"})
    assert exit_code == 0, output


def test_where_no_process_can_watch_the_stage_goes_on(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv(EXPECTED_MB, "1500")
    monkeypatch.setattr(os, "pidfd_open", lambda _: (_ for _ in ()).throw(PermissionError("forbidden")))
    hold_to_limits("read_text", RunFolder(tmp_path), None)
    assert "not held" in capsys.readouterr().err


def test_limits_follow_what_is_expected(monkeypatch):
    monkeypatch.delenv(FACTOR, raising=False)
    monkeypatch.setenv(EXPECTED_MB, "1500")
    monkeypatch.delenv(EXPECTED_MINUTES, raising=False)
    limits = Limits.from_environment()
    assert limits and limits.memory_mb == 6000 and limits.minutes is None
    assert "6000 MB" in limits.fault(6001, 0) and not limits.fault(5999, 1e9)
    monkeypatch.setenv(EXPECTED_MINUTES, "5")
    monkeypatch.setenv(FACTOR, "2")
    assert Limits.from_environment() == Limits(12000, 100)
    assert "100 minutes" in Limits.from_environment().fault(0, 101)
    monkeypatch.setenv(EXPECTED_MB, "100")
    assert Limits.from_environment().memory_mb == 2 * LEAST_MB
    monkeypatch.setenv(FACTOR, "0")
    assert not Limits.from_environment()


@pytest.mark.parametrize("text", ["much", "-1", "nan", "inf", ""])
def test_a_factor_that_is_none_is_one_line(monkeypatch, text):
    monkeypatch.setenv(FACTOR, text)
    with pytest.raises(InputError, match=FACTOR):
        Limits.from_environment()
