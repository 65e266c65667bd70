"""A head model small enough to reason about: an egg with a nose, two identity shapes and one expression."""

from __future__ import annotations

import numpy as np
from shapes import sphere

from shared.geometry.mesh import vertex_normals
from shared.tracking.head_model import HeadModel


def toy_head(levels: int = 4) -> HeadModel:
    """An egg 150 x 220 x 190 mm that faces +z; landmarks sit on its front."""
    ball = sphere(1.0, levels)
    x, y, z = ball.vertices.T
    nose = 25.0 * np.exp(-((x / 0.18) ** 2 + (y / 0.25) ** 2)) * (z > 0)
    template = ball.vertices * [75.0, 110.0, 95.0] + np.stack([0 * x, 0 * y, nose], axis=1)
    normals = vertex_normals(template, ball.faces)
    wide = np.stack([4.0 * x, 0 * x, 0 * x], axis=1)
    long_nose = normals * (4.0 * nose / 25.0)[:, None]
    chin = normals * (6.0 * np.exp(-((x / 0.3) ** 2 + ((y + 0.8) / 0.3) ** 2)) * (z > 0))[:, None]
    centres = template[ball.faces].mean(1)
    front = np.nonzero(centres[:, 2] > 30.0)[0]
    chosen = front[np.linspace(0, len(front) - 1, 468).astype(int)]
    return HeadModel(
        template=template,
        identity_basis=np.stack([wide, long_nose]),
        expression_basis=chin[None],
        expression_names=("chin",),
        faces=ball.faces,
        uvs=ball.uvs,
        face_uvs=ball.face_uvs,
        face_segment=np.where(centres[:, 2] > 0, 0, 1).astype(np.uint8),
        segment_names=("face", "scalp"),
        landmark_face=chosen.astype(np.int32),
        landmark_bary=np.full((468, 3), 1.0 / 3.0),
        landmark_weight=np.ones(468),
    )
