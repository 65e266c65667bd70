"""What charts drawn beside a synthetic head say of its true light."""

import numpy as np
import pytest

from shared.errors import InputError
from shared.tracking.models import load_head_model
from tools.bench.colour_chart import measure, summary


@pytest.fixture(scope="module", autouse=True)
def model():
    try:
        load_head_model()
    except InputError as error:
        pytest.skip(f"the head model is missing: {error}")


def test_charts_in_an_even_light_miss_nothing():
    found = measure("sky", 3, 0)
    assert len(found) >= 2
    error, stated = found[:, 0], found[:, 1]
    assert np.abs(error).max() < 0.05 and (np.abs(error) < 2 * stated).all()
    assert np.abs(error - error.mean(1, keepdims=True)).max() < 0.02


def test_a_light_is_summed_up():
    found = np.array([[[0.1, 0.1, 0.1], [0.1] * 3], [[-0.3, -0.3, -0.3], [0.3] * 3]])
    row = summary(found)
    assert row["used"] == 2 and row["median"] == pytest.approx(0.2) and row["rms"] == pytest.approx(0.05**0.5)
    assert row["rms_over_stated"] == pytest.approx(1.0) and row["ratios"] == pytest.approx(0.0, abs=1e-12)
    assert np.isnan(summary(np.zeros((0, 2, 3)))["rms"])
