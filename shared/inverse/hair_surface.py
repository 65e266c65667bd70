"""Hair that stands off the head of a solved clip: its surface, its alpha, its albedo, and the light on both."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from shared.appearance.observations import face_front
from shared.appearance.texture_pass import TexturePass
from shared.compute.run_context import SILENT, RunContext
from shared.geometry.mesh import Mesh
from shared.geometry.parts import mesh_part
from shared.geometry.raycast import RAY_START_MM
from shared.geometry.surface import Surface
from shared.hair.coverage import alpha_of, at_hairline, covered, look_for_hair
from shared.hair.hair_pixels import CLOTH_PIXEL, HairPixels
from shared.hair.hull import LEAST_MM, hull_radius
from shared.hair.joined import HAIR_ROUGHNESS, HairSurface, joined_alpha, joined_surface
from shared.hair.shell_grid import ShellGrid
from shared.hair.streaks import with_streaks
from shared.imaging.frame_index import spread_frames
from shared.imaging.image_sampling import SurfaceViewer, sample_colours
from shared.imaging.texels import TexelSurface
from shared.imaging.views import Views
from shared.inverse.problem import FACE_SKIN
from shared.rendering.precomputed_transfer import PrecomputedTransfer
from shared.rendering.render import solid_viewer
from shared.rendering.shading import VertexShading
from shared.rendering.transfer import mesh_points

FRAMES, COLOUR_FRAMES = 24, 8
"""That hair is looked for in, and that its mean colour is taken from."""
ABOVE_EARS_MM, BELOW_CHIN_MM = 20.0, 110.0
"""The skull's centre over the middle of the ears; and how far down hair is looked for."""
COARSE = 256
"""Texels along the edge of the map by which it is first told where hair is."""
LEAST_DOME = 0.3
"""Share of the skull's grid that hair has to cover to be more than what a scalp shows by itself."""
LEAST_SHARE, SURE = 0.2, 0.8
"""Of hair at a face's corners below which there is no surface, and from which on its colour is hair's."""
BENEATH = ("scalp", "ears", "forehead")
"""Segments that hair may press flat."""
FACED = -0.1
"""Least cosine to some view of a vertex that is lit: those around what is seen are, too."""
SEEN = 1.0
"""Information on a texel's log albedo from which on its own streaks are known."""
GAP_MM = 1.0
"""Between hair and what it presses flat."""
SHADOW_DIRECTIONS, SHADOW_BLOCK = 192, 4096
"""That the light which hair keeps off the head is summed along, and vertices at a time."""
SHADOW_SPREAD = 12.0**-0.5
"""Standard deviation of what hair keeps off, over what its hull does: hulls are larger, so it is anything from none of
that to all."""


@dataclass(frozen=True, eq=False)
class StandingHair:
    """mesh: hair's surface, in head space; share [V] of hair at its vertices; alpha [S, S] of its map; head: the head's
    mesh with the scalp and the ears that lie beneath pressed flat; record: what is worth recording."""

    mesh: Mesh
    share: np.ndarray
    alpha: np.ndarray
    head: Mesh
    record: dict


@dataclass(frozen=True, eq=False)
class HairyHead:
    """Head and hair under the clip's light: one surface, whose first vertices and faces are the head's; viewer,
    shading: of all of it, light and looks going past what is not half there; head, hair: meshes of all vertices and of
    one's faces, with the UVs of its own maps."""

    surface: Surface
    viewer: SurfaceViewer
    shading: VertexShading
    head: Mesh
    hair: Mesh

    def with_hair(self, values: np.ndarray) -> np.ndarray:
        """[V, ...]: values [N, ...] of the head's vertices, with 0 at the hair's."""
        missing = len(self.surface.mesh.vertices) - len(values)
        return np.concatenate([values, np.zeros((missing, *values.shape[1:]), values.dtype)])


def find_hair(viewer: SurfaceViewer, surface: Surface, materials: np.ndarray, views: Views, size: int,
              context: RunContext = SILENT) -> StandingHair | None:
    """None where it covers too little of the skull to be told from a scalp, or no frame shows where it ends.

    viewer: of the solved head, surface: with its segments; materials [V, len(LABELS)]; size: edge of hair's map.
    """
    ears = viewer.mesh.vertices[surface.vertices_of(("ears",))].mean(0)
    centre = np.array([0.0, ears[1] + ABOVE_EARS_MM, ears[2]])
    fitted = np.nonzero(views.fitted)[0]
    frames = fitted[spread_frames(len(fitted), FRAMES, views.light_index[fitted])]
    pixels = HairPixels(viewer, surface, materials, views, centre)
    pixels.learn(frames)
    kinds, solids = {}, {}
    for f in context.progress(frames, "hair"):
        kinds[f], mesh = pixels.probabilities(f)
        inner = cv2.erode(mesh.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(np.float32)
        solids[f] = np.maximum(kinds[f].sum(-1) - kinds[f][..., CLOTH_PIXEL], inner)
    grid = ShellGrid.about(viewer.scene, surface.faces_of(("ears",)), centre, pixels.chin_mm - BELOW_CHIN_MM)
    radius, _ = hull_radius(grid, solids, views)
    shell = TexelSurface(grid.mesh(radius), COARSE)
    share = grid.of_grid(covered(grid, shell, look_for_hair(grid, shell, kinds, views)))
    dome = float((share[: grid.domed] > 0.5).mean())
    if dome < LEAST_DOME:
        context.note(f"hair: it covers {dome:.0%} of the skull at most: no surface of its own")
        return None
    # Where hair ends on the skull it grows there; lower down it hangs free.
    bare = (share < 0.5) & (np.arange(len(share)) < grid.domed)[:, None]
    radius, said = hull_radius(grid, solids, views, bare)
    shell = TexelSurface(grid.mesh(radius), size)
    share = covered(grid, shell, look_for_hair(grid, shell, kinds, views))
    seen = look_for_hair(grid, shell, kinds, views, share)  # past what is before the face
    share = covered(grid, shell, seen)
    thins = shell.interpolate(at_hairline(grid, shell.mesh, share, radius)[:, None])[:, 0]
    alpha = shell.dilated(shell.to_image(thins * alpha_of(shell, seen, share)))
    thick = (radius - grid.base)[(grid.of_grid(share) > 0.5) & (said > 0.0)]
    if not len(thick):
        context.note("hair: no outline tells how far out it reaches: no surface of its own")
        return None
    head = _pressed(viewer.mesh, surface, grid, radius, grid.of_grid(share))
    mesh, used = mesh_part(shell.mesh, (share > LEAST_SHARE)[shell.mesh.faces].any(1))
    record = {"thickness_mm": round(float(np.median(thick)), 1), "skull_covered": round(dome, 3),
              "seen_share": round(float((seen.looks > 0).mean()), 3),
              "lowest_mm": round(float(mesh.vertices[:, 1].min() - pixels.chin_mm), 1)}
    context.note(f"hair: a surface of its own, {record}")
    return StandingHair(mesh, share[used], alpha, head, record)


def light_hair(hair: StandingHair, surface: Surface, views: Views, precomputed: PrecomputedTransfer,
               shading: VertexShading, error_mm: float) -> HairyHead:
    """Hair under the solved light, shaded by itself and by the head, which it casts no shadow on (see
    PrecomputedTransfer.with_standing). surface, precomputed, shading: the head's; error_mm: of its surface."""
    both = joined_surface(surface.with_mesh(hair.head), hair.mesh)
    viewer = solid_viewer(both.mesh, joined_alpha(hair.alpha)).within_rim(error_mm)
    count = len(surface.mesh.vertices)
    faced = np.nonzero(face_front(viewer, views.camera_from_head, FACED))[0]
    index = faced[faced >= count]
    points = mesh_points(both.mesh, index)
    transfer = shading.transfer.followed_by(precomputed.with_standing(viewer).trace(points))
    material, local = shading.material, shading.material.local_roughness
    if local is not None:
        material = replace(material, local_roughness=np.append(local, np.full(len(index), HAIR_ROUGHNESS)))
    joined, faces = both.mesh, len(surface.mesh.faces)
    lit = shading.of_points(np.append(shading.index, index), joined.vertices, shading.points.followed_by(points),
                            transfer, material)
    head = Mesh(joined.vertices, joined.faces[:faces], surface.mesh.uvs, surface.mesh.face_uvs)
    own = Mesh(joined.vertices, joined.faces[faces:], hair.mesh.uvs, hair.mesh.face_uvs)
    return HairyHead(both, viewer, lit, head, own)


def light_kept_off(lit: HairyHead, surface: Surface, shading: VertexShading) -> np.ndarray:
    """[V]: by how much the light at the head's vertices may be wrong, in its logarithm, since hair casts no shadow on
    the head: the share that it keeps off, in the mean over the frames, beside that of the median of the face's skin, by
    which the light was solved. surface, shading: the head's before it got hair."""
    rng = np.random.default_rng(0)
    some = rng.choice(len(shading.directions), min(SHADOW_DIRECTIONS, len(shading.directions)), replace=False)
    towards, brightness = shading.directions[some], shading.light_along[some].mean((1, 2))
    start = shading.points.positions + RAY_START_MM * shading.points.normals
    share = np.zeros(len(start))
    for first in range(0, len(start), SHADOW_BLOCK):
        part = slice(first, first + SHADOW_BLOCK)
        arriving = shading.transfer.direct[part][:, some] * brightness
        point, direction = np.nonzero(arriving > 0.0)
        blocked = lit.viewer.scene.occluded(start[part][point], towards[direction])
        lost = np.bincount(point, arriving[point, direction] * blocked, len(arriving))
        share[part] = lost / np.maximum(arriving.sum(1), 1e-12)
    on_face = surface.vertices_of(FACE_SKIN)[shading.index]
    found = np.zeros(len(surface.mesh.vertices))
    found[shading.index] = SHADOW_SPREAD * np.abs(share - np.median(share[on_face]))
    return found


def texture_hair(hair: StandingHair, lit: HairyHead, views: Views, context: RunContext) -> HairSurface:
    """The surface with an albedo: no highlights, since its strands have others than a surface."""
    texels = TexelSurface(lit.hair, len(hair.alpha))
    share = np.zeros(len(lit.surface.mesh.vertices))
    share[-len(hair.share):] = hair.share
    typical = _typical_albedo(lit, share > SURE, views)
    texture = TexturePass(texels, lit.viewer, lit.shading, views, specular=0.0, typical_albedo=typical,
                          hidden=1.0 - share, matt=np.ones(len(share)), context=context)
    material, _ = texture.run((np.inf,))
    albedo = texels.dilated(texels.to_image(np.minimum(material.albedo, 1.0).astype(np.float32)))
    seen = texels.dilated(texels.to_image(material.information)) > SEEN
    return HairSurface(hair.mesh, with_streaks(albedo, seen), hair.alpha)


def _typical_albedo(lit: HairyHead, chosen: np.ndarray, views: Views) -> np.ndarray:
    """[3] median over frames and the chosen vertices [V] bool."""
    found = []
    fitted = np.nonzero(views.fitted)[0]
    for f in fitted[spread_frames(len(fitted), COLOUR_FRAMES)]:
        picture = views.picture(f)
        view = lit.viewer.view(views.camera_from_head[f], views.intrinsics[f], views.size)
        rows = np.nonzero(chosen & (view.weight > 0.0))[0]
        light = np.maximum(lit.shading.irradiance(f)[rows], 1e-4)
        found.append(sample_colours(picture, view.pixels[rows]) / light)
    return np.clip(np.median(np.concatenate(found), axis=0), 0.005, 0.9)


def _pressed(mesh: Mesh, surface: Surface, grid: ShellGrid, radius: np.ndarray, share: np.ndarray) -> Mesh:
    """The head's mesh with what comes out of hair that covers it pressed beneath. radius, share [R, C] of the grid."""
    places = np.array(mesh.vertices)
    index = np.nonzero(surface.vertices_of(BENEATH))[0]
    row, column, out = grid.locate(places[index])
    most = np.maximum(grid.read(radius, row, column) - GAP_MM, LEAST_MM)
    over = (grid.read(share, row, column) > 0.5) & (out > most)
    index, row, shrink = index[over], row[over], (most / np.maximum(out, 1e-6))[over]
    axis = np.where((row < grid.domed - 1)[:, None], grid.centre, places[index] * [0, 1, 0] + grid.centre * [1, 0, 1])
    places[index] = axis + shrink[:, None] * (places[index] - axis)
    return mesh.replace(vertices=places)
