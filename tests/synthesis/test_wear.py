"""What synthetic heads wear: geometry that lies where it should, is closed to light from outside, and is textured."""

import numpy as np
import pytest

from shared.geometry.mesh import face_normals, normalised
from shared.geometry.raycast import RayScene
from tools.synthesis.head import random_head
from tools.synthesis.makeup import made_up, sweaty
from tools.synthesis.skin import Complexion, SkinPainter
from tools.synthesis.subject import head_model
from tools.synthesis.wear import EYES, GLASSES, GLASSES_U, coloured, tube, with_beard, with_fringe, with_glasses


@pytest.fixture(scope="module")
def head():
    return random_head(head_model(0), 0, False)


@pytest.fixture(scope="module")
def painted(head):
    painter = SkinPainter(head, 128, 0)
    return painter, painter.paint(Complexion())


@pytest.mark.parametrize("closed", [False, True])
def test_a_tube_is_as_thick_as_told_and_faces_outwards(closed):
    angle = 2 * np.pi * np.arange(60) / 60 * (1.0 if closed else 0.7)
    path = 30.0 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)
    made = tube(path, (2.0, 2.0), closed)
    centre = made.vertices[made.faces].mean(1)
    ring = centre * [1, 1, 0] / np.linalg.norm(centre[:, :2], axis=1, keepdims=True) * 30.0
    off = centre - ring
    assert np.abs(np.linalg.norm(made.vertices - np.repeat(path, 8, 0), axis=1) - 2.0).max() < 1e-9
    outwards = (normalised(face_normals(made.vertices, made.faces)) * normalised(off)).sum(1)
    assert (outwards > 0.8).mean() > 0.97
    assert made.uvs.min() == 0.0 and made.uvs.max() == 1.0 and made.face_uvs.max() == len(made.uvs) - 1


def test_glasses_stand_before_the_eyes_and_touch_no_skin_there(head):
    worn = with_glasses(head, 2.0)
    own = worn.mesh.vertices[len(head.mesh.vertices):]
    assert len(worn.face_segment) == len(worn.mesh.faces) and len(own) > 500
    scene, marks = RayScene(head.mesh.vertices, head.mesh.faces), head.landmarks()
    _, _, before = scene.intersect(own.astype(np.float32), np.tile(np.float32([0, 0, 1]), (len(own), 1)))
    assert np.isinf(before).mean() > 0.9
    for corners in EYES.values():
        assert (np.linalg.norm(own[:, :2] - marks[list(corners)].mean(0)[:2], axis=1) < 30).sum() > 100


def test_a_fringe_hides_more_of_the_forehead_the_denser_it_is(head):
    marks = head.landmarks()
    rng = np.random.default_rng(0)
    across = rng.uniform(-35, 35, 2000)
    height = rng.uniform(marks[9][1] + 12, marks[10][1], 2000)
    origins = np.stack([across, height, np.full(2000, 400.0)], 1).astype(np.float32)
    hidden = []
    for cover in (0.2, 0.6):
        worn = with_fringe(head, cover, 0)
        face, _, _ = RayScene(worn.mesh.vertices, worn.mesh.faces).intersect(
            origins, np.tile(np.float32([0, 0, -1]), (2000, 1)))
        hidden.append((face >= len(head.mesh.faces)).mean())
    assert 0.08 < hidden[0] < 0.4 and hidden[1] > 2 * hidden[0]


def test_a_beard_thickens_chin_and_jaw_only(head):
    moved = np.linalg.norm(with_beard(head, 6.0, 0).mesh.vertices - head.mesh.vertices, axis=1)
    chin = np.unique(head.mesh.faces[head.face_segment == head.segment_names.index("chin")])
    nose = np.unique(head.mesh.faces[head.face_segment == head.segment_names.index("nose")])
    assert 2.0 < np.median(moved[chin]) <= 6.0 and moved.max() <= 6.0 + 1e-9 and np.median(moved[nose]) == 0.0


def test_the_strips_of_glasses_are_no_skin(painted):
    _, materials = painted
    strip = coloured(materials)
    column = round(np.mean(GLASSES_U) * 128)
    assert np.allclose(strip.albedo[20, column], GLASSES["albedo"]) and strip.mask[20, column] == 0.0
    inner = slice(12, 116)
    assert np.array_equal(strip.albedo[:, inner], materials.albedo[:, inner])


def test_make_up_covers_some_skin_with_sharp_edges(painted):
    painter, materials = painted
    changed = np.abs(made_up(materials, painter, 1.0).albedo - materials.albedo).max(-1)
    skin = materials.mask > 0
    assert 0.02 < (changed[skin] > 0.05).mean() < 0.4
    half = np.abs(made_up(materials, painter, 0.5).albedo - materials.albedo).max(-1)
    assert np.allclose(half, 0.5 * changed, atol=1e-6)
    assert np.array_equal(made_up(materials, painter, 0.0).albedo, materials.albedo)


def test_sweat_is_shinier_on_the_face_alone(painted):
    _, materials = painted
    wet, skin = sweaty(materials, 1.0), materials.mask > 0
    assert (wet.specular[skin] > 1.5).all() and (wet.roughness[skin] < 0.25).all()
    assert np.array_equal(wet.specular[~skin], materials.specular[~skin])


def test_more_of_an_expression_moves_the_mouth_and_not_the_scalp(head):
    smiling = random_head(head_model(0), 0, False, {"jaw_open": 0.5})
    moved = np.linalg.norm(smiling.mesh.vertices - head.mesh.vertices, axis=1)
    scalp = np.unique(head.mesh.faces[head.face_segment == head.segment_names.index("scalp")])
    assert moved.max() > 5.0 and moved[scalp].max() < 1.0
