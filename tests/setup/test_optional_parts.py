"""tools.setup.test_all: what is there is left alone, and what cannot be installed is named with its reason."""

import sys

from tools.setup import test_all as optional


def part(folder, script, name="Teapot"):
    """A part that is there once folder/done is."""
    return optional.OptionalPart(name, (folder / "done").exists, ((sys.executable, "-c", script),))


def test_installed_once(tmp_path):
    count = f"from pathlib import Path; p = Path({str(tmp_path)!r}, 'done'); p.write_text('x'); print('ran')"
    assert optional.install(part(tmp_path, count)) == ""
    assert optional.install(part(tmp_path, "raise SystemExit('ran again')")) == ""


def test_failures_are_named(tmp_path, monkeypatch):
    monkeypatch.setattr(optional.shutil, "which", lambda name: None)
    absent = optional.OptionalPart("Kettle", (tmp_path / "done").exists, (("no-such-program-of-limn",),))
    monkeypatch.setattr(optional, "PARTS", (
        part(tmp_path, "raise SystemExit('E: no package teapot')"), part(tmp_path, "pass", "Cup"), absent))
    teapot, cup, kettle = optional.failures()
    assert teapot == "could not install: Teapot (E: no package teapot)"
    assert cup == "could not install: Cup (installed, but it does not load)"
    assert kettle.startswith("could not install: Kettle (") and "no-such-program-of-limn" in kettle


def test_callers_choice_goes_first(monkeypatch):
    monkeypatch.setenv(optional.MITSUBA_VARIABLE, "scalar_rgb")
    monkeypatch.setenv("LIMN_SLOW_TESTS", "0")
    found = optional.environment()
    assert found[optional.MITSUBA_VARIABLE] == "scalar_rgb" and found["LIMN_SLOW_TESTS"] == "1"
