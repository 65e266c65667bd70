"""Every texel's material under a light that is solved: what it shows, albedo and highlights, relief, and hair."""

from __future__ import annotations

import numpy as np

from shared.appearance.catchlights import check_catchlights
from shared.appearance.fine_normals import NormalPass, resolved_texels
from shared.appearance.fit import Solution
from shared.appearance.grain import with_grain
from shared.appearance.maps import make_maps
from shared.appearance.texture_pass import TexturePass
from shared.compute.run_context import RunContext
from shared.geometry.mesh import diffused_over
from shared.geometry.surface import Surface
from shared.imaging.image_sampling import SurfaceViewer
from shared.imaging.material_labels import SKIN
from shared.imaging.texels import TexelSurface
from shared.imaging.turning_eyes import LIDS, EyeTexels, TurningEyes
from shared.imaging.views import Views
from shared.inverse.hair_surface import find_hair, light_hair, light_kept_off, texture_hair
from shared.inverse.material_map import clip_materials, hidden_places, matt_share
from shared.inverse.problem import FACE_SKIN, InverseSettings, shade_vertices
from shared.inverse.result import SolvedTexels
from shared.rendering.eye_shine import EyeShine
from shared.rendering.precomputed_transfer import PrecomputedTransfer

SPECULAR_WIDTHS = (np.inf, 1 / 16, 1 / 64)
"""Relative to the map: over which texels share their specular intensity, for held-out frames to choose from."""
SURELY = 0.8
"""Probability from which on a vertex of the face counts as skin, whose grain is that of all other skin."""
WHOLE = 0.999
"""Share of a texel's corners that is all of them."""
HAIRLINE_MM = 10.0
"""Bends of the hairline shorter than this are the mesh's, not the hair's."""


def solve_texels(
    views: Views, surface: Surface, viewer: SurfaceViewer, precomputed: PrecomputedTransfer, settings: InverseSettings,
    solution: Solution, stands_off: bool, context: RunContext,
) -> tuple[SolvedTexels, dict]:
    """The texels, and what is worth recording. surface, viewer, precomputed: of the solved mesh; stands_off: whether
    frames show that the scalp is not the head's outline, so that hair has a surface of its own."""
    shading = shade_vertices(views, viewer, precomputed, settings.appearance, solution, context)
    texels, mesh = TexelSurface(surface.mesh, settings.map_size), surface.mesh
    typical = np.median(solution.state.albedo, axis=0)
    materials = clip_materials(viewer, shading, views, surface, solution.state, context)
    scalp, hidden, matt, bare = scalp_of(surface), None, None, surface.vertices_of(FACE_SKIN)
    skin = bare & (materials[:, SKIN] > SURELY)
    if scalp is not None:
        hidden = hidden_places(viewer, surface, materials)
        matt = matt_share(viewer, surface, materials, hidden, scalp)
    standing, hair, shaded = None, None, None
    if scalp is not None and stands_off:
        standing = find_hair(viewer, surface, materials, views, settings.map_size, context)
    if standing is not None:
        lit = light_hair(standing, surface, views, precomputed, shading, viewer.error_mm)
        shaded = lit.with_hair(light_kept_off(lit, surface, shading))
        viewer, shading, surface, mesh = lit.viewer, lit.shading, lit.surface, standing.head
        texels = TexelSurface(lit.head, settings.map_size)
        scalp, hidden, matt, bare, skin = (lit.with_hair(values) for values in (scalp, hidden, matt, bare, skin))
        hair = texture_hair(standing, lit, views, context)
    eyes = None if views.gaze is None else TurningEyes.of(surface)
    eye_texels = None if eyes is None else EyeTexels(texels, viewer, eyes, surface.faces_of(LIDS))
    texture = TexturePass(
        texels, viewer, shading, views, specular=solution.state.specular, typical_albedo=typical,
        light_weights=solution.light_weights, region=scalp, bare=bare, hidden=hidden, matt=matt, shaded=shaded,
        context=context, eyes=eye_texels,
    )
    widths = settings.map_size * np.array(SPECULAR_WIDTHS if settings.appearance.specular else (np.inf,))
    material, texture_record = texture.run(widths)
    material = with_grain(texels, material, _kinds(texels, skin, scalp, eye_texels))
    turn, relief, resolved = None, {}, resolved_texels(texels, views)
    if settings.normal_map:
        fine = NormalPass(texels, viewer, shading, views, material, context)
        turn, relief = fine.run(resolved)
        if eye_texels is not None:
            turn[eye_texels.rows] = 0.0  # it was seen where the texel does not stay
        context.note(f"fine normals: {relief}")
    catchlights = None if eyes is None else check_catchlights(views, eyes, EyeShine(viewer, shading, eyes))
    roughness, local = solution.state.roughness, solution.local_roughness_fit
    roughness = roughness if local is None else local.roughness(texels.mesh.vertices)
    maps = make_maps(texels, material, roughness, turn, None if eye_texels is None else eye_texels.rows, resolved)
    record = {
        "texture": texture_record,
        "relief": relief,
        "hair": {} if standing is None else standing.record,
        "catchlights": catchlights,
    }
    shown = viewer if hair is None else SurfaceViewer.of(surface.mesh)
    return SolvedTexels(material, maps, mesh, materials, shown, shading, eyes, hair), record


def _kinds(
    texels: TexelSurface, skin: np.ndarray, scalp: np.ndarray | None, eyes: EyeTexels | None
) -> list[tuple[np.ndarray, np.ndarray]]:
    """What with_grain takes: the scalp, and all else but the eyes, which is like skin; skin, scalp [V] bool of
    vertices."""
    of_skin, rest = texels.interpolate(skin[:, None])[:, 0] > WHOLE, np.ones(len(texels), np.float32)
    if eyes is not None:
        rest[eyes.rows] = 0.0
    if scalp is None:
        return [(of_skin, rest)]
    share = texels.interpolate(scalp[:, None])[:, 0]
    return [(share > WHOLE, share), (of_skin, rest - share)]


def scalp_of(surface: Surface) -> np.ndarray | None:
    """[V] bool: vertices of the scalp, whose hair says nothing of the skin, within a border as smooth as a hairline;
    None where the mesh has no segments."""
    if surface.face_segment is None:
        return None
    return diffused_over(surface.mesh, surface.vertices_of(("scalp",)).astype(float), HAIRLINE_MM) > 0.5
