"""Materials of a solved clip: what each place shows by the clip's own statistics, as a map, and what hides the skin."""

from __future__ import annotations

import numpy as np

from shared.appearance.material_features import surface_features
from shared.appearance.material_mixture import material_probabilities
from shared.appearance.problem import AppearanceState
from shared.compute.run_context import SILENT, RunContext
from shared.geometry.mesh import Mesh
from shared.geometry.mouth import inside_of_open_mouth
from shared.geometry.surface import Surface
from shared.hair.hair_pixels import BEARD
from shared.imaging.image_sampling import SurfaceViewer
from shared.imaging.material_labels import CLOTH, HAIR, UNKNOWN
from shared.imaging.texels import SmoothFields, TexelSurface
from shared.imaging.views import Views
from shared.rendering.shading import VertexShading

FRONT_OF_NECK = 0.3, 0.6
"""Cosine of the neck's normal to straight ahead: above the second a beard reaches there, below the first none does."""
COLLAR, COVERED = (0.1, 0.3), (0.65, 0.95)
"""Share of cloth on the neck, and of hair on an ear: up to the first there is no collar, or the ear is bare, whose
hollows look like hair, too; from the second on there is one, or hair covers the ear."""

FAR_EDGES = 100.0
"""Over which hair that some frame shows tells what grows where none does."""


def clip_materials(viewer: SurfaceViewer, shading: VertexShading, views: Views, surface: Surface,
                   state: AppearanceState, context: RunContext = SILENT) -> np.ndarray:
    """[V, len(LABELS)] of the viewer's vertices, rows that sum to 1; all unknown without segments.

    surface: with the segments of the viewer's mesh, or of one that was subdivided into it; state: of the solved fit.
    """
    typical = np.median(state.albedo, axis=0)
    features = surface_features(viewer, shading, views, typical, state.specular, context)
    return material_probabilities(surface.with_mesh(viewer.mesh), features)


def material_image(mesh: Mesh, materials: np.ndarray, size: int) -> np.ndarray:
    """[size, size, len(LABELS)] float32, gutters filled, of the vertices' materials [V, len(LABELS)]."""
    texels = TexelSurface(mesh, size)
    return texels.dilated(texels.to_image(texels.interpolate(materials)))


def hidden_places(viewer: SurfaceViewer, surface: Surface, materials: np.ndarray) -> np.ndarray:
    """[V] probability that frames show what hangs before a place, not the place: hair on ears that it covers and on the
    neck, but where a beard grows, and on a neck without a collar what looks like cloth. surface: the viewer's, with
    segments; materials [V, len(LABELS)]."""
    known, shown = _shown(materials)

    def share(label: int, inside: np.ndarray) -> float:
        return float((shown[inside, label] * known[inside]).sum() / max(known[inside].sum(), 1e-6))

    ears, neck, chin = (surface.vertices_of((name,)) for name in ("ears", "neck", "chin"))
    beard, collar = _ramp(share(HAIR, chin), BEARD), _ramp(share(CLOTH, neck), COLLAR)
    right = surface.mesh.vertices[:, 0] < 0.0
    right_covered, left_covered = _ramp(share(HAIR, ears & right), COVERED), _ramp(share(HAIR, ears & ~right), COVERED)
    covered = np.where(right, right_covered, left_covered)
    hair = np.select([ears, neck], [covered, 1.0 - beard * _ramp(viewer.normals[:, 2], FRONT_OF_NECK)])
    return hair * shown[:, HAIR] + (1.0 - collar) * neck * shown[:, CLOTH]


def matt_share(viewer: SurfaceViewer, surface: Surface, materials: np.ndarray, hidden: np.ndarray, scalp: np.ndarray
               ) -> np.ndarray:
    """[V] how much of a place has none of the surface's highlights: hair that grows there, whose own lie along its
    strands, so that the surface's lobe would shine like plastic, and the inside of an open mouth, of whose teeth and
    tongue the mesh knows nothing. What no frame shows continues the rest of scalp [V] bool, or of the skin. surface:
    the viewer's, with segments; materials [V, len(LABELS)]; hidden [V]: see hidden_places."""
    known, shown = _shown(materials)
    fields = SmoothFields(viewer.mesh, 1.0, FAR_EDGES, scalp)
    share = fields.through(shown[:, HAIR, None], FAR_EDGES * known[:, None], np.zeros(1))[:, 0]
    hair = np.where(surface.vertices_of(("ears",)), 0.0, np.clip(share, 0.0, 1.0) * (1.0 - hidden))
    return np.maximum(hair, inside_of_open_mouth(surface))


def _shown(materials: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """[V] how far each place is known, more than 0, and the materials [V, len(LABELS)] as shares of that."""
    known = np.maximum(1.0 - materials[:, UNKNOWN], 1e-6)
    return known, materials / known[:, None]


def _ramp(values: np.ndarray | float, limits: tuple[float, float]) -> np.ndarray | float:
    """0 up to the first limit, 1 from the second on; values [...]."""
    low, high = limits
    return np.clip((values - low) / (high - low), 0.0, 1.0)
