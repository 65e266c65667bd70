"""Where what is worth keeping lies: as told, else this user's own folder, else nowhere."""

import os

import pytest

from shared.contract import cache_folder as module
from shared.contract.cache_folder import VARIABLE, cache_folder


@pytest.fixture(autouse=True)
def bare(tmp_path, monkeypatch):
    """A user with a home and a folder for temporary files, and nothing set."""
    for name in (VARIABLE, "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setattr(module.tempfile, "gettempdir", lambda: str(tmp_path / "tmp"))
    (tmp_path / "tmp").mkdir()


def test_as_told(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv(VARIABLE, "kept")
    assert cache_folder() == str(tmp_path / "kept")
    monkeypatch.setenv(VARIABLE, "")
    assert cache_folder() == ""


def test_the_users_folder_for_caches(tmp_path, monkeypatch):
    assert cache_folder() == str(tmp_path / "home" / ".cache" / "limn")
    assert (tmp_path / "home" / ".cache" / "limn").stat().st_mode & 0o777 == 0o700
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "caches"))
    assert cache_folder() == str(tmp_path / "caches" / "limn")


@pytest.mark.parametrize("home", ["/proc/none", "relative"])
def test_without_a_home_a_folder_for_temporary_files_that_is_ours(tmp_path, monkeypatch, home):
    monkeypatch.setenv("HOME", home)
    expected = tmp_path / "tmp" / f"limn-{os.geteuid()}"
    assert cache_folder() == str(expected)
    expected.rmdir()
    (tmp_path / "elsewhere").mkdir()
    expected.symlink_to(tmp_path / "elsewhere")
    assert cache_folder() == ""
    if os.geteuid() == 0:
        expected.unlink()
        expected.mkdir()
        os.chown(expected, 12345, -1)
        assert cache_folder() == ""


def test_nowhere(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", "/proc/none")
    (tmp_path / "tmp").rmdir()
    (tmp_path / "tmp").touch()
    assert cache_folder() == ""
