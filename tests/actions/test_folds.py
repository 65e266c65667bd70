"""Skin that displacements would fold over."""

import numpy as np
import pytest
from shapes import sphere

from shared.actions.folds import SkinFolds
from shared.geometry.intersections import crossing_edges

BALL = sphere(60.0, 4)
ALL = np.ones(len(BALL.vertices), bool)
PATCH = np.exp(-(np.linalg.norm(BALL.vertices - [0.0, 0.0, 60.0], axis=1) / 12.0) ** 2)


def shoved(by_mm):
    """[V, 3]: a patch of the front moved sideways, over its neighbours where it goes far."""
    return by_mm * PATCH[:, None] * [1.0, 0.0, 0.0]


def test_what_does_not_fold_is_left_alone():
    skin = SkinFolds.of(BALL.vertices, BALL.faces, ALL)
    assert not skin.folded(shoved(5.0)).any()
    np.testing.assert_array_equal(skin.smoothed(shoved(5.0)), shoved(5.0))


@pytest.mark.parametrize("by_mm", [18.0, 24.0])
def test_a_fold_is_smoothed_out(by_mm):
    skin = SkinFolds.of(BALL.vertices, BALL.faces, ALL)
    smoothed = skin.smoothed(shoved(by_mm))
    assert skin.folded(shoved(by_mm)).sum() > 5 and not skin.folded(smoothed).any()
    assert len(crossing_edges(BALL.vertices + smoothed, BALL.faces)) == 0
    assert np.linalg.norm(smoothed, axis=1).max() > 0.5 * by_mm
    far = PATCH < 1e-6
    assert np.linalg.norm(smoothed[far], axis=1).max() < 0.05


def test_what_touches_something_is_not_smoothed():
    held = BALL.vertices[:, 0] < 0.0
    skin = SkinFolds.of(BALL.vertices, BALL.faces, ~held)
    np.testing.assert_array_equal(skin.smoothed(shoved(24.0))[held], shoved(24.0)[held])


def test_the_skin_of_no_action_is_folded(solved):
    surface = solved.surface
    touching = surface.vertices_of(("lids", "eyes", "eye_sockets", "lips", "inner_mouth"))
    skin = SkinFolds.of(surface.mesh.vertices, surface.mesh.faces, ~touching)
    for shape in solved.shapes.values():
        assert not skin.folded(shape.applied(surface.mesh.vertices, 1.0) - surface.mesh.vertices).any(), shape.name
