"""Roughness around each point: found where highlights differ, kept only for a gain on held-out frames."""

import numpy as np
import pytest
from toy_capture import ROUGHNESS, SPECULAR, glossy_forehead, make_truth, under_true_light

from shared.appearance import local_roughness as module
from shared.appearance.local_roughness import SpecularEquations, local_roughness

LOGS = np.log(ROUGHNESS) + np.log(module.FACTOR) * np.arange(-module.STEPS, module.STEPS + 1)


def test_a_glossy_half_is_found_and_kept():
    capture, _, _ = make_truth(roughness_at=glossy_forehead)
    equations, record = local_roughness(*under_true_light(capture))
    assert record["chosen"] == "local"
    height = capture.points.positions[:, 1]
    found = equations.roughness(capture.points.positions)
    upper, lower = found[height > np.quantile(height, 0.65)], found[height < np.quantile(height, 0.35)]
    assert np.median(upper) < 0.93 * ROUGHNESS < 1.07 * ROUGHNESS < np.median(lower)
    assert np.exp(np.log(found).mean()) == pytest.approx(ROUGHNESS, rel=0.02)


def test_one_roughness_everywhere_stays_one():
    capture, _, _ = make_truth()
    equations, record = local_roughness(*under_true_light(capture))
    assert equations is None
    assert record["chosen"] == "one" and record["held_out"]["one"] > 0


def test_far_from_any_highlight_the_clips_value_stands():
    """One point whose samples say half a step down: around it that, further away the prior."""
    moment = np.full((len(LOGS), 1), 100.0)
    moment[module.STEPS - 1] += 40.0
    equations = SpecularEquations(np.zeros((1, 3)), LOGS, np.full((len(LOGS), 1), 100.0), moment, (SPECULAR, 30.0))
    at = np.array([[0.0, 0, 0], [0.7 * module.REACH * module.WIDTH_MM, 0, 0], [200.0, 0, 0]])
    near, fading, far = equations.roughness(at)
    assert near < fading < far
    assert far == pytest.approx(ROUGHNESS)
    shifted = equations.centred()
    assert shifted.roughness(at[:1])[0] == pytest.approx(ROUGHNESS, rel=1e-3)
    assert shifted.roughness(at[2:])[0] == pytest.approx(ROUGHNESS)
