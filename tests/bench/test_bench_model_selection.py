"""The benchmark of model selection: what it compares."""

import pytest

from tools.bench.clips import settings_of
from tools.bench.model_selection import CANDIDATES, compare


def row(clip, candidate, mesh, error, seconds):
    return {"clip": clip, "candidate": candidate, "mesh": mesh, "held_out": 1.2 * error, "held_out_abs": error,
            "cpu_s": seconds,
            "light": "cubemap 8", "chosen": ""}


TABLE = [row("a", "auto", "tracked", 0.0103, 12.0), row("a", "least", "tracked", 0.02, 5.0),
         row("a", "cubemap_16", "tracked", 0.011, 30.0), row("a", "cubemap_16", "refined", 0.010, 60.0)]


def test_model_selection_is_compared_with_the_best_fixed_candidate():
    (found,) = compare(TABLE)
    assert found["best_fixed"] == "cubemap_16, refined"
    assert found["error_ratio"] == pytest.approx(1.03) and found["square_ratio"] == pytest.approx(1.03)
    assert found["time_ratio"] == pytest.approx(0.2)
    assert compare(TABLE[:1]) == []  # nothing to compare with


@pytest.mark.parametrize("candidate", CANDIDATES)
def test_its_settings_are_the_stages(candidate):
    assert settings_of(CANDIDATES[candidate]).appearance.light_model == CANDIDATES[candidate].get(
        "light_model", "cubemap")
