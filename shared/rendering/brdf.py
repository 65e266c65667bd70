"""The reflectance model: Lambert plus a Cook-Torrance lobe, and its integrals.

    f = albedo / pi + specular_intensity * D(h) G1(i) G1(o) F(o.h) / (4 cos_i cos_o)

with the GGX distribution D, Smith's separable masking G1, Schlick's Fresnel term F for a base of 4 % and
alpha = roughness^2. Everything is written on cosines with plain operators, so numpy arrays and torch tensors both work
and torch can differentiate it.

References: [Walter2007] (eqs. 33, 34); [Schlick1994] (Fresnel term); [Burley2012] (alpha = roughness^2).
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

F0 = 0.04
"""Normal-incidence reflectance of the specular base at specular_intensity 1 (index of refraction 1.5)."""

MINIMUM_COSINE = 1e-3


def ggx_distribution(n_dot_h, roughness):
    """D(h) per steradian ([Walter2007] eq. 33): alpha^2 / (pi ((n.h)^2 (alpha^2 - 1) + 1)^2)."""
    alpha2 = roughness**4
    base = n_dot_h * n_dot_h * (alpha2 - 1.0) + 1.0
    return alpha2 / (np.pi * base * base)


def smith_masking(n_dot_v, roughness):
    """G1(v) ([Walter2007] eq. 34): 2 c / (c + sqrt(alpha^2 + (1 - alpha^2) c^2)) for c = n.v >= 0."""
    alpha2 = roughness**4
    return 2.0 * n_dot_v / (n_dot_v + (alpha2 + (1.0 - alpha2) * n_dot_v * n_dot_v) ** 0.5)


def schlick_fresnel(o_dot_h, f0: float = F0):
    """F = F0 + (1 - F0) (1 - o.h)^5."""
    away = 1.0 - o_dot_h
    return f0 + (1.0 - f0) * away * away * away * away * away


def specular_cosine(n_dot_o, n_dot_i, o_dot_i, roughness):
    """f_specular * cos_i at specular_intensity 1, per steradian: D G1(i) G1(o) F / (4 cos_o).

    Arguments are cosines between unit vectors (normal, outgoing, incoming) that broadcast against each other; the
    half vector needs no construction: |o + i|^2 = 2 + 2 o.i. Below the horizon of either direction the value is 0.
    """
    above = 1.0 * ((n_dot_o > 0) & (n_dot_i > 0))
    cos_o = n_dot_o * above + MINIMUM_COSINE * (1.0 - above)
    cos_i = n_dot_i * above + MINIMUM_COSINE * (1.0 - above)
    length = (2.0 + 2.0 * o_dot_i * above + 1e-7) ** 0.5
    n_dot_h = (cos_o + cos_i) / length
    n_dot_h = n_dot_h * (n_dot_h < 1.0) + 1.0 * (n_dot_h >= 1.0)
    o_dot_h = 0.5 * length
    o_dot_h = o_dot_h * (o_dot_h < 1.0) + 1.0 * (o_dot_h >= 1.0)
    masking = smith_masking(cos_o, roughness) * smith_masking(cos_i, roughness)
    lobe = ggx_distribution(n_dot_h, roughness) * masking * schlick_fresnel(o_dot_h)
    return lobe / (4.0 * cos_o) * above


def directional_albedo(n_dot_o: np.ndarray, roughness: float) -> np.ndarray:
    """[N] cosines -> [N] fraction of light from a white sphere that the lobe returns towards o, specular_intensity 1.

    Integrated over half vectors, where D n.h is smooth however narrow the lobe:
    integral f cos_i dw_i = integral F G1(i) G1(o) (o.h) / (cos_o) D dw_h (change of variable 4 o.h).
    """
    return microfacet_integrals(n_dot_o, roughness)[0]


def microfacet_integrals(n_dot_o: np.ndarray, roughness: float, samples: int = 48) -> np.ndarray:
    """[N] cosines -> [3, N]: directional albedo and the split-sum factors A, B with albedo = F0 A + B.

    The half vector is sampled by inverting D's distribution on a product grid (midpoints in both random numbers), so
    that each sample carries the weight G (o.h) / (cos_o n.h) [Karis2013].
    """
    cos_o = np.maximum(np.atleast_1d(np.asarray(n_dot_o, np.float64)), MINIMUM_COSINE)
    alpha2 = float(roughness) ** 4
    u = (np.arange(samples) + 0.5) / samples
    cos_h = np.sqrt((1.0 - u) / (1.0 + (alpha2 - 1.0) * u))
    sin_h = np.sqrt(1.0 - cos_h**2)
    phi = (np.arange(2 * samples) + 0.5) * np.pi / (2 * samples)
    sin_o = np.sqrt(1.0 - cos_o**2)
    o_dot_h = cos_o[:, None, None] * cos_h[:, None] + (sin_o[:, None, None] * sin_h[:, None]) * np.cos(phi)
    cos_i = 2.0 * o_dot_h * cos_h[:, None] - cos_o[:, None, None]
    valid = (cos_i > 0) & (o_dot_h > 0)
    masking = smith_masking(np.where(valid, cos_i, 1.0), roughness) * smith_masking(cos_o, roughness)[:, None, None]
    weight = np.where(valid, masking * o_dot_h / (cos_o[:, None, None] * cos_h[:, None]), 0.0)
    fresnel = schlick_fresnel(np.clip(o_dot_h, 0.0, 1.0), 0.0)
    scale, bias = (weight * (1.0 - fresnel)).mean((1, 2)), (weight * fresnel).mean((1, 2))
    return np.stack([F0 * scale + bias, scale, bias])


@lru_cache(maxsize=64)
def hemispherical_albedo(roughness: float) -> float:
    """What the lobe returns of a white sphere's light, averaged over cosine-weighted outgoing directions."""
    node, weight = np.polynomial.legendre.leggauss(24)
    cos = 0.5 * (node + 1.0)
    return float((weight * cos * directional_albedo(cos, roughness)).sum())
