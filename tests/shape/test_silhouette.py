"""An egg that is too small grows until its outline meets masks, or a face's edge in pictures; what is known stays."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.sparse.linalg import spsolve
from shapes import turned
from toy_head import toy_head

from shared.geometry.mesh import Mesh, subdivide, vertex_normals
from shared.geometry.raycast import RayScene, camera_hits
from shared.imaging.color import encode_srgb
from shared.imaging.image_sampling import prepare_picture
from shared.imaging.views import Views
from shared.shape.occluding_contour import ContourSettings, Outlined, Outlines, mask_distance, occluding_contour
from shared.shape.silhouette import FaceOutline, fit_outline
from shared.shape.step import large_step_metric

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
    black = np.zeros((SIZE, SIZE, 3), np.uint8)
    picture = prepare_picture(black, black.astype(np.float32), masks[0])
    fitted = np.arange(FRAMES) % 4 != 1
    return Views.in_one_light(poses(), LENS, (SIZE, SIZE), "head", lambda f: picture, masks.__getitem__, fitted)


def all_of(mesh, face=False, known_mm=np.inf):
    """All faces may form an outline, and show the face's edge or not."""
    count = len(mesh.faces)
    shows = np.full(count, face)
    return Outlined(np.ones(count, bool), shows, shows, np.broadcast_to(known_mm, count))


def contour_of(mesh, views, reach_mm):
    """All of a mesh's occluding contour that has a border near."""
    return occluding_contour(mesh, all_of(mesh), views, Outlines.of(views), ContourSettings(reach_mm=reach_mm))


def before_hair(mesh, skin=(0.6, 0.4, 0.3), hair=(0.1, 0.08, 0.06)):
    """Views of a mesh of one colour before another one, in masks that hold all of the picture."""
    scene, pictures = RayScene(mesh.vertices, mesh.faces), []
    for pose in poses():
        hit = camera_hits(scene, pose, LENS, SIZE, SIZE)[0] >= 0
        linear = np.where(hit[..., None], np.float32(skin), np.float32(hair))
        linear = cv2.GaussianBlur(linear, (0, 0), 0.7)
        codes = np.round(255 * encode_srgb(linear)).astype(np.uint8)
        pictures.append(prepare_picture(codes, linear, np.full((SIZE, SIZE), 255, np.uint8)))
    return replace(masked([np.full((SIZE, SIZE), 255, np.uint8)] * FRAMES), read_picture=pictures.__getitem__)


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
    known = np.where(far[egg.faces].all(1), np.inf, 0.2)
    met, record = fit_outline(small, all_of(egg, known_mm=known), views, ContourSettings(rounds=4))
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
    met, record = fit_outline(egg, all_of(egg), views, ContourSettings())
    np.testing.assert_array_equal(met.vertices, egg.vertices)
    assert record == {"met": 0.0}


def test_hair_does_not_pull_the_head_out(egg):
    """Most of the border is hair's; what of it comes near by chance is no reason to grow."""
    own, wide = (views_of(egg.replace(vertices=scale * egg.vertices)) for scale in (1.0, 1.5))
    chin = np.arange(SIZE)[:, None] > 0.6 * SIZE
    views = masked([np.where(chin, own.mask(f), np.maximum(own.mask(f), wide.mask(f))) for f in range(FRAMES)])
    assert len(contour_of(egg, views, 8.0).distance) > 100
    met, record = fit_outline(egg, all_of(egg), views, ContourSettings())
    np.testing.assert_array_equal(met.vertices, egg.vertices)
    assert 0.05 < record["met"] < 0.6


def test_the_face_meets_its_edge_before_hair(egg):
    """Masks that hold hair and wall say nothing; the step of colour does."""
    normals = vertex_normals(egg.vertices, egg.faces)
    small = egg.replace(vertices=egg.vertices - 2.0 * normals)
    views = before_hair(egg)
    met, record = fit_outline(small, all_of(egg, face=True), views, ContourSettings())
    assert record["met"] == 0.0 and record["held_out_px"]["before"] > 1.5
    assert record["held_out_px"]["after"] < 0.2 * record["held_out_px"]["before"]
    contour = occluding_contour(met, all_of(egg, face=True), views, Outlines.of(views), ContourSettings(), False)
    assert contour.on_edge.all() and len(np.unique(contour.frame)) == FRAMES
    left = ((met.vertices - egg.vertices) * normals).sum(1)[np.unique(contour.edge)]
    assert abs(np.median(left)) < 0.2 and np.percentile(np.abs(left), 90) < 1.0


def test_an_edge_beyond_what_is_known_of_the_surface_is_within_the_face(egg):
    small = egg.replace(vertices=egg.vertices - 2.0 * vertex_normals(egg.vertices, egg.faces))
    views = before_hair(egg)
    met, record = fit_outline(small, all_of(egg, face=True, known_mm=0.2), views, ContourSettings())
    np.testing.assert_array_equal(met.vertices, small.vertices)
    assert record == {"met": 0.0}


def test_edges_beside_the_border_of_a_mask_that_serves_are_within_the_face(egg):
    """A dark spot's edge, well inside: the mask says where the head ends."""
    views = before_hair(egg.replace(vertices=0.95 * egg.vertices))
    known = replace(views, read_mask=views_of(egg).read_mask)
    outlined, outlines = all_of(egg, face=True), Outlines.of(known)
    settings = ContourSettings()
    assert occluding_contour(egg, outlined, known, outlines, settings, bordered=False).on_edge.mean() > 0.9
    contour = occluding_contour(egg, outlined, known, outlines, settings)
    assert contour.on_edge.mean() < 0.3 and abs(np.median(contour.distance[~contour.on_edge])) < 0.3


def test_terms_of_the_outline_lead_to_the_edge(egg):
    """One step of the squared distances, smooth as the shape's are."""
    normals = vertex_normals(egg.vertices, egg.faces)
    small = egg.replace(vertices=egg.vertices - 0.6 * normals)
    views = before_hair(egg)
    outline = FaceOutline(all_of(egg, face=True), views, Outlines.of(views), ContourSettings())
    hessian, gradient = outline.terms(small)
    smooth = large_step_metric(egg.faces, len(gradient), 4.0, 8.0)
    offsets = spsolve((hessian + smooth).tocsc(), -gradient)
    grown = small.replace(vertices=small.vertices + offsets[:, None] * vertex_normals(small.vertices, small.faces))
    before, after = (
        occluding_contour(mesh, outline.outlined, views, outline.outlines, outline.settings, bordered=False).distance
        for mesh in (small, grown)
    )
    assert np.median(before) == pytest.approx(-0.6, abs=0.2)  # one pixel is a millimetre away
    assert abs(np.median(after)) < 0.2 * abs(np.median(before))
