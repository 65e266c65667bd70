"""Look-ups in UV-space textures.

Convention: v points up, texture row 0 is v = 1, texel centres at (column + 0.5) / width; coordinates repeat.
"""

from __future__ import annotations

import numpy as np


def sample_bilinear(texture: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """[H,W] or [H,W,C] texture, [N,2] uv -> [N] or [N,C] values, bilinear, wrapped at the borders."""
    height, width = texture.shape[:2]
    x = uv[:, 0] * width - 0.5
    y = (1.0 - uv[:, 1]) * height - 0.5
    column, row = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    shape = (-1,) + (1,) * (texture.ndim - 2)
    dtype = np.result_type(texture.dtype, np.float32)
    fx = (x - column).astype(dtype).reshape(shape)
    fy = (y - row).astype(dtype).reshape(shape)
    left, right = column % width, (column + 1) % width
    top, bottom = row % height, (row + 1) % height
    upper = texture[top, left] * (1 - fx) + texture[top, right] * fx
    lower = texture[bottom, left] * (1 - fx) + texture[bottom, right] * fx
    return upper * (1 - fy) + lower * fy
