"""Integrals over the hemisphere that tests compare with."""

from __future__ import annotations

import numpy as np


def hemisphere_quadrature(polar: int = 64, azimuth: int = 128) -> tuple[np.ndarray, np.ndarray]:
    """Directions [polar * azimuth, 3] about +z and solid angles: Gauss-Legendre in the cosine, uniform in azimuth.

    Exact weights for smooth integrands over the upper hemisphere; they sum to 2 pi.
    """
    node, weight = np.polynomial.legendre.leggauss(polar)
    cos = 0.5 * (node + 1.0)
    phi = (np.arange(azimuth) + 0.5) * 2.0 * np.pi / azimuth
    sin = np.sqrt(1.0 - cos * cos)
    z, angle = np.broadcast_arrays(cos[:, None], phi[None])
    directions = np.stack([sin[:, None] * np.cos(angle), sin[:, None] * np.sin(angle), z], axis=-1)
    solid = np.broadcast_to((0.5 * weight * 2.0 * np.pi / azimuth)[:, None], z.shape)
    return directions.reshape(-1, 3), solid.ravel().copy()
