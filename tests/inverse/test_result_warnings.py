"""What a result says of itself."""

from types import SimpleNamespace

import numpy as np
import pytest

from shared.inverse.solve import warnings_about


@pytest.mark.parametrize("known, warned", [(0.0, True), (0.009, True), (0.02, False), (1.0, False)])
def test_maps_that_are_hardly_determined_are_said(known, warned):
    confidence = np.where(np.linspace(0.0, 1.0, 1000) < known, 0.9, 0.2)
    result = SimpleNamespace(
        record={"warnings": []}, maps={"confidence": confidence}, solution=SimpleNamespace(fitted=0.02, held_out=0.02)
    )
    assert any("hardly any of the maps" in text for text in warnings_about(result)) is warned
