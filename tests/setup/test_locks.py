"""The locks: every package with its exact version and hashes, nothing of CUDA, no hosts, nothing left out."""

import re
import tomllib
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[2]
TORCH = "requirements-torch-cpu.lock", "requirements-torch.lock"
LOCKS = ("requirements-build.lock", "requirements.lock", *TORCH, "requirements-cluster.lock",
         "requirements-browser.lock")
OPTIONS = {"--only-binary :all:", "--no-binary connection-pool"}
HASH = re.compile(r"--hash=sha256:[0-9a-f]{64}")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def entries(lock):
    """{package: (version, hashes)} of a lock; all its lines are understood."""
    text = "\n".join(line for line in (ROOT / lock).read_text().splitlines() if not line.startswith("#"))
    found = {}
    for line in text.replace("\\\n", " ").splitlines():
        words = line.split()
        if line in OPTIONS or not words:
            continue
        name, version = re.fullmatch(r"([A-Za-z0-9._-]+)==([0-9][A-Za-z0-9.+!]*)", words[0]).groups()
        assert words[1:] and all(HASH.fullmatch(word) for word in words[1:]), f"{lock}: {name}"
        assert canonicalize_name(name) not in found
        found[canonicalize_name(name)] = version, words[1:]
    return found


ALL = {lock: entries(lock) for lock in LOCKS}


@pytest.mark.parametrize("lock", LOCKS)
def test_every_package_has_hashes_and_no_line_names_a_host(lock):
    text = (ROOT / lock).read_text()
    assert ALL[lock] and "://" not in text and "file:" not in text
    assert "--only-binary :all:" in text


def test_a_package_is_in_one_lock_and_cuda_in_none():
    names = [name for lock, found in ALL.items() for name in found if lock != TORCH[0]]
    assert len(set(names)) == len(names)
    assert not [name for name in names if re.match(r"nvidia|cuda|triton", name)]
    (cpu, _), (both, _) = (ALL[lock]["torch"] for lock in TORCH)
    assert all(set(ALL[lock]) == {"torch"} for lock in TORCH) and cpu == f"{both}+cpu"


def test_what_the_project_asks_for_is_locked():
    project = PROJECT["project"]
    wanted = [*project["dependencies"], *project["optional-dependencies"]["dev"],
              *project["optional-dependencies"]["cluster"], *project["optional-dependencies"]["browser"],
              *PROJECT["build-system"]["requires"]]
    locked = {name for found in ALL.values() for name in found}
    assert {canonicalize_name(Requirement(text).name) for text in wanted} <= locked


def test_the_build_is_pinned():
    (requirement,) = map(Requirement, PROJECT["build-system"]["requires"])
    assert str(requirement.specifier) == f"=={ALL['requirements-build.lock']['setuptools'][0]}"
    assert "pip" in ALL["requirements-build.lock"]


def test_locks_hold_all_that_their_packages_need():
    """By the metadata of what set-up has installed, in the locked versions. What torch wants of CUDA is apart."""
    locked = {name: version for found in ALL.values() for name, (version, _) in found.items()}
    own = {name for lock in ("requirements.lock", TORCH[1]) for name in ALL[lock]}
    for name in sorted(own):
        item = metadata.distribution(name)
        assert item.version.partition("+")[0] == locked[name], f"{name}: run make setup"
        for text in item.requires or ():
            need = Requirement(text)
            if need.marker is None or need.marker.evaluate({"extra": ""}):
                if name == "torch" and re.match(r"nvidia|cuda|triton", need.name):
                    continue
                have = locked.get(canonicalize_name(need.name), "")
                assert need.specifier.contains(have, prereleases=True), f"{name} needs {text}, locked: {have or 'not'}"


def test_set_up_compares_hashes():
    makefile = (ROOT / "Makefile").read_text()
    install = re.search(r"^INSTALL := (.*)$", makefile, re.MULTILINE).group(1)
    assert {"--require-hashes", "--no-deps", "--no-build-isolation"} <= set(install.split())
    for lock in LOCKS[:4]:
        assert f"$(INSTALL) --requirement {lock}" in makefile and lock in makefile.partition("$(STAMP): ")[2]
