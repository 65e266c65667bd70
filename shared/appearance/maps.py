"""The maps of a solved clip as images."""

from __future__ import annotations

import numpy as np

from shared.appearance.confidence import texel_confidence
from shared.appearance.fine_normals import normal_image
from shared.appearance.texture import TexelMaterial
from shared.geometry.eyeballs import EYE_ROUGHNESS
from shared.imaging.texels import TexelSurface


def make_maps(
    surface: TexelSurface,
    material: TexelMaterial,
    roughness: float | np.ndarray,
    turn: np.ndarray | None = None,
    eyes: np.ndarray | None = None,
    resolved: float = 0.0,
) -> dict[str, np.ndarray]:
    """UV-space images with filled gutters; roughness: one, or each vertex's [V]; turn [T, 2]: of the normals, None:
    they are the mesh's; eyes [E]: texels of the eyeballs, which are as smooth as tears, None: none are; resolved: as
    of texel_confidence."""
    confidence = texel_confidence(surface, material, resolved)
    at_vertices = np.broadcast_to(np.asarray(roughness), len(surface.mesh.vertices))[:, None]
    rough = surface.interpolate(at_vertices)[:, 0]
    if eyes is not None:
        rough[eyes] = EYE_ROUGHNESS
    return {
        "diffuse_albedo": surface.dilated(surface.to_image(material.albedo.astype(np.float32))),
        "specular_intensity": surface.dilated(surface.to_image(material.specular.astype(np.float32))),
        "roughness": surface.dilated(surface.to_image(rough)),
        "normal": normal_image(surface, turn),
        "confidence": surface.to_image(confidence.astype(np.float32)),
    }
