"""The score: closed forms of its measures, and results made from the tiny subject's truth by known changes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from quick import TINY
from scipy.spatial import cKDTree
from shapes import sphere

from shared.geometry.mesh import vertex_normals
from shared.geometry.transforms import rotation_from_vector
from shared.imaging.texture import sample_bilinear
from shared.io.arrays import load_arrays, read_json, save_arrays
from shared.io.images import read_exr, write_exr
from shared.io.meshes import read_obj, write_obj
from tools.scoring import align, measures
from tools.scoring.buffers import BufferRenderer
from tools.scoring.score import main, score
from tools.scoring.table import table

SCALE, TURN, SHIFT = 0.93, rotation_from_vector(np.array([0.1, -0.2, 0.05])), np.array([5.0, -20.0, 33.0])
GAIN = np.array([0.8, 0.9, 1.1])


def export_from_truth(folder: Path, *, vertices: np.ndarray | None = None, pose_noise_deg: float = 0.0,
                      gain: np.ndarray | float = 1.0, moved: bool = False) -> Path:
    """An export/ folder made of the tiny subject's truth; `moved` puts it into another head frame and scale."""
    (folder / "maps").mkdir(parents=True)
    (folder / "renders").mkdir()
    truth = load_arrays(TINY / "gt" / "poses.npz")
    mesh, poses = read_obj(TINY / "gt" / "mesh.obj"), truth["camera_from_head"].copy()
    mesh = mesh if vertices is None else mesh.replace(vertices=vertices)
    noise = np.random.default_rng(0).normal(size=(len(poses), 3)) * np.radians(pose_noise_deg)
    poses[:, :3, :3] = poses[:, :3, :3] @ rotation_from_vector(noise)
    if moved:
        mesh = mesh.replace(vertices=SCALE * mesh.vertices @ TURN.T + SHIFT)
        poses[:, :3, :3] = poses[:, :3, :3] @ TURN.T
        poses[:, :3, 3] = SCALE * poses[:, :3, 3] - poses[:, :3, :3] @ SHIFT
    write_obj(folder / "mesh.obj", mesh)
    save_arrays(folder / "poses.npz", camera_from_head=poses, frame_index=np.arange(len(poses)), intrinsics=truth["K"])
    for source, target in (("albedo", "diffuse_albedo"), ("specular", "specular_intensity"), ("roughness",) * 2):
        values = read_exr(TINY / "gt" / f"{source}.exr") * (gain if source == "albedo" else 1)
        write_exr(folder / "maps" / f"{target}.exr", values, colour_space="data")
    write_exr(folder / "envmap.exr", read_exr(TINY / "gt" / "envmap.exr") * gain, colour_space="data")
    frame = int(truth["gt_frames"][0])
    radiance = read_exr(TINY / "gt" / "frames" / f"{frame:04d}_radiance.exr")
    write_exr(folder / "renders" / f"{frame:04d}.exr", radiance * gain, colour_space="data")
    return folder


def test_truth_scores_perfectly_against_itself(tmp_path):
    scores = score(TINY, export_from_truth(tmp_path / "export"))
    assert scores["geometry_mm"]["median"] < 0.02 and scores["geometry_mm"]["within_5mm"] == 1
    assert scores["pose"]["rotation_deg"]["mean"] < 0.02 and scores["pose"]["frames"] == 12
    assert scores["pose_own_alignment"]["rotation_deg"]["mean"] < 1e-4
    assert scores["normal_deg"]["median"] < 0.6 and scores["mask_coverage"] > 0.8
    assert scores["albedo"]["raw"]["delta_e2000_median"] < 1 and "confident_texels" not in scores
    assert scores["specular"]["correlation"] > 0.9 and scores["roughness"]["rmse"] < 0.02
    assert scores["envmap"]["irradiance_rel_rmse"] < 1e-6
    assert scores["rerender"]["psnr"] > 60 and "relight" not in scores


def test_a_frames_own_gain_is_no_error_of_its_render(tmp_path):
    export, gain = export_from_truth(tmp_path / "export"), np.array([1.2, 1.0, 0.9])
    poses = load_arrays(export / "poses.npz")
    save_arrays(export / "poses.npz", **poses, gain=np.tile(gain, (len(poses["frame_index"]), 1)))
    render, = (export / "renders").iterdir()
    write_exr(render, read_exr(render) * gain.astype(np.float32), colour_space="data")
    assert score(TINY, export)["rerender"]["psnr"] > 60


def test_another_head_frame_scale_and_gains_change_nothing_but_the_raw_scores(tmp_path):
    plain = score(TINY, export_from_truth(tmp_path / "plain"))
    moved = score(TINY, export_from_truth(tmp_path / "moved", moved=True, gain=GAIN))
    assert moved["alignment"]["scale"] == pytest.approx(1 / SCALE, rel=1e-3)
    assert moved["geometry_mm"]["median"] == pytest.approx(plain["geometry_mm"]["median"], abs=0.01)
    assert moved["pose"]["rotation_deg"]["mean"] < 0.03
    aligned, raw = moved["albedo"]["aligned"], moved["albedo"]["raw"]
    assert aligned["psnr_srgb"] == pytest.approx(plain["albedo"]["aligned"]["psnr_srgb"], abs=0.3)
    assert raw["psnr_srgb"] < aligned["psnr_srgb"] - 5
    np.testing.assert_allclose(np.array(moved["albedo"]["gain"]) * GAIN, plain["albedo"]["gain"], rtol=0.01)
    np.testing.assert_allclose(np.array(moved["envmap"]["irradiance_gain"]) * GAIN, 1, rtol=1e-5)
    assert moved["rerender"]["psnr_gain"] > 60 > moved["rerender"]["psnr"]


def test_known_errors_of_shape_and_pose_are_found(tmp_path):
    mesh = read_obj(TINY / "gt" / "mesh.obj")
    ripple = 0.5 * np.sign(np.sin(mesh.vertices[:, :1] / 3)) * vertex_normals(mesh.vertices, mesh.faces)
    export = export_from_truth(tmp_path / "export", vertices=mesh.vertices + ripple, pose_noise_deg=0.5)
    scores = score(TINY, export)
    assert 0.2 < scores["geometry_mm"]["mean"] < 0.55
    # The length of a normally distributed rotation vector is 1.6 times its deviation per axis.
    assert scores["pose"]["rotation_deg"]["mean"] == pytest.approx(0.8, rel=0.3)
    assert scores["normal_deg"]["median"] > 2


def test_icp_finds_a_known_similarity():
    mesh = sphere(80.0, 5)
    shape = mesh.vertices * (1 + 0.2 * np.sin(mesh.vertices[:, :1] / 20) * np.cos(mesh.vertices[:, 1:2] / 30))
    mesh = mesh.replace(vertices=shape * [0.8, 1.1, 1.0])
    rng = np.random.default_rng(0)
    truth, true_normals, _ = align.sample_surface(mesh, 5000, rng)
    moved = mesh.replace(vertices=SCALE * mesh.vertices @ TURN.T + SHIFT)
    points, normals, _ = align.sample_surface(moved, 100_000, rng)
    exact = align.Similarity(1 / SCALE, TURN.T, -TURN.T @ SHIFT / SCALE)
    nudge = rotation_from_vector(np.array([0.03, 0.02, -0.03]))
    start = align.Similarity(1.03 * exact.scale, nudge @ exact.rotation, exact.translation + [3, -2, 4])
    tree = cKDTree(points)
    found = align.refine_by_icp(truth, true_normals, points, normals, tree, start)
    assert found.scale == pytest.approx(exact.scale, rel=1e-3)
    assert measures.rotation_angle_deg(found.rotation, exact.rotation) < 0.05
    assert np.median(align.surface_distance(truth, points, normals, tree, found)) < 0.02


def test_a_similarity_moves_points_and_poses_alike():
    similarity = align.Similarity(SCALE, TURN, SHIFT)
    points = np.random.default_rng(0).normal(size=(10, 3)) * 80
    np.testing.assert_allclose(similarity.inverse_points(similarity.points(points)), points, atol=1e-9)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation_from_vector(np.array([0.4, 0.1, -0.3])), (10, 20, 950)
    moved = similarity.pose(pose)
    # The same picture: camera-space points only grow by the scale.
    np.testing.assert_allclose(similarity.points(points) @ moved[:3, :3].T + moved[:3, 3],
                               SCALE * (points @ pose[:3, :3].T + pose[:3, 3]), atol=1e-9)


def test_coverage_of_errors_whose_covariance_is_known():
    rng = np.random.default_rng(0)
    axes = rotation_from_vector(rng.normal(size=(4000, 3)))
    spread = axes * np.radians([0.05, 0.1, 0.3])
    covariance, errors = spread @ spread.transpose(0, 2, 1), (spread @ rng.normal(size=(4000, 3, 1)))[..., 0]
    assert measures.rotation_coverage(errors, covariance) == pytest.approx(0.9, abs=0.015)
    # Three standard deviations where one is stated: chi-squared below 6.251 / 9, three degrees of freedom.
    assert measures.rotation_coverage(3.0 * errors, covariance) == pytest.approx(0.126, abs=0.015)


def test_acceleration_of_known_sequences():
    index = np.arange(20)
    steady = np.radians(0.3) * index[:, None] * np.array([0.0, 0.6, 0.8])
    assert measures.rotation_acceleration_deg(steady, index) == pytest.approx(0.0, abs=1e-9)
    bent = np.radians(0.25) * index[:, None] ** 2 * np.array([0.0, 0.6, 0.8])
    assert measures.rotation_acceleration_deg(bent, index) == pytest.approx(0.5)
    every_other = index[::2]
    assert measures.rotation_acceleration_deg(bent[::2], every_other) == pytest.approx(0.5)
    # A gap is no bend.
    gap = np.delete(index, [7, 8])
    assert measures.rotation_acceleration_deg(bent[gap], gap) == pytest.approx(0.5)
    assert np.isnan(measures.rotation_acceleration_deg(bent[:2], index[:2]))


def test_confident_albedo_is_judged_by_itself():
    """Grey skin; where the result is sure it lacks a gain alone, and one pixel in fifty is far off."""
    rng = np.random.default_rng(0)
    truth = np.full((5000, 3), 0.3) + rng.uniform(-0.02, 0.02, (5000, 1))
    confidence = np.where(np.arange(5000) < 4000, 0.9, 0.2)
    result = np.where(confidence[:, None] > 0.5, truth / GAIN, 0.9)
    wrong = np.arange(0, 4000, 50)
    exact = measures.albedo_errors(truth, result, rng, confidence)["confident"]
    assert exact["share"] == pytest.approx(0.8) and exact["acceptable"] == 1.0
    assert exact["delta_e2000_p99"] < 1e-3 and exact["psnr_linear"] > 100
    result[wrong] *= 3.0
    spoiled = measures.albedo_errors(truth, result, rng, confidence)["confident"]
    assert spoiled["acceptable"] == pytest.approx(1 - len(wrong) / 4000) and spoiled["delta_e2000_p99"] > 20
    assert measures.albedo_errors(truth, result, rng, np.zeros(5000))["confident"] == {"share": 0.0}
    assert "confident" not in measures.albedo_errors(truth, result, rng)


def test_measures_have_their_closed_forms():
    grey = np.full((500, 3), 0.25)
    assert measures.psnr(grey, grey + 0.01) == pytest.approx(40)
    angle = rotation_from_vector(np.array([[0, 0, 1e-5], [0, 2.0, 0]]))
    np.testing.assert_allclose(measures.rotation_angle_deg(np.eye(3), angle), np.degrees([1e-5, 2.0]), rtol=1e-6)
    truth = np.random.default_rng(0).random((2000, 3)) * 0.6 + 0.1
    scores = measures.albedo_errors(truth, truth / GAIN, np.random.default_rng(0))
    np.testing.assert_allclose(scores["gain"], GAIN)
    np.testing.assert_allclose(scores["median_gain"], GAIN)
    assert scores["aligned"]["delta_e2000_median"] == pytest.approx(0, abs=1e-9)
    assert scores["raw"]["delta_e2000_median"] > scores["aligned_one_gain"]["delta_e2000_median"] > 1
    values = measures.scalar_errors(truth[:, 0], 2 * truth[:, 0])
    assert (values["scale"], values["rmse_scaled"]) == pytest.approx((0.5, 0), abs=1e-12)
    assert values["correlation"] == pytest.approx(1)
    pairs = [(truth, 0.5 * truth), (np.ones((10, 3)), np.zeros((10, 3)))]
    np.testing.assert_allclose(measures.image_errors(pairs)["gain"], 2)


def test_a_turned_environment_scores_worse_than_a_brighter_one():
    truth = read_exr(TINY / "gt" / "envmap.exr").repeat(2, 0).repeat(2, 1)[:48, :96]
    brighter = measures.envmap_errors(truth, 2 * truth)
    turned = measures.envmap_errors(truth, truth[:, ::-1])
    assert brighter["irradiance_rel_rmse"] < 1e-9 and brighter["lobe25_correlation"] == pytest.approx(1)
    assert turned["irradiance_rel_rmse"] > 0.2 and turned["lobe25_rel_rmse"] > turned["irradiance_rel_rmse"]


def test_the_viewer_sees_a_sphere_where_it_is():
    mesh = sphere(80.0, 6)
    ramp = np.linspace(0, 1, 64, dtype=np.float32)[:, None].repeat(64, 1)
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[2, 3] = 950
    intrinsics = np.array([[500.0, 0, 64], [0, 500.0, 64], [0, 0, 1]])
    pixels = np.array([[63, 63], [63, 43], [2, 2]])
    seen = BufferRenderer(mesh, {"ramp": ramp}).view(pose, intrinsics, pixels)
    np.testing.assert_allclose(seen["coverage"], [1, 1, 0])
    np.testing.assert_allclose(seen["normal"][0], [0, 0, 1], atol=0.02)
    # The ray through that pixel, (0, slope, -1), meets the sphere at y = slope (950 - z).
    slope, distance = 20.5 / 500, 950.0
    z = (slope**2 * distance + np.sqrt(80**2 * (1 + slope**2) - slope**2 * distance**2)) / (1 + slope**2)
    assert seen["normal"][1, 1] == pytest.approx(slope * (distance - z) / 80, abs=0.01)
    assert seen["ramp"][1] < seen["ramp"][0] and (seen["normal"][2] == 0).all()


def test_textures_are_read_bilinearly_with_v_up():
    texture = np.array([[1.0, 2.0], [3.0, 4.0]])
    uv = np.array([[0.25, 0.75], [0.75, 0.25], [0.5, 0.5], [0.0, 0.75]])
    np.testing.assert_allclose(sample_bilinear(texture, uv), [1, 4, 2.5, 1.5])


def test_the_command_prints_a_table_and_writes_json(tmp_path, capsys):
    export = export_from_truth(tmp_path / "export")
    assert main([str(TINY), str(export), "--json", str(tmp_path / "scores.json")]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("geometry ") and "mm" in lines[0] and any("dE2000" in line for line in lines)
    assert read_json(tmp_path / "scores.json")["pose"]["frames"] == 12


@pytest.mark.parametrize("missing", ["gt", "mesh.obj", "poses.npz"])
def test_missing_files_are_one_line_and_exit_code_two(tmp_path, capsys, missing):
    export = export_from_truth(tmp_path / "export")
    if missing != "gt":
        (export / missing).unlink()
    assert main([str(tmp_path if missing == "gt" else TINY), str(export)]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_all_texels_count_where_the_result_is_confident(tmp_path):
    """Wrong where no face skin is, in an export in another head frame; the tiny truth has little else."""
    export = export_from_truth(tmp_path / "export", moved=True, gain=1.0 / GAIN)
    albedo, skin = read_exr(export / "maps" / "diffuse_albedo.exr"), read_exr(TINY / "gt" / "mask.exr").squeeze()
    spoilt = np.where(skin[..., None] < 0.5, 0.5 * albedo, albedo)
    write_exr(export / "maps" / "diffuse_albedo.exr", spoilt, colour_space="data")
    write_exr(export / "maps" / "confidence.exr", np.full(skin.shape, 0.9, np.float32), colour_space="data")
    scores = score(TINY, export)
    assert scores["confident_texels"]["share"] == 1.0 and 0.03 < scores["confident_texels"]["wrong"] < 0.1
    assert scores["albedo"]["confident"]["acceptable"] > 0.99
    assert "off by dE2000 6 or more 4." in table(scores)
