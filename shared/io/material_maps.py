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
SUM_TOLERANCE = 5e-3
"""Of the sum of a texel's probabilities, which are rounded to half floats."""


def write_material(path: Path, probabilities: np.ndarray, half: bool, attributes: dict[str, str | int | float]) -> None:
    """[S, S, len(LABELS)] -> EXR; half, attributes: as of write_exr. LimnError for another number of materials."""
    if probabilities.ndim != 3 or probabilities.shape[2] != len(LABELS):
        raise LimnError(f"{path}: materials are [S, S, {len(LABELS)}], got {probabilities.shape}")
    likeliest = probabilities.argmax(2)[..., None].astype(probabilities.dtype)
    write_exr(path, np.concatenate([likeliest, probabilities], axis=2), colour_space="data", half=half,
              attributes=attributes, channels=CHANNELS)


def read_material(path: Path) -> np.ndarray:
    """-> float32 [S, S, len(LABELS)], as written. InputError when it is no such file."""
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
