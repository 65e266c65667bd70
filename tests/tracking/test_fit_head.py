"""The head model fitted to points sampled from a head of known shape, placed and scaled at will."""

import numpy as np
import pytest
from shapes import FACING, turned
from toy_head import toy_head

from shared.geometry.mesh import interpolate
from shared.geometry.raycast import RayScene
from shared.geometry.transforms import project, rigid, rotation_from_vector
from shared.tracking.depth_noise import DepthNoise
from shared.tracking.fit_head import FitWeights, fit_codes, landmarks_on_points, triangulate
from shared.tracking.fit_surface import ThinPlate, fit_surface

MODEL = toy_head()
ROTATION = rotation_from_vector(np.array([0.1, -0.2, 0.05]))
WEIGHTS = FitWeights(track_mm=0.1, landmark_mm=2.0, aperture_mm=1000.0)  # three codes, and no lids
SCALE, SHIFT = 0.9, np.array([3.0, -4.0, 10.0])


def true_head(bump_mm=0.0):
    vertices = MODEL.shape(np.array([1.5, -1.0]), np.array([0.6]))
    dent = np.exp(-(((vertices - [30.0, 20.0, 80.0]) / 18.0) ** 2).sum(1))
    return vertices + bump_mm * dent[:, None] * [0, 0, 1.0]


def observed(vertices, noise_mm=0.05):
    """Track points on the front and landmarks, in a space of their own: head = SCALE R x + SHIFT."""
    rng = np.random.default_rng(0)
    front = np.nonzero(MODEL.face_segment == 0)[0]
    bary = rng.dirichlet(np.ones(3), 1500)
    points = interpolate(vertices, MODEL.faces, rng.choice(front, 1500), bary)
    landmarks = MODEL.landmarks(vertices) + 0.5 * rng.normal(size=(468, 3))
    points = points + noise_mm * rng.normal(size=points.shape)
    return tuple((x - SHIFT) @ ROTATION / SCALE for x in (points, landmarks))


def test_codes_and_similarity_are_recovered():
    truth = true_head()
    fit = fit_codes(MODEL, *observed(truth), WEIGHTS)
    assert np.allclose(fit.identity, [1.5, -1.0], atol=0.25)
    assert fit.expression[0] == pytest.approx(0.6, abs=0.15)
    assert fit.scale == pytest.approx(SCALE, rel=0.01)
    assert np.median(np.linalg.norm(fit.vertices - truth, axis=1)) < 0.5


def test_free_correction_takes_up_what_the_codes_cannot():
    truth = true_head(bump_mm=3.0)
    points, landmarks = observed(truth)
    codes = fit_codes(MODEL, points, landmarks, WEIGHTS)
    noise = DepthNoise(np.full(len(points), 0.05), 0.05)
    free = fit_surface(ThinPlate(MODEL), codes, points, noise, FitWeights())
    near = np.linalg.norm(truth - [30.0, 20.0, 80.0], axis=1) < 18.0

    def distance(vertices):
        scene = RayScene(codes.vertices * 0 + vertices, MODEL.faces)
        _, _, reach = scene.intersect(truth[near] * 2, -truth[near])
        return np.median(np.abs(reach - 1.0) * np.linalg.norm(truth[near], axis=1))

    assert distance(free.vertices) < 0.5 * distance(codes.vertices)
    assert distance(free.vertices) < 0.4  # the mesh has a vertex only every 12 mm


def test_free_correction_is_stiff_where_depth_is_noise():
    points, landmarks = observed(true_head(), noise_mm=2.0)
    codes = fit_codes(MODEL, points, landmarks, WEIGHTS)
    plate = ThinPlate(MODEL)
    bent = [
        np.std(fit_surface(plate, codes, points, DepthNoise(np.full(len(points), said), said), FitWeights()).vertices
               - codes.vertices)
        for said in (0.05, 2.0)
    ]
    assert bent[1] < 0.3 * bent[0]


def test_poses_move_with_the_head():
    fit = fit_codes(MODEL, *observed(true_head()), WEIGHTS)
    pose = rigid(FACING, np.array([1.0, 2.0, 900.0]))[None]
    lens = np.array([[1000.0, 0, 0], [0, 1000.0, 0], [0, 0, 1]])
    points = np.random.default_rng(1).normal(size=(20, 3)) * 50
    before, _ = project(points, pose, lens)
    after, _ = project(fit.to_head(points), fit.camera_from_head(pose), lens)
    assert np.allclose(before, after, atol=1e-9)


def test_triangulation_inverts_projection():
    points = np.random.default_rng(2).normal(size=(30, 3)) * 50
    poses = turned([[0, a, 0] for a in (-0.3, 0.0, 0.3)])
    lens = np.array([[1000.0, 0, 320], [0, 1000.0, 240], [0, 0, 1]])
    assert np.allclose(triangulate(project(points, poses, lens)[0], poses, lens), points, atol=1e-6)


def test_landmarks_take_the_depth_of_the_tracks_around_them():
    truth = true_head()
    points, _ = observed(truth, noise_mm=0.0)
    named = (MODEL.landmarks(truth) - SHIFT) @ ROTATION / SCALE
    middle = points.mean(0)
    poses = rigid(FACING[None], (np.diag([-1.0, 1, 1]) @ middle + [0, 0, 900.0])[None])
    lens = np.array([[1000.0, 0, 320], [0, 1000.0, 240], [0, 0, 1]])
    found = landmarks_on_points(project(named, poses, lens)[0], poses, points, lens)
    towards = named[:, 2] > np.percentile(named[:, 2], 60)
    assert np.median(np.linalg.norm(found - named, axis=1)[towards]) < 2.0
