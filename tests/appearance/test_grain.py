"""Grain on what no frame shows: as strong, as fine and as coloured as what is known of the same kind."""

import numpy as np
import pytest
from shapes import grid_plane

from shared.appearance.grain import FEWEST, octaves, with_grain
from shared.appearance.texture import TexelMaterial
from shared.imaging.texels import TexelSurface
from shared.imaging.value_noise import octave_noise

SIZE, EDGE_MM, WAVELENGTH_MM, DEVIATION = 256, 80.0, 0.95, 0.1
COLOUR = np.array([0.6, 1.0, 1.4])
BASE = np.array([0.5, 0.35, 0.25])


@pytest.fixture(scope="module")
def half_seen():
    """(surface, material, texels that frames show): grain on the left half, nothing but the base on the right."""
    surface = TexelSurface(grid_plane(33, EDGE_MM), SIZE)
    places = surface.interpolate(surface.mesh.vertices)
    seen = places[:, 0] < np.median(places[:, 0])
    grain = DEVIATION * octave_noise(places, WAVELENGTH_MM, np.random.default_rng(3)) * seen
    albedo = (BASE * np.exp(grain[:, None] * COLOUR)).astype(np.float32)
    return surface, TexelMaterial(albedo, np.ones(len(seen)), np.where(seen, 1e4, 0.0)), seen


def drawn_on(half_seen, learnt=None, share=None):
    surface, material, seen = half_seen
    learnt = np.ones(len(seen), bool) if learnt is None else learnt
    share = np.ones(len(seen), np.float32) if share is None else share
    return np.log(with_grain(surface, material, [(learnt, share)]).albedo / material.albedo)


def test_it_is_as_strong_and_as_coloured_as_what_is_known(half_seen):
    _, material, seen = half_seen
    drawn, known = drawn_on(half_seen)[~seen], np.log(material.albedo / BASE)[seen]
    assert np.allclose(drawn.std(0), known.std(0), rtol=0.15)
    assert np.allclose(drawn.std(0) / drawn.std(0).mean(), COLOUR / COLOUR.mean(), rtol=0.02)
    assert np.abs(drawn.mean(0)).max() < 0.02


def test_it_is_as_fine(half_seen):
    """Most of the power lies in the octave of the pattern's own wavelength."""
    surface, material, seen = half_seen
    found = octaves(surface, np.log(material.albedo), seen)
    strongest = max(found, key=lambda octave: octave.deviation.mean())
    assert 0.5 < strongest.wavelength_mm / WAVELENGTH_MM < 2.0
    slow = [octave.deviation.mean() for octave in found if octave.wavelength_mm > 3.0 * WAVELENGTH_MM]
    assert slow and max(slow) < 0.5 * strongest.deviation.mean()


def test_what_is_known_stays(half_seen):
    *_, seen = half_seen
    drawn = drawn_on(half_seen)
    assert np.abs(drawn[seen]).max() < 1e-4 < 0.02 < np.abs(drawn[~seen]).mean()


def test_other_kinds_stay(half_seen):
    *_, seen = half_seen
    share = np.zeros(len(seen), np.float32)
    assert np.array_equal(drawn_on(half_seen, share=share), np.zeros((len(seen), 3)))


def test_too_little_teaches_nothing(half_seen):
    *_, seen = half_seen
    few = np.zeros(len(seen), bool)
    few[np.nonzero(seen)[0][: FEWEST - 1]] = True
    assert not drawn_on(half_seen, learnt=few).any()


def test_a_smooth_surface_gets_none(half_seen):
    surface, _, seen = half_seen
    flat = TexelMaterial(np.full((len(seen), 3), 0.4, np.float32), np.ones(len(seen)), np.where(seen, 1e4, 0.0))
    whole = np.ones(len(seen))
    assert np.abs(with_grain(surface, flat, [(whole > 0.0, whole)]).albedo - 0.4).max() < 1e-6
