"""How much of a clip a light is solved from, and how fine its maps are."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from toy_capture import even_light, make_truth, small_lamp

from shared.appearance.fit import fit_appearance
from shared.appearance.problem import AppearanceSettings
from shared.geometry.mesh import Mesh
from shared.imaging.frame_index import halves
from shared.imaging.views import Views
from shared.inverse.model_selection import SMALLEST_MAP, TEXELS_PER_PX, fitting_map_size
from shared.rendering.precomputed_transfer import Sizes
from shared.selection import samples
from shared.selection.samples import FEWEST_FRAMES, FEWEST_POINTS, HalfSpread, enough_samples, spread_over_points

SOFT = AppearanceSettings(resolutions=(8,), noise=(0.003, 0.01), steps=5)


def test_halves_share_out_the_fitted_frames_of_each_light():
    fitted = np.array([1, 1, 0, 1, 1, 1, 0, 1, 1], bool)
    light = np.array([0, 0, 0, 0, 0, 1, 1, 1, 1])
    first, second = halves(fitted, light)
    assert not (first & second).any() and ((first | second) == fitted).all()
    assert first[light == 0].sum() == second[light == 0].sum() == 2
    assert (first[light == 1].sum(), second[light == 1].sum()) == (2, 1)


def test_the_spread_of_halves_tells_how_many_samples_are_enough():
    """Of means of numbers with a deviation of 0.3: (0.3 / 0.01)^2 = 900 hold it to a hundredth."""
    rng = np.random.default_rng(3)
    apart = np.diff(rng.normal(0.0, 0.3, (4000, 2, 50)).mean(2), axis=1)
    assert HalfSpread(50, float(apart.std())).enough(0.01) == pytest.approx(900.0, rel=0.05)
    assert HalfSpread(50, 0.0).enough(0.01) == 0.0


@pytest.fixture(scope="module")
def solved(one_thread):
    """A capture under a soft light and one under a small lamp, with its solution."""
    found = {}
    for name, light in (("soft", even_light), ("lamp", small_lamp)):
        capture = make_truth(lights=(light,))[0].some_points(200)
        settings = SOFT if name == "soft" else replace(SOFT, resolutions=(16,))
        found[name] = capture, settings, fit_appearance(capture, settings)
    return found


def test_fewer_points_tell_a_light_the_worse(solved):
    """A quarter of them doubles the spread, as of independent errors, to within a factor of two of chance."""
    capture, settings, solution = solved["soft"]
    few = capture.some_points(len(capture.points) // 4)
    all_of_them, some = (spread_over_points(one, settings, solution) for one in (capture, few))
    assert all_of_them.count == len(capture.points) // 2
    assert 1.0 < some.difference / all_of_them.difference < 4.0


def test_a_lamp_needs_more_than_a_soft_light(solved, monkeypatch):
    """And all that there is where that is short of it; a soft light never less than the least."""
    monkeypatch.setattr(samples, "TOLERANCE", 0.02)
    most = Sizes(points=4000, directions=768, nodes=1000)
    soft, lamp = (enough_samples(*solved[name], 48, most) for name in ("soft", "lamp"))
    assert lamp.over_frames.difference > 10.0 * soft.over_frames.difference
    assert soft.sizes.points < 4000 and soft.frames == FEWEST_FRAMES < lamp.frames
    assert soft.sizes.points >= FEWEST_POINTS and lamp.sizes.points >= soft.sizes.points
    assert (soft.sizes.directions, soft.sizes.nodes) == (512, 400)
    assert (lamp.sizes.directions, lamp.sizes.nodes) == (768, 1000)


def test_no_more_is_taken_than_the_settings_have(solved, monkeypatch):
    monkeypatch.setattr(samples, "TOLERANCE", 1e-6)
    enough = enough_samples(*solved["soft"], 30, Sizes(points=900, directions=256, nodes=80))
    assert (enough.frames, enough.sizes) == (30, Sizes(900, 256, 80))


def square(edge_mm):
    """A surface of two triangles that fills the whole map."""
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    mesh = Mesh(edge_mm * corners, faces, corners[:, :2], faces)
    return SimpleNamespace(mesh=mesh, face_segment=None)


def views_of(px_mm):
    """Three frames whose pixels are so wide on the head."""
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 2, 3] = 1000.0 * px_mm
    return Views.in_one_light(poses, np.diag([1000.0, 1000.0, 1.0]), (64, 64), "head", None, None)


@pytest.mark.parametrize(("px_mm", "expected"), [(0.3, 2048), (0.71, 1024), (0.7, 2048), (1.42, 512), (9.0, 512)])
def test_maps_are_as_fine_as_the_pixels_fill(px_mm, expected):
    """256 mm across: texels of 0.25 mm at 1024, which pixels of 0.25 sqrt(2) fill twice over at 2048 only."""
    views = views_of(px_mm)
    size = fitting_map_size(square(512.0), views, 2048)
    assert size == expected
    texel_mm = 512.0 / size
    assert texel_mm * TEXELS_PER_PX <= px_mm or size == 2048
    assert size == SMALLEST_MAP or 2.0 * texel_mm * TEXELS_PER_PX > px_mm


def test_a_smaller_limit_stays():
    views = views_of(1e6)  # so coarse that little would do
    assert fitting_map_size(square(256.0), views, 256) == 256
