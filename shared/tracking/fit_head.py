"""The head model fitted to tracked points and landmarks: similarity, identity, expression.

Track points carry no names: each pulls its nearest place on the surface along the normal. Landmarks carry names but
slide over the skin, so they steer the lids, lips and brows and weigh little. What the codes leave is for the free
correction, see shared.tracking.fit_surface.

Reference: [Chen1992] (point to plane).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import lsq_linear
from scipy.spatial import cKDTree

from shared.compute.robust import cauchy_weight
from shared.geometry.mesh import interpolate, normalised, vertex_normals
from shared.geometry.transforms import camera_centres, project, rotation_from_vector, similarity_from_points
from shared.tracking.depth_noise import DepthNoise
from shared.tracking.head_model import HeadModel


@dataclass(frozen=True)
class HeadFit:
    """head ~ scale * rotation @ point + translation takes track points to head space; codes and vertices are there.

    vertices [V, 3] mm; identity [50] standard deviations; expression [25] activations.
    """

    scale: float
    rotation: np.ndarray
    translation: np.ndarray
    identity: np.ndarray
    expression: np.ndarray
    vertices: np.ndarray

    def to_head(self, points: np.ndarray) -> np.ndarray:
        """Track-space points [N, 3] -> head space, mm."""
        return self.scale * points @ self.rotation.T + self.translation

    def camera_from_head(self, camera_from_points: np.ndarray) -> np.ndarray:
        """[F, 4, 4] poses of the track points -> poses of the head, mm."""
        poses = np.array(camera_from_points, np.float64)
        poses[:, :3, :3] = camera_from_points[:, :3, :3] @ self.rotation.T
        poses[:, :3, 3] = self.scale * camera_from_points[:, :3, 3] - poses[:, :3, :3] @ self.translation
        return poses


EFFECTIVE_TRACKS = 100.0
REACHES_MM, LATER_REACHES_MM = (15.0,) * 4 + (6.0,) * 8, (6.0,) * 4
"""How far a track point may lie from the surface, step by step: of a first fit, and of one that starts from another."""
APERTURES = np.array(
    [(160, 144), (159, 145), (158, 153), (387, 373), (386, 374), (385, 380), (82, 87), (13, 14), (312, 317)]
)
OF_EYES = 6
"""Pairs of landmarks above and below the openings of eyes and mouth, those of the eyes first."""


@dataclass(frozen=True)
class FitWeights:
    """How much each kind of evidence counts: standard deviations in mm or in the code's own unit.

    All tracks together count as EFFECTIVE_TRACKS: neighbours repeat each other, and fifty codes cannot follow a face to
    a fraction of a millimetre. Landmarks tell the rough place, and how far lids and lips are open.
    """

    track_mm: float = 2.8
    landmark_mm: float = 12.0
    aperture_mm: float = 0.7
    identity: float = 1.0
    expression: float = 0.6
    stiffness: float = 20.0

    def for_depth_noise(self, noise: DepthNoise) -> FitWeights:
        """For track points whose depth is uncertain: the model counts more."""
        return replace(self, track_mm=float(np.hypot(self.track_mm, noise.of_mean(EFFECTIVE_TRACKS))))


@dataclass(frozen=True)
class Pins:
    """Places on edges of the model, vertices [N, 2] and share [N] of the way from the one to the other, that belong at
    points [N, 3] of track space as seen from the front, to deviation_mm."""

    points: np.ndarray
    vertices: np.ndarray
    share: np.ndarray
    deviation_mm: float

    def of(self, values: np.ndarray) -> np.ndarray:
        """values [..., V, 3] of vertices at the places, [..., N, 3]."""
        first, second = (values[..., ends, :] for ends in self.vertices.T)
        return first + self.share[:, None] * (second - first)


PUBLISHED = FitWeights(track_mm=2.8 * (100.0 / 30.0) ** 0.5, landmark_mm=2.8)
"""Landmarks 100, skin 30, as [Xu2025] weighs landmark and photometric losses: what the pictures say of the
skin reaches the fit here as tracks."""


def fit_codes(
    model: HeadModel,
    points: np.ndarray,
    landmarks: np.ndarray,
    weights: FitWeights,
    before: HeadFit | None = None,
    pins: Pins | None = None,
) -> HeadFit:
    """Similarity, identity and expression by alternating closest points and one bounded linear solution.

    points [N, 3] and landmarks [468, 3] in track space (NaN rows: unknown). before: a fit of the same head, whose codes
    it starts from; a third of the steps are enough then. pins: of the lids; without them landmarks tell how far eyes
    are open.
    """
    known = np.isfinite(landmarks[:, 0]) & (model.landmark_weight > 0) & (model.landmark_face >= 0)
    if before is None:
        identity, expression = np.zeros(len(model.identity_basis)), np.zeros(len(model.expression_basis))
    else:
        identity, expression = before.identity, before.expression
    vertices = model.shape(identity, expression)
    named = model.landmarks(vertices)
    scale, rotation, translation = similarity_from_points(
        landmarks[known], named[known], weights=model.landmark_weight[known]
    )
    fit = HeadFit(scale, rotation, translation, identity, expression, vertices)
    usable = pullable_vertices(model)
    for reach in REACHES_MM if before is None else LATER_REACHES_MM:
        fit = _code_step(model, fit, points, landmarks, known, weights, usable, reach, pins)
    return fit


def _code_step(model, fit, points, landmarks, known, weights, usable, reach_mm, pins) -> HeadFit:
    """One linearised step of similarity and codes; the codes are solved whole, the similarity as an increment."""
    in_head, normals = fit.to_head(points), vertex_normals(fit.vertices, model.faces)
    near, offset, weight = _closest(fit.vertices, normals, usable, in_head, reach_mm)
    bases = model.identity_basis, model.expression_basis
    neutral = model.template
    n = normals[near]
    root = np.sqrt(weight * EFFECTIVE_TRACKS / len(points))[:, None] / weights.track_mm
    # n . (x_j + w x p + t + s p) with p the track point in head space, moving towards the surface point
    centre = in_head.mean(0)
    arm = in_head - centre
    moving = np.concatenate([np.cross(arm, n), n, (arm * n).sum(1, keepdims=True)], axis=1)
    shape_rows = np.einsum("kni,ni->nk", np.concatenate([basis[:, near] for basis in bases]), n)
    rows = [root * np.concatenate([-moving, shape_rows], axis=1)]
    rhs = [root[:, 0] * ((in_head - neutral[near]) * n).sum(1)]

    at = np.concatenate([_landmark_basis(model, basis, known) for basis in bases])
    base = interpolate(neutral, model.faces, model.landmark_face[known], model.landmark_bary[known])
    gain = np.sqrt(model.landmark_weight[known]) / weights.landmark_mm
    equations = [_place_rows(fit.to_head(landmarks[known]), base, at, gain, centre, (0, 1, 2))]
    pairs = APERTURES
    if pins is not None and len(pins.points):
        gain, pairs = np.full(len(pins.points), 1.0 / pins.deviation_mm), APERTURES[OF_EYES:]
        at = np.concatenate([pins.of(basis) for basis in bases])
        equations.append(_place_rows(fit.to_head(pins.points), pins.of(neutral), at, gain, centre, (0, 1)))
    equations.append(_aperture_rows(model, fit, landmarks, pairs, weights.aperture_mm))
    for block, right_side in equations:
        rows.append(block)
        rhs.append(right_side)
    codes = sum(map(len, bases))
    deviation = np.r_[
        np.full(len(model.identity_basis), weights.identity), np.full(len(model.expression_basis), weights.expression)
    ]
    rows.append(np.concatenate([np.zeros((codes, 7)), np.diag(1.0 / deviation)], axis=1))
    rhs.append(np.zeros(codes))
    lower = np.r_[np.full(7, -np.inf), np.full(len(model.identity_basis), -4.0), np.zeros(len(model.expression_basis))]
    upper = np.r_[np.full(7, np.inf), np.full(len(model.identity_basis), 4.0), np.ones(len(model.expression_basis))]
    matrix, target = np.concatenate(rows), np.concatenate(rhs)
    normal = matrix.T @ matrix + 1e-9 * np.eye(7 + codes)
    factor = np.linalg.cholesky(normal).T
    right = np.linalg.solve(factor.T, matrix.T @ target)
    # by active sets, to the last digit: an interior point stops near the bounds, where is chance
    solved = lsq_linear(factor, right, (lower, upper), method="bvls", tol=1e-13).x
    return _moved(model, fit, solved, centre)


def _place_rows(
    named: np.ndarray, base: np.ndarray, basis: np.ndarray, gain: np.ndarray, centre: np.ndarray, axes: tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """Equations that put places of the surface, base [N, 3] plus codes times basis [K, N, 3], at points named [N, 3] of
    head space that move about centre [3], along some axes; gain [N]."""
    arm, rows, rhs = named - centre, [], []
    for axis in axes:
        unit = np.eye(3)[axis]
        moving = np.concatenate([np.cross(arm, unit), np.tile(unit, (len(arm), 1)), arm[:, [axis]]], axis=1)
        rows.append(gain[:, None] * np.concatenate([-moving, basis[:, :, axis].T], axis=1))
        rhs.append(gain * (named - base)[:, axis])
    return np.concatenate(rows), np.concatenate(rhs)


def _moved(model: HeadModel, fit: HeadFit, solved: np.ndarray, centre: np.ndarray) -> HeadFit:
    """Applies rotation, shift and growth (about centre, head space) and takes over the codes."""
    turn, grow = rotation_from_vector(solved[:3]), float(np.exp(solved[6]))
    rotation = turn @ fit.rotation
    translation = grow * turn @ (fit.translation - centre) + centre + solved[3:6]
    identity, expression = np.split(solved[7:], [len(model.identity_basis)])
    vertices = model.shape(identity, expression)
    return HeadFit(fit.scale * grow, rotation, translation, identity, expression, vertices)


def _aperture_rows(model, fit, landmarks, pairs, deviation_mm) -> tuple[np.ndarray, np.ndarray]:
    """How far eyes and mouth are open tells the expression alone: heights between landmark pairs, in head space."""
    pairs = pairs[(model.landmark_face[pairs] >= 0).all(1) & np.isfinite(landmarks[pairs]).all((1, 2))]
    chosen = np.zeros(len(landmarks), bool)
    chosen[pairs] = True
    place = np.cumsum(chosen) - 1
    by_code = _landmark_basis(model, model.expression_basis, chosen)[..., 1]
    neutral = interpolate(model.template, model.faces, model.landmark_face[chosen], model.landmark_bary[chosen])[:, 1]
    heights = neutral + fit.identity @ _landmark_basis(model, model.identity_basis, chosen)[..., 1]
    observed = fit.to_head(landmarks)[:, 1]
    rows = np.zeros((len(pairs), 7 + len(fit.identity) + len(fit.expression)))
    rows[:, 7 + len(fit.identity) :] = (by_code[:, place[pairs[:, 0]]] - by_code[:, place[pairs[:, 1]]]).T
    open_when_neutral = heights[place[pairs[:, 0]]] - heights[place[pairs[:, 1]]]
    missing = observed[pairs[:, 0]] - observed[pairs[:, 1]] - open_when_neutral
    return rows / deviation_mm, missing / deviation_mm


def _landmark_basis(model: HeadModel, basis: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Blend shapes [K, V, 3] at the known landmarks [K, L, 3]."""
    corners = model.faces[model.landmark_face[known]]
    return np.einsum("klci,lc->kli", basis[:, corners], model.landmark_bary[known])


def pullable_vertices(model: HeadModel) -> np.ndarray:
    """Indices of vertices that tracks may pull: skin, not eyeballs, inner mouth or scalp."""
    held = ("eyes", "eye_sockets", "inner_mouth", "scalp")
    unpulled = [i for i, name in enumerate(model.segment_names) if name in held]
    faces = model.faces[~np.isin(model.face_segment, unpulled)]
    return np.unique(faces)


def _closest(vertices, normals, usable, points, reach_mm):
    """Nearest usable vertex of each point, the point's offset along its normal, and a Cauchy weight."""
    distance, index = cKDTree(vertices[usable]).query(points)
    near = usable[index]
    offset = ((points - vertices[near]) * normals[near]).sum(1)
    spread = 3.0 * np.median(np.abs(offset)) + 0.05
    return near, offset, cauchy_weight(offset, spread, distance < reach_mm)


def most_central(camera_from_points: np.ndarray) -> np.ndarray:
    """[F] indices of frames, those first that see the head from the middle of all views; camera_from_points
    [F, 4, 4]."""
    directions = normalised(camera_centres(camera_from_points))
    return np.argsort(-(directions @ normalised(directions.mean(0))))


def landmarks_on_points(
    landmarks_px: np.ndarray, camera_from_points: np.ndarray, points: np.ndarray, intrinsics: np.ndarray
) -> np.ndarray:
    """Landmarks [468, 3] as points: the pixel of each frame, at the depth of the track points around it, their median.

    landmarks_px [F, 468, 2], poses [F, 4, 4], points [N, 3]. Landmarks slide with the view, so that triangulating them
    would put their sliding into the depth; here they only tell where on the tracked surface a feature lies.
    """
    pixels, depth = project(points, camera_from_points, intrinsics)
    placed = np.zeros((len(landmarks_px), landmarks_px.shape[1], 3))
    for f, pose in enumerate(camera_from_points):
        distance, near = cKDTree(pixels[f]).query(landmarks_px[f], k=min(6, len(points)))
        weight = 1.0 / (distance + 1.0)
        z = (weight * depth[f][near]).sum(1, keepdims=True) / weight.sum(1, keepdims=True)
        ray = (landmarks_px[f] - intrinsics[:2, 2]) / intrinsics[[0, 1], [0, 1]]
        placed[f] = (np.concatenate([ray * z, z], axis=1) - pose[:3, 3]) @ pose[:3, :3]
    return np.median(placed, axis=0)


def triangulate(points_px: np.ndarray, camera_from_points: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    """Least-squares points [N, 3] from pixels points_px [F, N, 2] and poses [F, 4, 4] (Hartley and Zisserman, 12.2)."""
    x = (points_px - intrinsics[:2, 2]) / intrinsics[[0, 1], [0, 1]]
    pose = camera_from_points[:, None, :3]
    rows = pose[:, :, :2] - x[..., None] * pose[:, :, 2:]
    matrix = rows[..., :3].transpose(1, 0, 2, 3).reshape(points_px.shape[1], -1, 3)
    rhs = -rows[..., 3].transpose(1, 0, 2).reshape(points_px.shape[1], -1)
    normal = np.swapaxes(matrix, -1, -2) @ matrix + 1e-12 * np.eye(3)
    return np.linalg.solve(normal, np.swapaxes(matrix, -1, -2) @ rhs[..., None])[..., 0]
