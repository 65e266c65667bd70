"""Confident and wrong, over all of a head: plates whose truth is known, one of them behind another."""

import numpy as np
import pytest
from shapes import grid_plane, turned

from shared.geometry.mesh import Mesh
from shared.geometry.transforms import Similarity, rotation_from_vector
from tools.scoring import texel_albedo
from tools.scoring.texel_albedo import AlbedoPairs, albedo_pairs

SKIN, HAIR = np.full(3, 0.4), np.full(3, 0.05)
POSES = turned(np.zeros((3, 3)), (0.0, 0.0, 500.0))
SCALE, TURN, SHIFT = 0.5, rotation_from_vector(np.array([0.1, -0.2, 0.05])), np.array([5.0, -20.0, 33.0])


@pytest.fixture(autouse=True)
def few_points(monkeypatch):
    monkeypatch.setattr(texel_albedo, "RESULT_POINTS", 4000)
    monkeypatch.setattr(texel_albedo, "TRUE_POINTS", 40000)


def truth_with_hair(lift):
    """Skin, and before its right half hair, lift mm nearer to the camera; the left half of the map is skin's."""
    plate = grid_plane(9, 80.0)
    hair = plate.vertices * [0.5, 1.0, 1.0] + [20.0, 0.0, lift]
    mesh = Mesh(
        np.concatenate([plate.vertices, hair]), np.concatenate([plate.faces, plate.faces + len(hair)]),
        np.concatenate([plate.uvs * [0.5, 1.0], plate.uvs * [0.5, 1.0] + [0.5, 0.0]]),
        np.concatenate([plate.faces, plate.faces + len(hair)]),
    )
    albedo = np.tile(SKIN, (64, 64, 1))
    albedo[:, 32:] = HAIR
    return mesh, albedo, POSES


def pairs_of(lift, size=1.0):
    """Of a plate of skin alone, confident where x < 20, in another frame and scale."""
    mesh = grid_plane(17, 80.0 * size)
    confidence = np.full((64, 64), 0.9)
    confidence[:, 48:] = 0.2
    there = Similarity(1.0 / SCALE, TURN, SHIFT)
    own = mesh.replace(vertices=there.inverse_points(mesh.vertices))
    result = own, np.tile(SKIN, (64, 64, 1)), confidence
    return albedo_pairs(truth_with_hair(lift), result, there, np.random.default_rng(0))


def test_the_truth_is_what_the_camera_sees():
    """Skin behind hair is hair to it: 20 of the 60 confident mm, but for 4 beside the edge of the hair, most of which
    have no truth."""
    pairs = pairs_of(lift=4.0)
    column = pairs.face % 16  # the outer ones mix with the map's other side
    assert np.allclose(pairs.truth[(column > 9) & (column < 15)], HAIR, atol=0.01)
    assert np.allclose(pairs.truth[(column > 0) & (column < 6)], SKIN, atol=0.01)
    scores = pairs.wrong_where_sure(np.ones(3))
    assert scores["share"] == pytest.approx(0.75, abs=0.04) and scores["wrong"] == pytest.approx(16 / 57, abs=0.03)


def test_what_lies_far_from_all_that_is_known_has_no_truth():
    assert len(pairs_of(lift=4.0).face) > 3700
    assert len(pairs_of(lift=60.0).face) == pytest.approx(2000, abs=200)
    assert len(pairs_of(lift=4.0, size=1.5).face) == pytest.approx(4000 / 1.5**2, rel=0.15), "past a mesh's border"


def test_wrong_texels_by_segment_biggest_first():
    grey, white = np.full(3, 0.2), np.full(3, 0.8)
    pairs = AlbedoPairs(np.array([0, 1, 1, 2, 2]), np.tile(grey, (5, 1)), np.array([white, white, white, grey, white]),
                        np.array([0.9, 0.9, 0.9, 0.9, 0.1]))
    scores = pairs.wrong_where_sure(np.ones(3), np.array([1, 0, 0]), ("ears", "nose"))
    assert scores == {"share": 0.8, "wrong": 0.75, "of_segments": {"ears": 0.5, "nose": 0.25}}
    assert pairs.wrong_where_sure(np.full(3, 0.25))["wrong"] == 0.25
    unsure = AlbedoPairs(pairs.face, pairs.truth, pairs.found, np.zeros(5))
    assert unsure.wrong_where_sure(np.ones(3)) == {"share": 0.0, "wrong": 0.0}
