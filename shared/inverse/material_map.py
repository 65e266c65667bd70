"""The map of materials of a solved clip: what each texel shows, by the clip's own statistics."""

from __future__ import annotations

import numpy as np

from shared.appearance.material_features import surface_features
from shared.appearance.material_mixture import material_probabilities
from shared.compute.run_context import SILENT, RunContext
from shared.geometry.surface import Surface
from shared.imaging.texels import TexelSurface
from shared.inverse.problem import InverseResult


def material_map(result: InverseResult, surface: Surface, size: int, context: RunContext = SILENT) -> np.ndarray:
    """[size, size, len(LABELS)] float32 that sum to 1, gutters filled.

    surface: with the segments of the mesh that the result has, or that was subdivided into it; without segments
    everything is unknown.
    """
    state = result.solution.state
    features = surface_features(result.viewer, result.shading, result.views, np.median(state.albedo, axis=0),
                                state.specular, context)
    solved = surface.with_mesh(result.viewer.mesh)
    texels = TexelSurface(solved.mesh, size)
    return texels.dilated(texels.to_image(texels.interpolate(material_probabilities(solved, features))))
