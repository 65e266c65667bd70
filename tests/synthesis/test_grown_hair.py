"""Hair, beard and collar of synthetic heads: where they lie, what they hide, and what the truth calls them."""

from dataclasses import replace

import numpy as np
import pytest

from shared.geometry.raycast import RayScene
from shared.imaging.material_labels import BROW, CLOTH, EYE, HAIR, LIPS, SKIN
from shared.io.arrays import read_json
from shared.io.images import read_png
from tools.synthesis.hair import BELOW_JAW, COLLAR_UV, CROPPED, HAIR_UV, HAIRCUTS, HEAD_U, OVER_EARS, Growth, grown
from tools.synthesis.head import random_head
from tools.synthesis.subject import PRESETS, head_model, main, procedural, synthesize

TINY = PRESETS["tiny"]
SETTINGS = replace(TINY, texture=256, face_truth_only=False)


@pytest.fixture(scope="module")
def head():
    return random_head(head_model(0), 0, False)


def texels(size, rectangle):
    """The inner part of a rectangle of the atlas, as slices."""
    u_low, u_high, v_low, v_high = rectangle
    return slice(round((1.02 - v_high) * size), round((0.98 - v_low) * size)), slice(
        round((u_low + 0.02) * size), round((u_high - 0.02) * size))


def first_part(scene, origins, direction, head):
    """Which rays meet something that has grown, as a mask, and which meet the head."""
    face, _, _ = scene.intersect(np.float32(origins), np.tile(np.float32(direction), (len(origins), 1)))
    return face >= len(head.mesh.faces), (face >= 0) & (face < len(head.mesh.faces))


@pytest.mark.parametrize("haircut", [OVER_EARS, BELOW_JAW])
def test_long_hair_hides_ears_and_scalp_and_leaves_the_face_free(head, haircut):
    worn = grown(head, Growth(haircut), 0)
    scene = RayScene(worn.mesh.vertices, worn.mesh.faces)
    ears = head.face_segment == head.segment_names.index("ears")
    for side in (-1, 1):
        places = head.mesh.vertices[head.mesh.faces[ears]].mean(1)
        places = places[np.sign(places[:, 0]) == side]
        hidden, _ = first_part(scene, places * [0, 1, 1] + [400.0 * side, 0, 0], [-side, 0, 0], head)
        assert hidden.mean() > 0.9
    face = head.landmarks()[[4, 50, 280, 152, 105, 334]]
    _, bare = first_part(scene, face * [1, 1, 0] + [0, 0, 400.0], [0, 0, -1.0], head)
    assert bare.all()
    below = worn.mesh.vertices[len(head.mesh.vertices):, 1].min() < head.landmarks()[152][1]
    assert below == (haircut == BELOW_JAW)


def test_hair_stands_off_the_head_and_faces_outwards(head):
    worn = grown(head, Growth(OVER_EARS), 0)
    added = worn.mesh.faces[len(head.mesh.faces):]
    scene = RayScene(head.mesh.vertices, head.mesh.faces)
    top = np.float32([[0.0, 400.0, -20.0], [0.0, 400.0, -60.0]])
    whole = RayScene(worn.mesh.vertices, worn.mesh.faces)
    down = np.float32([[0, -1, 0]] * 2)
    gap = scene.intersect(top, down)[2] - whole.intersect(top, down)[2]
    assert (gap > 5).all() and (gap < 25).all()
    corners = worn.mesh.vertices[added[: len(added) // 2]]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    outwards = (normal * (corners.mean(1) - [0.0, 0.0, -20.0])).sum(1)
    assert (outwards > 0).mean() > 0.95


def test_what_has_grown_has_a_part_of_the_atlas_of_its_own(head):
    worn = grown(head, Growth(BELOW_JAW, collar=True), 0)
    own = worn.mesh.uvs[len(head.mesh.uvs):]
    assert worn.mesh.uvs[:len(head.mesh.uvs), 0].max() <= HEAD_U < own[:, 0].min()
    assert own.min() > 0 and own.max() < 1 and len(worn.face_segment) == len(worn.mesh.faces)


@pytest.mark.parametrize("haircut", HAIRCUTS)
def test_the_truth_says_what_is_skin_hair_and_cloth(haircut):
    mesh, _, materials = procedural(replace(SETTINGS, growth=Growth(haircut, 6.0, True)))
    assert set(np.unique(materials.label)) >= {SKIN, HAIR, BROW, LIPS, EYE, CLOTH}
    if haircut != CROPPED:
        assert (materials.label[texels(256, HAIR_UV)] == HAIR).all()
    assert (materials.label[texels(256, COLLAR_UV)] == CLOTH).all()
    bare = procedural(replace(SETTINGS, growth=Growth(haircut)))[2]
    head_part = np.s_[:, : round(HEAD_U * 256)]
    more = (materials.label[head_part] == HAIR).sum() - (bare.label[head_part] == HAIR).sum()
    assert more > 500, "no beard"
    assert mesh.uvs.max() < 1.0


def test_cropped_hair_is_the_scalp_moved_outwards(head):
    worn = grown(head, Growth(CROPPED), 0)
    moved = np.linalg.norm(worn.mesh.vertices - head.mesh.vertices, axis=1)
    inside = np.unique(head.mesh.faces[head.face_segment == head.segment_names.index("scalp")])
    assert 3 < np.median(moved[inside]) < 8 and moved[np.setdiff1d(np.arange(len(moved)), inside)].max() == 0


def test_a_subject_with_hair_has_labels_and_others_have_none(tmp_path):
    quick = replace(SETTINGS, size=64, frames=8, irradiance=replace(TINY.irradiance, size=48, directions=64))
    synthesize(tmp_path / "hair", replace(quick, growth=Growth(OVER_EARS, collar=True)), 1)
    synthesize(tmp_path / "plain", quick, 1)
    truth = read_png(next((tmp_path / "hair" / "gt" / "frames").glob("*_label.png")))
    head = read_png(next((tmp_path / "hair" / "gt" / "frames").glob("*_head.png"))) > 0
    assert ((truth > 0) <= head).all() and (truth == HAIR).sum() > 100 and (truth == SKIN).sum() > 200
    assert (truth == CLOTH).any() and read_png(tmp_path / "hair" / "gt" / "label.png").shape == (256, 256)
    assert not list((tmp_path / "plain").rglob("*label*"))
    assert "growth" not in read_json(tmp_path / "plain" / "synthesis.json")
    assert read_json(tmp_path / "hair" / "synthesis.json")["growth"]["haircut"] == OVER_EARS


@pytest.mark.parametrize("arguments", [["--beard", "90"], ["--hair", "ears", "--eyes", "living"]])
def test_what_cannot_grow_is_refused(tmp_path, arguments, capsys):
    assert main([str(tmp_path / "s"), *arguments]) == 2
    assert "error:" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main([str(tmp_path / "s"), "--hair", "mohawk"])


def test_growth_that_is_nothing_is_false():
    assert not Growth() and Growth(collar=True) and Growth(CROPPED)
