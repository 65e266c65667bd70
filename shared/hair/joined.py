"""A head and its hair as one mesh with one set of maps, to be seen and lit together.

Vertices and faces of the head come first and keep their numbers. The maps lie side by side: the head's in the left half
of the atlas, the hair's in the right one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from shared.geometry.mesh import Mesh
from shared.geometry.surface import Surface

HAIR_SEGMENT = "hair"
HAIR_ROUGHNESS = 0.5
"""Of hair in maps; it has no highlights of that lobe."""


@dataclass(frozen=True, eq=False)
class HairSurface:
    """Hair that stands off the head: mesh, in head space, with UVs of its own; albedo [S, S, 3] linear; alpha [S, S]:
    how much of a place is hair."""

    mesh: Mesh
    albedo: np.ndarray
    alpha: np.ndarray


def joined_mesh(head: Mesh, hair: Mesh) -> Mesh:
    """Both in one; UVs: u of the head in 0 .. 0.5, of the hair in 0.5 .. 1."""
    return Mesh(
        np.concatenate([head.vertices, hair.vertices]),
        np.concatenate([head.faces, hair.faces + len(head.vertices)]).astype(np.int32),
        np.concatenate([head.uvs * [0.5, 1.0], hair.uvs * [0.5, 1.0] + [0.5, 0.0]]),
        np.concatenate([head.face_uvs, hair.face_uvs + len(head.uvs)]).astype(np.int32))


def joined_maps(maps: Mapping[str, np.ndarray], hair: HairSurface) -> dict[str, np.ndarray]:
    """maps: the head's diffuse_albedo [S, S, 3], specular_intensity [S, S] and roughness [S, S] -> the same [S, 2 S,
    ...] with the hair's beside them, and alpha [S, 2 S]."""
    size = len(hair.alpha)
    flat = {name: _resized(maps[name], size) for name in ("diffuse_albedo", "specular_intensity", "roughness")}
    beside = {"diffuse_albedo": hair.albedo, "specular_intensity": np.zeros_like(hair.alpha),
              "roughness": np.full_like(hair.alpha, HAIR_ROUGHNESS)}
    found = {name: np.concatenate([image, beside[name]], axis=1) for name, image in flat.items()}
    return found | {"alpha": joined_alpha(hair.alpha)}


def joined_alpha(alpha: np.ndarray) -> np.ndarray:
    """[S, 2 S]: the hair's alpha [S, S] beside that of the head, which is all there."""
    return np.concatenate([np.ones_like(alpha), alpha], axis=1)


def joined_surface(surface: Surface, hair: Mesh) -> Surface:
    """The surface with the hair's faces in a segment of their own."""
    names = (*surface.segment_names, HAIR_SEGMENT)
    segment = np.concatenate([surface.face_segment, np.full(len(hair.faces), len(names) - 1)])
    return replace(surface, mesh=joined_mesh(surface.mesh, hair), face_segment=segment, segment_names=names)


def _resized(image: np.ndarray, size: int) -> np.ndarray:
    """A map [S, S, ...] repeated to size."""
    times = size // len(image)
    return image if times <= 1 else np.repeat(np.repeat(image, times, 0), times, 1)
