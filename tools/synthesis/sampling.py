"""Well spread sample points and the directions drawn from them.

References: [Duff2017] (tangent frames); [Dupuy2023] (visible normals of GGX).
"""

from __future__ import annotations

import numpy as np


def shifted_hammersley(count: int, sets: int, rng: np.random.Generator) -> np.ndarray:
    """[sets, count, 2] Hammersley points of the unit square, each set shifted by its own random offset (wrapped)."""
    index = np.arange(count)
    radical, weight, rest = np.zeros(count), 0.5, index.copy()
    while rest.any():
        radical += weight * (rest & 1)
        weight, rest = weight / 2, rest >> 1
    points = np.stack([(index + 0.5) / count, radical], 1)
    return (points + rng.random((sets, 1, 2))) % 1.0


def random_rotation(rng: np.random.Generator) -> np.ndarray:
    """[3, 3] a uniformly distributed rotation."""
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.sign(np.linalg.det(q))


def tangent_frame(normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """[N, 3] unit normals -> two tangents [N, 3] that complete a right-handed frame ([Duff2017], listing 3)."""
    x, y, z = normals[..., 0], normals[..., 1], normals[..., 2]
    sign = np.copysign(np.ones_like(z), z)
    a = -1.0 / (sign + z)
    b = x * y * a
    first = np.stack([1.0 + sign * x * x * a, sign * b, -sign * x], -1)
    return first, np.stack([b, sign + y * y * a, -y], -1)


def cosine_directions(normals: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Directions [N, K, 3] about unit normals [N, 3], of density cosine / pi, for points [N, K, 2] of the unit square.
    """
    ring, around = np.sqrt(points[..., :1]), 2 * np.pi * points[..., 1:]
    first, second = tangent_frame(normals)
    sideways = ring * (np.cos(around) * first[:, None] + np.sin(around) * second[:, None])
    return sideways + np.sqrt(1.0 - points[..., :1]) * normals[:, None]


def visible_ggx_normal(outgoing: np.ndarray, alpha: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Microfacet normals [N, 3] in the shading frame (z up), by the distribution of those seen from `outgoing`.

    outgoing [N, 3] unit, z > 0; alpha [N]; points [N, 2] of the unit square. The reflected direction then has density
    G1(o) D(h) / (4 cos_o) (Dupuy and Benyoub, listing 2).
    """
    stretched = outgoing * np.stack([alpha, alpha, np.ones_like(alpha)], -1)
    stretched /= np.linalg.norm(stretched, axis=-1, keepdims=True)
    phi = 2 * np.pi * points[..., 0]
    z = (1.0 - points[..., 1]) * (1.0 + stretched[..., 2]) - stretched[..., 2]
    ring = np.sqrt(np.clip(1.0 - z * z, 0.0, 1.0))
    half = np.stack([ring * np.cos(phi), ring * np.sin(phi), z], -1) + stretched
    half *= np.stack([alpha, alpha, np.ones_like(alpha)], -1)
    return half / np.maximum(np.linalg.norm(half, axis=-1, keepdims=True), 1e-12)
