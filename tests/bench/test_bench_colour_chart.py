"""What charts drawn beside a synthetic head say of its true light."""

import numpy as np
import pytest

from shared.errors import InputError
from shared.tracking.models import load_head_model
from tools.bench.colour_chart import main, measure


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


def test_the_table_has_a_row_per_light(capsys):
    assert main(["--lights", "room", "--places", "1"]) == 0
    head, row = capsys.readouterr().out.splitlines()
    assert head.split()[:3] == ["light", "used", "median"] and row.split()[0] == "room"
