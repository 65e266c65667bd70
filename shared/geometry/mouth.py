"""Lips that meet: a slit between them that no open mouth leaves is shut; and the inside of a mouth that is open.

What is fitted to skin leaves the lips' margins where it will: in the corners of a mouth, which are dark, and where
beard or shadow hide the line, the mesh stays open by a millimetre or two, and shows an inside that no frame has seen.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d, maximum_filter1d

from shared.geometry.raycast import RayScene
from shared.geometry.surface import Surface
from shared.geometry.transforms import rotation_from_vector

OPEN_MM = 2.5
"""A slit so high somewhere is an open mouth."""
COLUMN_MM, ROW_MM = 0.25, 0.05
"""Between the lines of sight on which the inside of the mouth is looked for, across and up."""
OVERLAP_MM = 0.05
"""Lips that meet lie so far over each other, as seen from before them."""
WIDEN_MM, SMOOTH_MM = 1.0, 0.7
"""What is moved reaches so far beyond the slit's ends, and fades there."""
REACH_MM, DEPTH_MM = 7.0, 12.0
"""From the line between the lips, up and down, and behind it: skin so far away stays."""
PITCHES_DEG = np.array([0.0, -20.0, 20.0, 0.0, -20.0, 20.0, 0.0])
"""Of the head, as it is looked at time after time: lips that lie on each other are shut from above and below, too."""
MARGIN_MM = 3.0
"""So near to the line the lips tell how far ahead their margins are."""


def shut_lips(surface: Surface) -> np.ndarray:
    """Vertices [V, 3] mm of a head that looks along +z, with lips that meet; as they are where the mesh has no lips, no
    inside of the mouth, or a mouth that is open."""
    vertices = surface.mesh.vertices
    if not _has_mouth(surface):
        return vertices
    lips, inside = surface.vertices_of(("lips",)), surface.faces_of(("inner_mouth",))
    movable = surface.vertices_of(("lips", "inner_mouth", "upper_lip_skin", "chin"))
    for turn in rotation_from_vector(np.radians(PITCHES_DEG)[:, None] * [1.0, 0.0, 0.0]):
        seen = vertices @ turn.T
        slit = _slit(seen, surface.mesh.faces, inside, lips)
        if slit is not None and slit.stands_open:
            return surface.mesh.vertices
        if slit is not None:
            vertices = vertices + (_closed(seen, movable, lips, slit) - seen) @ turn
    return vertices


def inside_of_open_mouth(surface: Surface) -> np.ndarray:
    """[V] bool: vertices of the inside of a mouth that stands open, of a head that looks along +z; none of a mouth that
    is shut, or where the mesh has no lips or no inside."""
    if _has_mouth(surface):
        inside, lips = surface.faces_of(("inner_mouth",)), surface.vertices_of(("lips",))
        slit = _slit(surface.mesh.vertices, surface.mesh.faces, inside, lips)
        if slit is not None and slit.stands_open:
            return surface.vertices_of(("inner_mouth",))
    return np.zeros(len(surface.mesh.vertices), bool)


def _has_mouth(surface: Surface) -> bool:
    return surface.face_segment is not None and {"lips", "inner_mouth"} <= set(surface.segment_names)


@dataclass(frozen=True, eq=False)
class _Slit:
    """across [K] mm, even; bottom and top [K] mm: from where to where up the inside is seen there, NaN: not at all."""

    across: np.ndarray
    bottom: np.ndarray
    top: np.ndarray

    @property
    def stands_open(self) -> bool:
        """Is it as high somewhere as an open mouth's?"""
        return bool(np.nanmax(self.top - self.bottom) > OPEN_MM)


def _slit(vertices: np.ndarray, faces: np.ndarray, inside: np.ndarray, lips: np.ndarray) -> _Slit | None:
    """Where lines of sight along -z meet faces inside [F] bool first; None where none does. lips [V] bool."""
    low, high = vertices[lips].min(0), vertices[lips].max(0)
    across, up = np.arange(low[0], high[0], COLUMN_MM), np.arange(low[1], high[1], ROW_MM)
    origins = np.stack(np.broadcast_arrays(across[:, None], up, high[2] + 10.0), axis=-1).reshape(-1, 3)
    face = RayScene(vertices, faces).first_faces(origins, np.broadcast_to([0.0, 0.0, -1.0], origins.shape))
    seen = ((face >= 0) & inside[face]).reshape(len(across), len(up))
    if not seen.any():
        return None
    first, last = seen.argmax(1), seen.shape[1] - 1 - seen[:, ::-1].argmax(1)
    bottom, top = (np.where(seen.any(1), up[at] + half, np.nan) for at, half in
                   ((first, -0.5 * ROW_MM), (last, 0.5 * ROW_MM)))  # fmt: skip
    return _Slit(across, bottom, top)


def _closed(vertices: np.ndarray, movable: np.ndarray, lips: np.ndarray, slit: _Slit) -> np.ndarray:
    """Vertices [V, 3] with both sides of the slit moved to its middle, those movable [V] bool; lips [V] bool."""
    shown = np.isfinite(slit.top)
    middle = np.interp(slit.across, slit.across[shown], 0.5 * (slit.bottom + slit.top)[shown])
    half = np.where(shown, 0.5 * (slit.top - slit.bottom + OVERLAP_MM), 0.0)
    width = 2 * round(WIDEN_MM / COLUMN_MM) + 1
    half = gaussian_filter1d(maximum_filter1d(half, width), SMOOTH_MM / COLUMN_MM)
    middle = gaussian_filter1d(middle, SMOOTH_MM / COLUMN_MM, mode="nearest")

    x, y, z = vertices.T
    line, half = np.interp(x, slit.across, middle), np.interp(x, slit.across, half, left=0.0, right=0.0)
    margin = lips & (np.abs(y - line) < MARGIN_MM)
    front = np.polynomial.Polynomial.fit(x[margin], z[margin], 4)
    behind = front(np.clip(x, x[margin].min(), x[margin].max())) - z
    share = _fading((np.abs(y - line) - half) / REACH_MM) * _fading(behind / DEPTH_MM) * movable
    moved = vertices.copy()
    moved[:, 1] -= np.sign(y - line) * share * half
    return moved


def _fading(way: np.ndarray) -> np.ndarray:
    """1 up to way 0, 0 from 1 on, smooth between."""
    return 0.5 + 0.5 * np.cos(np.pi * np.clip(way, 0.0, 1.0))
