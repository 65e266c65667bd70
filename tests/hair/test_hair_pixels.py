"""Pixels of drawn frames told apart: hair about a ball of a head, its skin, and a shirt about as dark as the hair."""

import numpy as np
import pytest
from toy_hair import SHIRT_ROW, hairy_ball

from shared.hair.hair_pixels import CLOTH_PIXEL, HAIR_PIXEL, SKIN_PIXEL, HairPixels
from shared.imaging.image_sampling import SurfaceViewer


@pytest.fixture(scope="module")
def told():
    """Probabilities [F, H, W, 3] and which pixels are hair in truth [F, H, W]."""
    surface, views, materials, hair = hairy_ball(haired=True)
    pixels = HairPixels(SurfaceViewer.of(surface.mesh), surface, materials, views, np.zeros(3))
    pixels.learn(range(len(views)))
    return np.stack([pixels.probabilities(f)[0] for f in range(len(views))]), hair


def test_hair_beside_the_head_is_hair(told):
    found, hair = told
    by_label = found.argmax(-1) == HAIR_PIXEL
    by_label &= found.sum(-1) > 0.5
    assert (by_label & hair).sum() / (by_label | hair).sum() > 0.9


def test_a_dark_shirt_is_cloth(told):
    found, hair = told
    shirt = ~hair[:, SHIRT_ROW + 6:]
    shown = found[:, SHIRT_ROW + 6:][shirt]
    assert (shown[:, CLOTH_PIXEL] > 0.5).mean() > 0.95


def test_the_middle_of_the_face_is_skin(told):
    found, _ = told
    assert found[len(found) // 2, 90:120, 90:110, SKIN_PIXEL].min() > 0.9


def test_a_beard_is_the_heads_own():
    """A chin whose vertices are hair, drawn in the colour of hair: no hair that stands off."""
    surface, views, materials, _ = hairy_ball(haired=True, bearded=True)
    pixels = HairPixels(SurfaceViewer.of(surface.mesh), surface, materials, views, np.zeros(3))
    pixels.learn(range(len(views)))
    found = pixels.probabilities(len(views) // 2)[0]
    chin = found[131:137, 95:105]
    assert chin[..., HAIR_PIXEL].max() < 0.1 and chin[..., SKIN_PIXEL].min() > 0.5
    assert found[60:64, 95:105, HAIR_PIXEL].min() > 0.9


def test_beside_the_person_there_is_nothing(told):
    found, _ = told
    assert (found[:, :20, :20] == 0.0).all()
    inside = found.sum(-1) > 0.5
    assert np.allclose(found.sum(-1)[inside], 1.0, atol=1e-5)
