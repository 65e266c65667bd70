"""Rigid motions, pinhole projection and point-set alignment.

Transforms are 4x4 matrices named target_from_source. Cameras follow OpenCV (x right, y down, z forward) with pixel
centres at integer + 0.5.

Reference: [Umeyama1991] (similarity between point sets).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

WORLD_FROM_CAMERA = np.diag([1.0, -1.0, -1.0])
"""The world's axes (y up, z towards the camera) from the camera's (y down, z away from it)."""


def rotation_from_vector(rotation_vector: np.ndarray) -> np.ndarray:
    """[..., 3] axis times angle in radians -> [..., 3, 3] rotation matrices."""
    from scipy.spatial.transform import Rotation

    vector = np.asarray(rotation_vector, np.float64)
    return Rotation.from_rotvec(vector.reshape(-1, 3)).as_matrix().reshape(vector.shape[:-1] + (3, 3))


def vector_from_rotation(rotation: np.ndarray) -> np.ndarray:
    """[..., 3, 3] rotation matrices -> [..., 3] axis times angle in radians."""
    from scipy.spatial.transform import Rotation

    matrix = np.asarray(rotation, np.float64)
    return Rotation.from_matrix(matrix.reshape(-1, 3, 3)).as_rotvec().reshape(matrix.shape[:-2] + (3,))


def rigid(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """[..., 3, 3] and [..., 3] -> [..., 4, 4]."""
    rotation, translation = np.asarray(rotation, np.float64), np.asarray(translation, np.float64)
    transform = np.zeros(rotation.shape[:-2] + (4, 4))
    transform[..., :3, :3], transform[..., :3, 3], transform[..., 3, 3] = rotation, translation, 1.0
    return transform


def invert_rigid(transform: np.ndarray) -> np.ndarray:
    """[..., 4, 4] rigid -> its inverse: [R t]^-1 = [R^T -R^T t]."""
    transposed = np.swapaxes(transform[..., :3, :3], -1, -2)
    return rigid(transposed, -np.einsum("...ij,...j->...i", transposed, transform[..., :3, 3]))


def project(points: np.ndarray, camera_from_head: np.ndarray, intrinsics: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pinhole projection. points [N, 3] mm, pose [4, 4], intrinsics [3, 3] -> pixels [N, 2], depth [N] mm.

    Leading dimensions of the pose broadcast: [F, 4, 4] gives [F, N, 2] and [F, N].
    """
    rotation, translation = camera_from_head[..., :3, :3], camera_from_head[..., :3, 3]
    in_camera = np.einsum("...ij,nj->...ni", rotation, points) + translation[..., None, :]
    depth = in_camera[..., 2]
    pixels = in_camera[..., :2] / depth[..., None] * intrinsics[[0, 1], [0, 1]] + intrinsics[:2, 2]
    return pixels, depth


def pixel_rays(pixels: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    """[N, 3] directions in camera space with z = 1 through pixels [N, 2] of a picture with intrinsics [3, 3]."""
    return np.column_stack([(pixels - intrinsics[:2, 2]) / intrinsics[[0, 1], [0, 1]], np.ones(len(pixels))])


def projection_slope(points: np.ndarray, camera_from_head: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    """[P, 2, 3]: derivative of the pixels by the points [P, 3] in head space, pose [4, 4]."""
    in_camera = points @ camera_from_head[:3, :3].T + camera_from_head[:3, 3]
    depth = in_camera[:, 2:]
    focal = intrinsics[[0, 1], [0, 1]]
    slope = np.zeros((len(points), 2, 3))
    slope[:, 0, 0], slope[:, 1, 1] = focal[0] / depth[:, 0], focal[1] / depth[:, 0]
    slope[:, :, 2] = -focal * in_camera[:, :2] / depth**2
    return slope @ camera_from_head[:3, :3]


def camera_centres(camera_from_head: np.ndarray) -> np.ndarray:
    """[..., 4, 4] -> [..., 3]: where the camera stands in head space, mm."""
    return invert_rigid(camera_from_head)[..., :3, 3]


def rotation_range_deg(camera_from_head: np.ndarray) -> float:
    """Largest angle between two frames' views of the head, in degrees; poses [F, 4, 4]."""
    centres = camera_centres(camera_from_head)
    directions = centres / np.linalg.norm(centres, axis=-1, keepdims=True)
    return float(np.degrees(np.arccos(np.clip((directions @ directions.T).min(), -1.0, 1.0))))


def world_from_head(camera_from_head: np.ndarray, moves: str) -> np.ndarray:
    """[F, 4, 4] -> [F, 3, 3]: turns head-space directions into the space in which the light stands still.

    moves "head": the camera's axes turned to y up; "camera": head space itself, so the identity.
    """
    if moves == "camera":
        return np.broadcast_to(np.eye(3), camera_from_head.shape[:-2] + (3, 3)).copy()
    return WORLD_FROM_CAMERA @ camera_from_head[..., :3, :3]


def places_in_world(camera_from_head: np.ndarray, moves: str) -> np.ndarray:
    """[..., 4, 4] -> [..., 3] mm: where the head's origin is in that space, whose own origin is the camera if the head
    moves, and the head's if the camera does."""
    if moves == "camera":
        return np.zeros(camera_from_head.shape[:-2] + (3,))
    return camera_from_head[..., :3, 3] @ WORLD_FROM_CAMERA


def nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    """The rotation [3, 3] closest to a matrix [3, 3] in the Frobenius norm [Kabsch1976]."""
    u, _, vt = np.linalg.svd(matrix)
    return u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt


def turns_from_mean(rotations: np.ndarray) -> np.ndarray:
    """[F, 3] rotation vectors (camera axes) of rotations [F, 3, 3] from their mean."""
    return vector_from_rotation(rotations @ nearest_rotation(rotations.sum(0)).T)


def similarity_from_points(
    source: np.ndarray, target: np.ndarray, with_scale: bool = True, weights: np.ndarray | None = None
) -> tuple[float, np.ndarray, np.ndarray]:
    """Weighted least-squares similarity target ~ scale * R @ source + t ([Umeyama1991], eqs. 40 to 43).

    source, target [N, 3]; weights [N] or None -> scale, R [3, 3], t [3].
    """
    w = np.ones(len(source)) if weights is None else np.asarray(weights, np.float64)
    w = w / w.sum()
    mean_source, mean_target = w @ source, w @ target
    a, b = source - mean_source, target - mean_target
    u, singular, vt = np.linalg.svd((b * w[:, None]).T @ a)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = u * signs @ vt
    scale = float((singular * signs).sum() / (w[:, None] * a**2).sum()) if with_scale else 1.0
    return scale, rotation, mean_target - scale * rotation @ mean_source


@dataclass(frozen=True)
class Similarity:
    """x_target = scale * rotation @ x_source + translation."""

    scale: float
    rotation: np.ndarray
    translation: np.ndarray

    def points(self, points: np.ndarray) -> np.ndarray:
        """[N, 3] source -> [N, 3] target."""
        return self.scale * points @ self.rotation.T + self.translation

    def inverse_points(self, points: np.ndarray) -> np.ndarray:
        """[N, 3] target -> [N, 3] source."""
        return (points - self.translation) @ self.rotation / self.scale

    def pose(self, camera_from_source: np.ndarray) -> np.ndarray:
        """[..., 4, 4] rigid camera_from_source in source units -> camera_from_target in target units: the camera's
        space grows with the source's, so that pictures stay what they are."""
        rotation = camera_from_source[..., :3, :3] @ self.rotation.T
        return rigid(rotation, self.scale * camera_from_source[..., :3, 3] - rotation @ self.translation)


def fibonacci_sphere(count: int) -> np.ndarray:
    """[count, 3] unit directions, nearly uniform over the sphere (golden-angle spiral), each worth 4 pi / count sr."""
    index = np.arange(count) + 0.5
    z = 1.0 - 2.0 * index / count
    radius, azimuth = np.sqrt(1.0 - z * z), np.pi * (1.0 + 5.0**0.5) * index
    return np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], axis=1)
