"""Transfer functions, primaries and colour differences. Inside Limn colour is scene-linear Rec.709, white D65.

References: IEC 61966-2-1 (sRGB); ITU-R BT.709-6 section 1.2 (camera curve); ITU-R BT.2100-2 tables 4 and 5 (PQ, HLG);
CIE 142-2001 (CIEDE2000); SMPTE RP 177 (matrix of primaries); [Lam1985] (Bradford adaptation, as in ICC.1:2022 annex E).
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np

TRANSFERS = ("srgb", "bt709", "linear")
CLIPPED_CODE, CRUSHED_CODE = 0.98, 0.012
"""Shares of the largest code from and to which a pixel tells only that it was at least so bright, or at most."""

XYZ_FROM_REC709 = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
)
LUMINANCE = XYZ_FROM_REC709[1]
_BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
WHITE_D65 = np.array([0.95047, 1.0, 1.08883])


def eight_bit(codes: np.ndarray) -> np.ndarray:
    """uint8 or uint16 code values -> uint8."""
    return codes if codes.dtype == np.uint8 else (codes >> 8).astype(np.uint8)


def decode_srgb(codes: np.ndarray) -> np.ndarray:
    """sRGB code values in [0, 1] -> linear."""
    return np.where(codes <= 0.04045, codes / 12.92, ((np.maximum(codes, 0.0) + 0.055) / 1.055) ** 2.4)


def encode_srgb(linear: np.ndarray) -> np.ndarray:
    """linear [...] -> sRGB code values, clipped to [0, 1]."""
    linear = np.clip(linear, 0.0, 1.0)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055)


def decode_bt709(codes: np.ndarray) -> np.ndarray:
    """The camera's curve of BT.709 undone: code values in [0, 1] -> scene-linear."""
    return np.where(codes < 0.081, codes / 4.5, ((np.maximum(codes, 0.0) + 0.099) / 1.099) ** (1 / 0.45))


def encode_bt709(linear: np.ndarray) -> np.ndarray:
    """linear [...] -> code values of BT.709's camera curve, clipped to [0, 1]."""
    linear = np.clip(linear, 0.0, 1.0)
    return np.where(linear < 0.018, 4.5 * linear, 1.099 * np.maximum(linear, 1e-9) ** 0.45 - 0.099)


def decode_hlg(codes: np.ndarray) -> np.ndarray:
    """Hybrid log-gamma code values in [0, 1] -> scene-linear, 1 at the largest code."""
    a, b, c = 0.17883277, 0.28466892, 0.55991073
    return np.where(codes <= 0.5, codes**2 / 3, (np.exp((np.maximum(codes, 0.5) - c) / a) + b) / 12)


def decode_pq(codes: np.ndarray) -> np.ndarray:
    """PQ code values in [0, 1] -> scene-linear, 1 where a display shows 1000 cd/m2 (HLG's nominal peak).

    Display light by the EOTF, then the reference OOTF (BT.709's camera curve and a display's gamma of 2.4) undone.
    """
    m1, m2, c1, c2, c3 = 2610 / 16384, 2523 / 4096 * 128, 3424 / 4096, 2413 / 4096 * 32, 2392 / 4096 * 32
    power = np.clip(codes, 0.0, 1.0) ** (1 / m2)
    hundreds = 100 * (np.maximum(power - c1, 0.0) / (c2 - c3 * power)) ** (1 / m1)  # of 100 cd/m2
    return decode_bt709(hundreds ** (1 / 2.4)) / decode_bt709(np.array(10.0 ** (1 / 2.4)))


def rec709_from_primaries(chromaticities: Sequence[float]) -> np.ndarray:
    """[3, 3] from linear RGB of other primaries to linear Rec.709, white to white (Bradford).

    chromaticities: x and y of red, green, blue and white. ValueError where they span no colour space.
    """
    red, green, blue, white = np.asarray(chromaticities, np.float64).reshape(4, 2)
    if not np.isfinite(chromaticities).all() or min(white) <= 1e-3 or min(abs(y) for _, y in (red, green, blue)) < 1e-6:
        raise ValueError("primaries without a place")
    white_xyz = _xyz(white)
    columns = np.stack([_xyz(xy) for xy in (red, green, blue)], axis=1)
    if abs(np.linalg.det(columns / np.linalg.norm(columns, axis=0))) < 1e-3:
        raise ValueError("primaries on a line")
    xyz_from_rgb = columns * np.linalg.solve(columns, white_xyz)
    own = XYZ_FROM_REC709.sum(axis=1)
    adapt = np.linalg.solve(_BRADFORD, (_BRADFORD @ own / (_BRADFORD @ white_xyz))[:, None] * _BRADFORD)
    return np.linalg.solve(XYZ_FROM_REC709, adapt @ xyz_from_rgb)


def _xyz(xy: np.ndarray) -> np.ndarray:
    return np.array([xy[0] / xy[1], 1.0, (1 - xy[0] - xy[1]) / xy[1]])


def decode_transfer(codes: np.ndarray, transfer: str) -> np.ndarray:
    """Code values in [0, 1] -> scene-linear float32. transfer: one of TRANSFERS; ValueError otherwise."""
    decoders = {"srgb": decode_srgb, "bt709": decode_bt709, "linear": np.asarray}
    if transfer not in decoders:
        raise ValueError(f"unknown transfer function {transfer!r}; known: {', '.join(TRANSFERS)}")
    return decoders[transfer](codes).astype(np.float32)


def encode_transfer(linear: np.ndarray, transfer: str) -> np.ndarray:
    """Scene-linear -> code values in [0, 1]. transfer: one of TRANSFERS."""
    return {"srgb": encode_srgb, "bt709": encode_bt709, "linear": lambda x: np.clip(x, 0.0, 1.0)}[transfer](linear)


def linear_rec709_to_lab(rgb: np.ndarray) -> np.ndarray:
    """[..., 3] linear Rec.709 -> CIELAB under D65 (CIE 15:2004, 8.2.1); negative values count as zero."""
    ratio = np.clip(rgb, 0.0, None) @ XYZ_FROM_REC709.T / WHITE_D65
    f = np.where(ratio > (6 / 29) ** 3, np.cbrt(ratio), ratio / (3 * (6 / 29) ** 2) + 4 / 29)
    x, y, z = f[..., 0], f[..., 1], f[..., 2]
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], axis=-1)


def delta_e_2000(rgb_a: np.ndarray, rgb_b: np.ndarray) -> np.ndarray:
    """CIEDE2000 between linear Rec.709 colours rgb_a [..., 3] and rgb_b [..., 3] -> [...]."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it misses matplotlib, which only its plots need
        from colour.difference import delta_E_CIE2000  # imports for a second; most callers never need it

    return delta_E_CIE2000(linear_rec709_to_lab(rgb_a), linear_rec709_to_lab(rgb_b))
