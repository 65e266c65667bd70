"""The table of lambda: errors of known meshes, and one row solved on the tiny subject."""

import csv
from pathlib import Path

import numpy as np

from shared.geometry.mesh import vertex_normals
from tools.bench.clips import open_clip
from tools.bench.runner import run
from tools.bench.shape import ShapeBench, profile_picture, shape_errors

TINY = Path(__file__).resolve().parents[1] / "tiny"
SMALL = "points=400 directions=128 bounce_nodes=100 light_resolution=4 shape_subdivisions=0".split()


def test_known_errors_of_shape_are_found(tiny_run):
    clip = open_clip(TINY, tiny_run, False)
    mesh = clip.surface.mesh
    right = shape_errors(TINY, clip, mesh)
    assert right["distance_median_mm"] < 0.02 and right["normal_median_deg"] < 0.6
    ripple = 0.5 * np.sign(np.sin(mesh.vertices[:, :1] / 3)) * vertex_normals(mesh.vertices, mesh.faces)
    wrong = shape_errors(TINY, clip, mesh.replace(vertices=mesh.vertices + ripple))
    assert 0.2 < wrong["distance_median_mm"] < 0.55 and wrong["normal_median_deg"] > 2.0
    flipped = mesh.replace(vertices=mesh.vertices * np.where(np.arange(len(mesh.vertices))[:, None] % 50, 1.0, 0.9))
    assert shape_errors(TINY, clip, flipped)["cuts"] > right["cuts"]


def test_a_row_for_each_lambda_beside_the_tracked_and_the_exported_mesh(tiny_run, tmp_path):
    arguments = [str(TINY), str(tiny_run), "--smoothness", "5", "--set", *SMALL, "--out", str(tmp_path)]
    assert run(ShapeBench, "shape", arguments) == 0
    assert run(ShapeBench, "shape", [*arguments, "--only", "exported"]) == 0
    with open(tmp_path / "shape.csv", encoding="utf-8") as file:
        tracked, refined, exported = csv.DictReader(file)
    assert tracked["smoothness"] == "tracked" and tracked["stopped"] == "" and refined["smoothness"] == "5.0"
    assert 0.0 < float(refined["distance_median_mm"]) != float(tracked["distance_median_mm"])
    assert float(refined["held_out_residual"]) > 0.0 and int(refined["stopped"]) >= 0
    assert exported["smoothness"] == "exported" and 0.0 < float(exported["distance_median_mm"]) < 5.0
    assert (tmp_path / "profile.png").is_file()


def test_profiles_of_one_mesh_coincide(tiny_run):
    """The exported mesh's place taken by the truth: both pictures alike, and its red outline over the black one."""
    clip = open_clip(TINY, tiny_run, False)
    truth, mesh, outlines, *_ = np.split(profile_picture(TINY, clip, clip.surface.mesh, 160), 5, axis=1)
    assert np.mean(np.abs(truth.astype(int) - mesh) > 8) < 0.02 and len(np.unique(truth)) > 50
    red = (outlines == [255, 0, 0]).all(2)
    assert 100 < red.sum() < 2000 and (outlines == 0).all(2).sum() < 0.1 * red.sum()
