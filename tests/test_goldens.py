"""Every stage on the tiny subject against its golden file (tools/goldens.py writes them)."""

import numpy as np
import pytest

from shared.io.arrays import read_json
from tools import goldens

RELATIVE, ABSOLUTE = 0.02, 0.004
"""Results differ between processors in the last digits, which matching, robust weights and thresholds amplify; a change
of method shows in the first two digits."""

LOOSE = {"covariance": 0.5, "points_head": 0.1, "residual_px": 0.5}
"""Sampled values that follow which single tracks survive a threshold."""


@pytest.fixture(scope="module", params=goldens.STAGES)
def stage(request):
    return request.param


@pytest.fixture(scope="module")
def golden(stage):
    return read_json(goldens.GOLDEN_FOLDER / f"{stage}.json")


@pytest.fixture(scope="module")
def result(stage, tiny_run):
    return goldens.summarise(goldens.stage_folder(tiny_run, stage), stage)


def test_versions_of_the_golden_file_are_the_stages(stage, golden):
    assert golden["version"] == goldens.version(stage)
    assert all(goldens.version(name) == number for name, number in golden["before"].items())


def test_the_same_files_are_made(golden, result):
    assert result["files"] == golden["files"]
    assert result["content"].keys() == golden["content"].keys()


def test_the_same_numbers_come_out(golden, result):
    wrong = []
    for name, expected in golden["content"].items():
        for key, values, reference in _leaves(name, result["content"][name], expected):
            scale = max(float(np.abs(reference).max()), ABSOLUTE)
            tolerance = LOOSE.get(key.split(":")[-1].split(".")[0], RELATIVE)
            error = float(np.abs(values - reference).max()) / scale if values.shape == reference.shape else np.inf
            if error > tolerance:
                wrong.append(f"{key}: off by {100 * error:.1f} % of its largest value")
    assert not wrong, "\n".join(wrong)


def _leaves(name, found, expected):
    """(key, found values, golden values) for everything numeric below one file's entry."""
    for part, reference in expected.items():
        if isinstance(reference, dict):
            yield from _leaves(f"{name}:{part}", found[part], reference)
        else:
            yield f"{name}.{part}", np.asarray(found[part], float), np.asarray(reference, float)
