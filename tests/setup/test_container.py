"""The container recipes, as far as that shows without an engine: pinned, complete, alike, without rights."""

import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
DOCKERFILE = (ROOT / "container" / "Dockerfile").read_text(encoding="utf-8")
APPTAINER = (ROOT / "container" / "limn.def").read_text(encoding="utf-8")
BASE = re.compile(r"^(?:FROM|From:) (python:3\.11\.\d+-slim-bookworm@sha256:[0-9a-f]{64})(?: AS \w+)?$", re.MULTILINE)


def copied():
    """What the image is built from, relative to the repository."""
    lines = [line.split()[1:-1] for line in DOCKERFILE.splitlines() if re.match(r"COPY (?!--from)", line)]
    return [name for line in lines for name in line]


def test_every_base_is_pinned_by_the_same_digest():
    bases = BASE.findall(DOCKERFILE) + BASE.findall(APPTAINER)
    assert len(bases) == len(re.findall(r"^(?:FROM|From:) ", DOCKERFILE + APPTAINER, re.MULTILINE)) == 3
    assert len(set(bases)) == 1


def test_both_recipes_take_the_same_files_and_all_that_a_run_needs():
    section = APPTAINER.partition("%files\n")[2].partition("\n\n")[0]
    pairs = [line.split() for line in section.splitlines()]
    assert [source for source, _ in pairs] == copied()
    assert all(target == f"/opt/limn/{source}" for source, target in pairs)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    assert {name.partition(".")[0] for name in project["tool"]["setuptools"]["packages"]} <= set(copied())
    rule = (ROOT / "Makefile").read_text().partition("\n$(STAMP): ")[2].partition("\n")[0]
    assert set(rule.split()) <= set(copied())
    ignored = (ROOT / "container" / "Dockerfile.dockerignore").read_text().split()
    assert {".git", ".venv", ".models"} <= set(ignored) and not set(copied()) & set(ignored)


def test_the_copied_files_are_enough_to_plan_with(tmp_path):
    for name in copied():
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copyfile(ROOT / name, tmp_path / name)
    done = subprocess.run([sys.executable, "-m", "tools.limn", "parameters"], cwd=tmp_path, text=True, check=True,
                          env={"PYTHONPATH": str(tmp_path)}, capture_output=True)
    assert "inverse_render" in done.stdout
    made = subprocess.run(["make", "--dry-run", "setup", "PYTHON=python3"], cwd=tmp_path, text=True, check=True,
                          capture_output=True)
    assert "--require-hashes" in made.stdout and "tools.setup.models" in made.stdout


def test_no_rights_and_no_leftovers():
    final = DOCKERFILE.rpartition("\nFROM ")[2]
    assert re.search(r"^USER (?!0|root)\d+:\d+$", final, re.MULTILINE) and "RUN" not in final
    assert 'ENTRYPOINT ["limn"]' in final
    for text in (DOCKERFILE, APPTAINER):
        assert "make setup" in text and "pip uninstall --yes pymeshlab" in text
        assert "://" not in text and not re.search(r"curl|wget|ADD ", text)


@pytest.mark.skipif(shutil.which("bash") is None, reason="needs a shell")
def test_shell_parts_parse():
    post = APPTAINER.partition("%post\n")[2].partition("\n%")[0].replace("{{ index }}", "")
    runs = re.findall(r"^RUN ((?:.*\\\n)*.*)$", DOCKERFILE, re.MULTILINE)
    assert len(runs) == 2
    for script in (post, *runs):
        subprocess.run(["bash", "-n", "-c", script], check=True)
