"""An egg whose back is too small grows until its outline meets the masks, and what is known stays."""

import numpy as np
import pytest
from shapes import turned
from toy_head import toy_head

from shared.geometry.mesh import Mesh, subdivide, vertex_normals
from shared.geometry.raycast import RayScene, camera_hits
from shared.imaging.views import Views
from shared.shape.silhouette import ContourSettings, fit_outline, mask_distance, occluding_contour

FRAMES, SIZE = 9, 240
LENS = np.array([[900.0, 0, SIZE / 2], [0, 900.0, SIZE / 2], [0, 0, 1]])


def poses(frames=FRAMES):
    angle = np.linspace(-0.5, 0.5, frames)
    vectors = np.stack([0.1 * np.sin(6 * angle), angle, 0 * angle], axis=1)
    return turned(vectors)


def views_of(mesh):
    """Masks of a mesh from all sides."""
    scene = RayScene(mesh.vertices, mesh.faces)
    masks = [255 * (camera_hits(scene, pose, LENS, SIZE, SIZE)[0] >= 0).astype(np.uint8) for pose in poses()]
    return masked(masks)


def masked(masks):
    return Views.in_one_light(poses(), LENS, (SIZE, SIZE), "head", None, masks.__getitem__, np.arange(FRAMES) % 4 != 1)


def contour_of(mesh, views, reach_mm):
    """All of a mesh's occluding contour that has a border near."""
    distances = [mask_distance(views.mask(f)) for f in range(len(views))]
    return occluding_contour(mesh, np.ones(len(mesh.faces), bool), views, distances, reach_mm)


@pytest.fixture(scope="module")
def egg() -> Mesh:
    return subdivide(toy_head(4).mesh(np.zeros(2), np.zeros(1)))


def test_distance_is_zero_on_the_border_and_grows_outside():
    mask = np.zeros((20, 30), np.uint8)
    mask[:, 10:] = 128
    distance = mask_distance(mask)
    np.testing.assert_allclose(distance[10, 8:12], [1.5, 0.5, -0.5, -1.5])


def test_occluding_contour_of_the_true_mesh_lies_on_the_border(egg):
    contour = contour_of(egg, views_of(egg), 8.0)
    assert len(np.unique(contour.frame)) == FRAMES and len(contour.distance) > 40 * FRAMES
    assert abs(np.median(contour.distance)) < 0.3
    assert np.percentile(np.abs(contour.distance), 90) < 0.7


def test_distance_changes_with_the_surface_as_the_slope_says(egg):
    """Growth by a tenth of a millimetre moves the outline as far as slope . normal predicts."""
    views = views_of(egg.replace(vertices=1.05 * egg.vertices))
    normals = vertex_normals(egg.vertices, egg.faces)
    before = contour_of(egg, views, 20.0)
    after = contour_of(egg.replace(vertices=egg.vertices + 0.5 * normals), views, 20.0)
    across = np.einsum("ne,nex->nx", np.stack([1 - before.share, before.share], 1), normals[before.edge])
    predicted = 0.5 * np.median((across * before.slope).sum(1))
    assert predicted == pytest.approx(0.5, rel=0.1)  # one pixel is a millimetre away
    assert np.median(after.distance) - np.median(before.distance) == pytest.approx(predicted, abs=0.1)


def test_outline_is_met_where_nothing_is_known(egg):
    far = egg.vertices[:, 2] < 20.0
    normals = vertex_normals(egg.vertices, egg.faces)
    small = egg.replace(vertices=egg.vertices - 4.0 * far[:, None] * normals)
    views = views_of(egg)
    met, record = fit_outline(small, np.ones(len(egg.faces), bool), ~far, views, ContourSettings(rounds=4))
    assert record["held_out_px"]["after"] < 0.4 * record["held_out_px"]["before"]
    contour = contour_of(small, views, 8.0)
    seen = np.unique(contour.edge)
    seen = seen[far[seen]]
    left = ((met.vertices - egg.vertices) * normals).sum(1)
    assert np.median(np.abs(left[seen])) < 1.5
    front = egg.vertices[:, 2] > 30.0
    np.testing.assert_allclose(met.vertices[front], egg.vertices[front], atol=0.4)


def test_a_mask_of_something_else_moves_nothing(egg):
    """Borders farther away than the reach are not the head's."""
    views = views_of(egg.replace(vertices=1.5 * egg.vertices))
    usable, known = np.ones(len(egg.faces), bool), np.zeros(len(egg.vertices), bool)
    met, record = fit_outline(egg, usable, known, views, ContourSettings())
    np.testing.assert_array_equal(met.vertices, egg.vertices)
    assert record == {"met": 0.0}


def test_hair_does_not_pull_the_head_out(egg):
    """Most of the border is hair's; what of it comes near by chance is no reason to grow."""
    own, wide = (views_of(egg.replace(vertices=scale * egg.vertices)) for scale in (1.0, 1.5))
    chin = np.arange(SIZE)[:, None] > 0.6 * SIZE
    views = masked([np.where(chin, own.mask(f), np.maximum(own.mask(f), wide.mask(f))) for f in range(FRAMES)])
    usable, known = np.ones(len(egg.faces), bool), np.zeros(len(egg.vertices), bool)
    assert len(contour_of(egg, views, 8.0).distance) > 100
    met, record = fit_outline(egg, usable, known, views, ContourSettings())
    np.testing.assert_array_equal(met.vertices, egg.vertices)
    assert 0.05 < record["met"] < 0.6
