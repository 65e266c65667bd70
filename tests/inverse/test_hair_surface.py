"""Hair that stands off a ball of a head, in drawn pictures: found, measured, and lit with the head."""

import numpy as np
import pytest
from shapes import nods, sphere

from shared.geometry.mesh import face_normals
from shared.geometry.raycast import RayScene, camera_hits, pixel_directions
from shared.geometry.surface import Surface
from shared.imaging.image_sampling import SurfaceViewer, prepare_picture
from shared.imaging.material_labels import HAIR, LABELS, SKIN
from shared.imaging.views import Views
from shared.inverse.hair_surface import find_hair

HEAD_MM, HAIR_MM, HAIRLINE_MM = 80.0, 96.0, 25.0
LENS = np.array([[600.0, 0, 100], [0, 600.0, 100], [0, 0, 1]])
SIZE = (200, 200)
HAIR_CODE, SKIN_CODE, WALL_CODE = (60, 35, 20), (200, 150, 120), (90, 130, 160)
SEGMENTS = ("scalp", "forehead", "ears", "chin", "neck", "nose")


def toy_surface():
    """A ball: scalp on top and behind, ears as bumps at its sides, chin and neck below, the rest a face."""
    ball = sphere(HEAD_MM, 5)
    x, y, z = ball.vertices.T
    bump = 9.0 * np.exp(-((np.abs(x) - HEAD_MM) ** 2 + (y + 20.0) ** 2 + z**2) / 200.0)
    mesh = ball.replace(vertices=ball.vertices * (1.0 + bump / HEAD_MM)[:, None])
    cx, cy, cz = ball.vertices[ball.faces].mean(1).T
    kind = np.select(
        [(np.abs(cx) > 70.0) & (np.abs(cy + 20.0) < 20.0), (cy > 40.0) | (cz < 0.0) & (cy > -40.0), cy > 25.0,
         cy < -60.0, cy < -45.0], [2, 0, 1, 4, 3], 5)
    return Surface(mesh, kind, SEGMENTS)


def is_hair(places):
    """[N] bool: what of a ball about the head is hair: above the forehead, and everything at the sides and behind."""
    return (places[:, 1] > HAIRLINE_MM) | (places[:, 2] < 30.0)


def drawn(surface, pose, haired):
    """Codes [H, W, 3] and mask [H, W] of a frame."""
    codes, mask = np.full((*SIZE[::-1], 3), WALL_CODE, np.uint8), np.zeros(SIZE[::-1], np.uint8)
    rays, balls = pixel_directions(LENS, *SIZE), sphere(HAIR_MM, 5)
    for mesh, code in ((surface.mesh, SKIN_CODE), (balls, HAIR_CODE)):
        face, _, depth = camera_hits(RayScene(mesh.vertices, mesh.faces), pose, LENS, *SIZE)
        hit = face >= 0
        if code == HAIR_CODE:
            if not haired:
                continue
            hit[hit] = is_hair((rays[hit] * depth[hit][:, None] - pose[:3, 3]) @ pose[:3, :3])
        codes[hit], mask[hit] = code, 128
    return codes, mask


def setting(haired):
    surface = toy_surface()
    poses = nods(np.linspace(-50.0, 50.0, 9))
    frames = [drawn(surface, pose, haired) for pose in poses]

    def read_picture(f):
        codes, mask = frames[f]
        return prepare_picture(codes, (codes / 255.0).astype(np.float32) ** 2.2, mask)

    views = Views.in_one_light(poses, LENS, SIZE, "head", read_picture, lambda f: frames[f][1])
    materials = np.zeros((len(surface.mesh.vertices), len(LABELS)))
    scalp = surface.vertices_of(("scalp",))
    materials[scalp, HAIR if haired else SKIN] = 1.0
    materials[~scalp, SKIN] = 1.0
    return surface, views, materials


@pytest.fixture(scope="module")
def found():
    surface, views, materials = setting(haired=True)
    return surface, find_hair(SurfaceViewer.of(surface.mesh), surface, materials, views, 128)


def test_hair_lies_where_its_outline_is(found):
    """16 mm of hair to a pixel (1.5 mm) and a little, its own share all over the crown."""
    _, hair = found
    assert hair.record["thickness_mm"] == pytest.approx(HAIR_MM - HEAD_MM, abs=2.0)
    crown = hair.mesh.vertices[:, 1] > 50.0
    radius = np.linalg.norm(hair.mesh.vertices, axis=1)
    assert np.median(np.abs(radius[crown] - HAIR_MM)) < 2.0
    assert hair.share[hair.mesh.vertices[:, 1] > 60.0].min() > 0.9


def test_the_face_is_left_free(found):
    _, hair = found
    _, y, z = hair.mesh.vertices.T
    front = (z > 60.0) & (y < HAIRLINE_MM - 12.0) & (y > -50.0)
    assert hair.share[front].max(initial=0.0) < 0.5


def test_faces_are_outward_and_use_all_vertices(found):
    _, hair = found
    mesh = hair.mesh
    outwards = (face_normals(mesh.vertices, mesh.faces) * mesh.vertices[mesh.faces].mean(1)).sum(1)
    assert (outwards[(mesh.vertices[mesh.faces, 1] > 0.0).all(1)] > 0.0).mean() > 0.99
    assert set(mesh.faces.ravel()) == set(range(len(mesh.vertices))) and len(hair.share) == len(mesh.vertices)


def test_what_hair_covers_lies_beneath(found):
    """No ear of the head comes out of hair; the face stays where it was."""
    surface, hair = found
    places, before = hair.head.vertices, surface.mesh.vertices
    ears = surface.vertices_of(("ears",)) & (before[:, 2] < 10.0) & (before[:, 1] > -30.0)
    scene = RayScene(hair.mesh.vertices, hair.mesh.faces)
    outwards = places[ears] / np.linalg.norm(places[ears], axis=1, keepdims=True)
    covered = scene.occluded(places[ears], outwards)
    assert covered.mean() > 0.95
    face = surface.vertices_of(("nose", "chin", "neck")) & ~surface.vertices_of(("scalp", "ears", "forehead"))
    assert np.array_equal(places[face], before[face])


def test_a_bare_head_has_no_hair():
    surface, views, materials = setting(haired=False)
    assert find_hair(SurfaceViewer.of(surface.mesh), surface, materials, views, 64) is None
