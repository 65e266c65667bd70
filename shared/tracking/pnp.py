"""A robust pose from named points: the start of each frame.

Reference: [Lepetit2009] (EPnP) inside RANSAC, through pycolmap.
"""

from __future__ import annotations

import numpy as np

from shared.geometry.transforms import rigid


def pose_from_points(
    points: np.ndarray, points_px: np.ndarray, intrinsics: np.ndarray, size: tuple[int, int], max_error_px: float
) -> np.ndarray | None:
    """Robust pose from 3D-2D pairs: points [N, 3] mm, points_px [N, 2] -> camera_from_points [4, 4] or None."""
    import pycolmap  # here, since who tracks again from known poses needs none of it

    pycolmap.logging.minloglevel = 2
    fx, fy, cx, cy = intrinsics[0, 0], intrinsics[1, 1], intrinsics[0, 2], intrinsics[1, 2]
    width, height = (int(n) for n in size)
    camera = pycolmap.Camera(model="PINHOLE", width=width, height=height, params=[fx, fy, cx, cy], camera_id=1)
    estimation = pycolmap.AbsolutePoseEstimationOptions()
    estimation.ransac.max_error = max_error_px
    estimation.ransac.random_seed = 0
    answer = pycolmap.estimate_and_refine_absolute_pose(
        np.asarray(points_px, np.float64), np.asarray(points, np.float64), camera, estimation
    )
    if answer is None:
        return None
    pose = answer["cam_from_world"]
    return rigid(pose.rotation.matrix(), pose.translation)
