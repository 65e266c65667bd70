"""Transfer functions and colour differences. Inside Limn colour is scene-linear Rec.709, white D65.

References: IEC 61966-2-1 (sRGB); ITU-R BT.709-6 section 1.2 (camera curve); CIE 142-2001 (CIEDE2000).
"""

from __future__ import annotations

import warnings

import numpy as np

TRANSFERS = ("srgb", "bt709", "linear")

XYZ_FROM_REC709 = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
)
LUMINANCE = XYZ_FROM_REC709[1]
WHITE_D65 = np.array([0.95047, 1.0, 1.08883])


def decode_srgb(codes: np.ndarray) -> np.ndarray:
    """sRGB code values in [0, 1] -> linear."""
    return np.where(codes <= 0.04045, codes / 12.92, ((np.maximum(codes, 0.0) + 0.055) / 1.055) ** 2.4)


def encode_srgb(linear: np.ndarray) -> np.ndarray:
    """Linear -> sRGB code values, clipped to [0, 1]."""
    linear = np.clip(linear, 0.0, 1.0)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055)


def decode_bt709(codes: np.ndarray) -> np.ndarray:
    """The camera's curve of BT.709 undone: code values in [0, 1] -> scene-linear."""
    return np.where(codes < 0.081, codes / 4.5, ((np.maximum(codes, 0.0) + 0.099) / 1.099) ** (1 / 0.45))


def decode_transfer(codes: np.ndarray, transfer: str) -> np.ndarray:
    """Code values in [0, 1] -> scene-linear float32. transfer: one of TRANSFERS; ValueError otherwise."""
    decoders = {"srgb": decode_srgb, "bt709": decode_bt709, "linear": np.asarray}
    if transfer not in decoders:
        raise ValueError(f"unknown transfer function {transfer!r}; known: {', '.join(TRANSFERS)}")
    return decoders[transfer](codes).astype(np.float32)


def linear_rec709_to_lab(rgb: np.ndarray) -> np.ndarray:
    """[..., 3] linear Rec.709 -> CIELAB under D65 (CIE 15:2004, 8.2.1); negative values count as zero."""
    ratio = np.clip(rgb, 0.0, None) @ XYZ_FROM_REC709.T / WHITE_D65
    f = np.where(ratio > (6 / 29) ** 3, np.cbrt(ratio), ratio / (3 * (6 / 29) ** 2) + 4 / 29)
    x, y, z = f[..., 0], f[..., 1], f[..., 2]
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], axis=-1)


def delta_e_2000(rgb_a: np.ndarray, rgb_b: np.ndarray) -> np.ndarray:
    """CIEDE2000 between linear Rec.709 colours [..., 3] -> [...]."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it misses matplotlib, which only its plots need
        from colour.difference import delta_E_CIE2000  # imports for a second; most callers never need it

    return delta_E_CIE2000(linear_rec709_to_lab(rgb_a), linear_rec709_to_lab(rgb_b))
