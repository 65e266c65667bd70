"""What lies on a synthetic skin: make-up with sharp edges, and sweat."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tools.synthesis.skin import SkinPainter
from tools.synthesis.surface import Materials

EDGE_MM = 0.4
EYE_CENTRES = ((159, 145), (386, 374))
CHEEKS = (50, 280)
LIPSTICK, SHADOW, STRIPE = np.array([0.30, 0.02, 0.04]), np.array([0.06, 0.09, 0.20]), np.array([0.75, 0.72, 0.70])
SHADOW_MM, STRIPES_MM = 17.0, ((7.0, 3.0), (0.0, 3.0))
SWEAT_SPECULAR, SWEAT_ROUGHNESS = 1.9, 0.2


def made_up(materials: Materials, painter: SkinPainter, cover: float) -> Materials:
    """Lipstick, eye shadow and two pale stripes on each cheek; cover in [0, 1]: how opaque."""
    albedo = materials.albedo.astype(np.float64)
    for colour, share in ((LIPSTICK, painter.inside("lips").astype(float)), (SHADOW, _shadow(painter)),
                          (STRIPE, _stripes(painter))):
        albedo += (cover * share)[..., None] * (colour - albedo)
    return replace(materials, albedo=albedo.astype(np.float32))


def _edge(inside_mm: np.ndarray) -> np.ndarray:
    """1 inside, 0 outside, over EDGE_MM."""
    return np.clip(0.5 + inside_mm / EDGE_MM, 0.0, 1.0)


def _shadow(painter: SkinPainter) -> np.ndarray:
    """[size, size]: the skin around each eye, above it."""
    share = np.zeros(painter.place.shape[:2])
    for marks in EYE_CENTRES:
        centre = painter.landmarks[list(marks)].mean(0)
        offset = painter.place - centre
        share = np.maximum(share, _edge(SHADOW_MM - np.linalg.norm(offset, axis=-1)) * _edge(offset[..., 1] + 2.0))
    return share * ~painter.inside("eyes", "eye_sockets")


def _stripes(painter: SkinPainter) -> np.ndarray:
    """[size, size]: level stripes across the cheeks."""
    share = np.zeros(painter.place.shape[:2])
    for mark in CHEEKS:
        offset = painter.place - painter.landmarks[mark]
        near = _edge(16.0 - np.abs(offset[..., 0])) * (offset[..., 2] > -40.0)
        for height, half_width in STRIPES_MM:
            share = np.maximum(share, near * _edge(half_width - np.abs(offset[..., 1] + height)))
    return share


def sweaty(materials: Materials, wet: float) -> Materials:
    """A film of water on the face's skin: stronger and sharper highlights; wet in [0, 1]."""
    film = wet * materials.mask
    return replace(materials, specular=materials.specular + film * (SWEAT_SPECULAR - materials.specular),
                   roughness=materials.roughness + film * (SWEAT_ROUGHNESS - materials.roughness))
