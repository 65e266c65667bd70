"""Scores of a map of materials: the truth agrees with itself, known mistakes lower known labels."""

from dataclasses import replace

import numpy as np
import pytest

from shared.geometry.mesh import vertex_normals
from shared.geometry.parts import mesh_part
from shared.hair.hair_files import write_hair
from shared.hair.joined import HairSurface
from shared.imaging.material_labels import CLOTH, HAIR, LABELS, LIPS, SKIN, UNKNOWN
from shared.imaging.texture import sample_bilinear
from shared.io.arrays import load_arrays
from shared.io.images import read_png
from shared.io.material_maps import write_material
from shared.io.meshes import read_obj
from tools.scoring.labels import agreement, label_files, label_scores
from tools.scoring.table import table
from tools.synthesis.hair import OVER_EARS, Growth
from tools.synthesis.subject import PRESETS, synthesize

TINY = PRESETS["tiny"]


@pytest.fixture(scope="module")
def subject(tmp_path_factory):
    """A small head with hair over the ears and a collar, two of its frames with labels."""
    folder = tmp_path_factory.mktemp("labels") / "subject"
    quick = replace(TINY.irradiance, size=48, directions=64)
    settings = replace(TINY, size=96, frames=8, texture=256, truth_frames=2, face_truth_only=False, irradiance=quick,
                       growth=Growth(OVER_EARS, collar=True))
    synthesize(folder, settings, 1)
    return folder


def scores_of(subject, folder, probabilities):
    """The scores of a result whose mesh and poses are the truth's."""
    (folder / "maps").mkdir(parents=True, exist_ok=True)
    write_material(folder / "maps" / "material.exr", probabilities.astype(np.float32), half=True, attributes={})
    truth = load_arrays(subject / "gt" / "poses.npz")
    poses = dict(enumerate(truth["camera_from_head"]))
    return label_scores(subject / "gt" / "frames", folder, read_obj(subject / "gt" / "mesh.obj"), poses, truth["K"])


def test_the_truth_agrees_with_itself_and_mistakes_count_where_they_are_made(subject, tmp_path):
    label = read_png(subject / "gt" / "label.png")
    scores = scores_of(subject, tmp_path / "right", np.eye(len(LABELS))[label])
    assert min(scores["texels"][name] for name in ("skin", "hair")) > 0.9
    assert min(scores["pixels"][name] for name in ("skin", "hair", "cloth")) > 0.9
    assert min(scores["covered"].values()) > 0.9
    wrong = scores_of(subject, tmp_path / "wrong", np.eye(len(LABELS))[np.where(label == HAIR, SKIN, label)])
    assert wrong["texels"]["hair"] == wrong["pixels"]["hair"] == 0.0 and wrong["texels"]["skin"] < 0.7
    assert wrong["pixels"]["cloth"] == scores["pixels"]["cloth"]
    half = scores_of(subject, tmp_path / "half", np.eye(len(LABELS))[np.where(label == SKIN, UNKNOWN, label)])
    assert half["texels"].get("skin", 0.0) == 0.0 and half["unknown"] > 0.3 > scores["unknown"]
    assert half["texels"]["hair"] == pytest.approx(scores["texels"]["hair"], abs=0.05)


def test_agreement_is_intersection_over_union_by_weight():
    found, truth = np.array([SKIN, SKIN, HAIR, UNKNOWN]), np.array([SKIN, HAIR, HAIR, SKIN])
    assert agreement(found, truth, np.array([1.0, 2.0, 3.0, 4.0])) == {"skin": 1 / 7, "hair": 3 / 5}
    assert agreement(found[:1], truth[:1], np.ones(1)) == {"skin": 1.0}
    assert "lips" in agreement(np.array([LIPS]), np.array([CLOTH]), np.ones(1))


def test_a_subject_without_labels_has_no_files_of_them(subject, tmp_path):
    assert len(label_files(subject / "gt" / "frames")) == 2 and label_files(tmp_path) == {}


def test_the_table_has_lines_for_labels():
    spread = {"median": 1.0, "mean": 1.0, "p95": 1.0, "within_5mm": 1.0}
    pose = {"rotation_deg": spread, "translation_mm": spread, "frames": 3, "depth_mm_median": 1.0}
    base = {"geometry_mm": spread, "pose": pose, "pose_own_alignment": pose, "alignment": {"scale": 1.0},
            "normal_deg": spread, "mask_coverage": 1.0}
    labels = {"texels": {"skin": 0.9}, "pixels": {"skin": 0.8}, "unknown": 0.1, "covered": {"skin": 1.0}}
    assert "labels" not in table(base)
    text = table(base | {"labels": labels})
    assert "skin 0.900" in text and "skin 0.800" in text and "10.0% of the texels unknown" in text


def test_hair_with_a_surface_of_its_own_is_hair(subject, tmp_path):
    """A head whose map takes all hair for skin, and over it the hair's own surface, 1 mm further out: by pixels hair is
    hair again, and the head's texels beneath are hidden. Where its alpha is low it is not there."""
    label, mesh = read_png(subject / "gt" / "label.png"), read_obj(subject / "gt" / "mesh.obj")
    bare = np.eye(len(LABELS))[np.where(label == HAIR, SKIN, label)]
    hairy = sample_bilinear((label == HAIR).astype(float), mesh.uvs[mesh.face_uvs].mean(1)).ravel() > 0.5
    outer = mesh.replace(vertices=mesh.vertices + vertex_normals(mesh.vertices, mesh.faces))
    hair, scores = mesh_part(outer, hairy)[0], {"bare": scores_of(subject, tmp_path / "bare", bare)}
    for name, alpha in (("there", 1.0), ("thin", 0.2)):
        (tmp_path / name / "maps").mkdir(parents=True)
        write_hair(tmp_path / name, HairSurface(hair, np.full((32, 32, 3), 0.1, np.float32),
                                                np.full((32, 32), alpha, np.float32)))
        scores[name] = scores_of(subject, tmp_path / name, bare)
    assert scores["bare"]["pixels"].get("hair", 0.0) == 0.0 == scores["thin"]["pixels"].get("hair", 0.0)
    assert scores["there"]["pixels"]["hair"] > 0.85 and scores["there"]["pixels"]["skin"] > 0.85
    assert scores["there"]["texels"]["skin"] > scores["bare"]["texels"]["skin"] + 0.1
