"""Bring a result's head frame onto the ground truth's: a similarity from camera centres, then trimmed ICP.

A result may use any head frame and any scale. The camera centres of the common frames give a first similarity; a
trimmed point-to-plane ICP [Chen1992] with a weak point-to-point term, on the true face's points only, gives the final
one. Arrays in, arrays out.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from shared.geometry.mesh import Mesh, vertex_normals
from shared.geometry.transforms import Similarity, camera_centres, rotation_from_vector, similarity_from_points
from shared.imaging.texture import sample_bilinear

FACE_SAMPLES = 20_000
SURFACE_SAMPLES = 600_000
FACE_MARGIN_MM = 40.0
POINT_TO_POINT_WEIGHT = 0.03


def sample_surface(
    mesh: Mesh, count: int, rng: np.random.Generator, face_weight: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Random points, uniform over the area: points [N,3], angle-weighted normals [N,3], faces [N].

    face_weight [F] multiplies each face's area.
    """
    face, bary = random_places(mesh, count, rng, face_weight)
    corners, normals = mesh.vertices[mesh.faces[face]], vertex_normals(mesh.vertices, mesh.faces)[mesh.faces[face]]
    return (corners * bary[..., None]).sum(1), (normals * bary[..., None]).sum(1), face


def random_places(
    mesh: Mesh, count: int, rng: np.random.Generator, face_weight: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Random places, uniform over the area: faces [N] and corner weights [N, 3]; face_weight [F]: times the area."""
    corners = mesh.vertices[mesh.faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    weight = area if face_weight is None else area * face_weight
    face = rng.choice(len(mesh.faces), count, p=weight / weight.sum())
    root, second = np.sqrt(rng.random(count)), rng.random(count)
    return face, np.stack([1 - root, root * (1 - second), root * second], 1)


def sample_face_skin(mesh: Mesh, mask: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Points [N,3] and normals [N,3] of the true mesh where the UV mask [H,W] exceeds one half."""
    inside = sample_bilinear(mask, mesh.uvs[mesh.face_uvs].mean(1)) > 0.5
    points, normals, _ = sample_surface(mesh, FACE_SAMPLES, rng, inside.astype(float))
    return points, normals


def sample_result(
    mesh: Mesh, start: Similarity, face_points: np.ndarray, face_normals: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Dense points [N,3] and outward normals [N,3] of the result, in its own frame, near the face where possible."""
    points, normals, face = sample_surface(mesh, SURFACE_SAMPLES, rng)
    reach = np.ptp(face_points, axis=0) * 0.5 + FACE_MARGIN_MM
    near = (np.abs(start.points(points) - face_points.mean(0)) < reach).all(1)
    if near.sum() > 5000:
        keep = np.zeros(len(mesh.faces))
        keep[face[near]] = 1.0
        points, normals, _ = sample_surface(mesh, SURFACE_SAMPLES, rng, keep)
    subset = slice(None, None, 10)
    nearest = cKDTree(face_points).query(start.points(points[subset]))[1]
    agreement = ((normals[subset] @ start.rotation.T) * face_normals[nearest]).sum(1)
    return points, -normals if np.median(agreement) < 0 else normals


def similarity_from_poses(truth: np.ndarray, result: np.ndarray) -> Similarity:
    """camera_from_head [F,4,4] of truth and result -> truth_from_result by their camera centres."""
    return Similarity(*similarity_from_points(camera_centres(result), camera_centres(truth)))


def refine_by_icp(
    face_points: np.ndarray,
    face_normals: np.ndarray,
    points: np.ndarray,
    normals: np.ndarray,
    tree: cKDTree,
    start: Similarity,
    iterations: int = 40,
) -> Similarity:
    """Trimmed ICP of the result's dense points onto the true face, from `start`. tree: over `points`.

    Correspondences go from the true face to the result, so a result that covers more than the face costs nothing.
    The first eight rounds trim by distance only, later ones by distance and by normal (60 degrees).
    """
    current = start
    for iteration in range(iterations):
        distance, nearest = tree.query(current.inverse_points(face_points), workers=2)
        distance = distance * current.scale
        if iteration < 8:
            keep = distance < max(4 * np.median(distance), 2.0)
        else:
            facing = (face_normals * (normals[nearest] @ current.rotation.T)).sum(1) > 0.5
            keep = (distance < max(3 * np.median(distance), 0.3)) & facing
        moved = current.points(points[nearest[keep]])
        centre = moved.mean(0)
        step = _similarity_step(moved - centre, face_points[keep] - moved, face_normals[keep])
        turn, stretch = rotation_from_vector(step[:3]), np.exp(step[6])
        current = Similarity(
            current.scale * stretch,
            turn @ current.rotation,
            stretch * turn @ (current.translation - centre) + centre + step[3:6],
        )
        if np.abs(step).max() < 1e-6:
            break
    return current


def _similarity_step(arms: np.ndarray, offsets: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Gauss-Newton step [7] (rotation vector, shift, log scale) that moves centred points [N,3] by offsets [N,3]."""

    def accumulate(direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        scale_part = (arms * direction).sum(1, keepdims=True)
        jacobian = np.concatenate([np.cross(arms, direction), direction, scale_part], 1)
        return jacobian.T @ jacobian, jacobian.T @ (offsets * direction).sum(1)

    matrix, vector = accumulate(normals)
    for axis in np.eye(3):
        point_matrix, point_vector = accumulate(np.broadcast_to(axis, arms.shape))
        matrix = matrix + POINT_TO_POINT_WEIGHT * point_matrix
        vector = vector + POINT_TO_POINT_WEIGHT * point_vector
    return np.linalg.solve(matrix, vector)


def surface_distance(
    face_points: np.ndarray, points: np.ndarray, normals: np.ndarray, tree: cKDTree, alignment: Similarity
) -> np.ndarray:
    """[N] mm from each true face point to the result's surface.

    Distance to the tangent plane of the nearest dense sample; to the sample itself where it is too far away for the
    plane to mean anything (holes, borders).
    """
    distance, nearest = tree.query(alignment.inverse_points(face_points), workers=2)
    distance = distance * alignment.scale
    offset = face_points - alignment.points(points[nearest])
    plane = np.abs((offset * (normals[nearest] @ alignment.rotation.T)).sum(1))
    spacing = alignment.scale * np.median(tree.query(points[:2000], k=2)[0][:, 1])
    return np.where(distance < 6 * spacing + 2 * plane, plane, distance)


def result_poses(truth_poses: np.ndarray, alignment: Similarity) -> np.ndarray:
    """camera_from_head [F, 4, 4] of the truth -> of the result, in its unit; alignment: truth_from_result."""
    poses = truth_poses.copy()
    poses[:, :3, 3] = (truth_poses[:, :3, :3] @ alignment.translation + truth_poses[:, :3, 3]) / alignment.scale
    poses[:, :3, :3] = truth_poses[:, :3, :3] @ alignment.rotation
    return poses
