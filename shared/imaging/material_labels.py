"""Names and numbers of what a texel or a pixel shows: skin, lips, brow and lash, hair, eye, cloth, or unknown."""

from __future__ import annotations

LABELS = ("unknown", "skin", "lips", "brow", "hair", "eye", "cloth")
"""In the order of their numbers in maps/material.exr; brow: brows and lashes."""
UNKNOWN, SKIN, LIPS, BROW, HAIR, EYE, CLOTH = range(len(LABELS))

CLOTH_BELOW_MM = 15.0, 45.0
"""Below the chin: where cloth may begin, and where it is as likely as it gets."""
