"""The map of materials as a file: a channel for the probability of each, and the number of the likeliest.

Channel Y holds the number of the likeliest material (imaging.material_labels), for programs that read one channel;
numbers are not to be interpolated. The other channels hold probabilities, named as the materials are.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from shared.errors import InputError, LimnError
from shared.imaging.material_labels import LABELS
from shared.io.images import read_channels, write_exr

CHANNELS = ("Y", *LABELS)
LABEL_COLOURS = np.array([[40, 40, 40], [226, 180, 154], [196, 70, 92], [120, 76, 30], [64, 98, 220], [245, 245, 245],
                          [64, 176, 96]], np.uint8)
"""[len(LABELS), 3] sRGB codes in which pictures show the materials."""
LABEL_WORDS = {"skin": "pink", "hair": "blue", "brow": "brown", "lips": "red", "eye": "white", "cloth": "green",
               "unknown": "grey"}
"""The same in words."""
STEPS = 64
"""Probabilities are stored as multiples of 1 / STEPS, in a fifth of the bytes."""
SUM_TOLERANCE = 5e-3
"""Of the sum of a texel's probabilities."""


def write_material(path: Path, probabilities: np.ndarray, half: bool, attributes: dict[str, str | int | float]) -> None:
    """[S, S, len(LABELS)] that sum to 1 -> EXR, rounded to multiples of 1 / STEPS that do, too; half, attributes: as of
    write_exr. LimnError for another number of materials."""
    if probabilities.ndim != 3 or probabilities.shape[2] != len(LABELS):
        raise LimnError(f"{path}: materials are [S, S, {len(LABELS)}], got {probabilities.shape}")
    rounded = rounded_shares(probabilities)
    likeliest = rounded.argmax(2)[..., None].astype(rounded.dtype)
    write_exr(path, np.concatenate([likeliest, rounded], axis=2), colour_space="data", half=half,
              attributes=attributes, channels=CHANNELS)


def rounded_shares(shares: np.ndarray) -> np.ndarray:
    """[..., N] that sum to 1 -> float32 multiples of 1 / STEPS that do: rounded down, and what is missing goes to the
    largest remainders (the Hare-Niemeyer method)."""
    scaled = np.asarray(shares, np.float64) * STEPS
    whole = np.floor(scaled)
    missing = np.round(STEPS - whole.sum(-1, keepdims=True))
    rank = np.argsort(np.argsort(whole - scaled, axis=-1, kind="stable"), axis=-1, kind="stable")
    return ((whole + (rank < missing)) / STEPS).astype(np.float32)


def read_material(path: Path) -> np.ndarray:
    """-> float32 [S, S, len(LABELS)], as stored. InputError when it is no such file."""
    found = read_channels(path)
    if set(found) != set(CHANNELS):
        raise InputError("an EXR of other channels", where=str(path), got=", ".join(sorted(found)) or "none",
                         expected=", ".join(CHANNELS))
    return np.stack([found[name] for name in LABELS], axis=-1)


def material_errors(probabilities: np.ndarray) -> list[str]:
    """Sentences about probabilities [S, S, len(LABELS)] that do not add up."""
    off = np.abs(probabilities.sum(2) - 1.0)
    return [f"probabilities of a texel add up to 1 within {off.max():.3g} only"] if off.max() > SUM_TOLERANCE else []


def label_picture(probabilities: np.ndarray) -> np.ndarray:
    """[S, S, len(LABELS)] -> uint8 [S, S, 3] sRGB: each texel in the colour of its likeliest material."""
    return LABEL_COLOURS[probabilities.argmax(2)]
