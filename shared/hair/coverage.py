"""How much of a shell about the head is hair: alpha, by what frames show where it lies.

Each texel of the shell is looked at in all frames that face it. Their evidence is multiplied, not averaged: a place
before the neck shows dark hair behind it from one side, and skin from another, and is nothing itself (as space carving
has it, [Kutulakos2000]). Hair grows downwards: what is not connected to the crown is something else. Where no frame
looks, hair goes on as it is beside.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse
from scipy.sparse.csgraph import connected_components

from shared.compute.smooth_step import smooth_step
from shared.geometry.mesh import Mesh, diffused, mesh_edges
from shared.geometry.raycast import RayScene
from shared.hair.hair_pixels import HAIR_PIXEL
from shared.hair.shell_grid import ShellGrid
from shared.imaging.image_sampling import Picture, SurfaceViewer
from shared.imaging.texels import TexelSurface
from shared.imaging.views import Views

LEAST_SEEN, SEEN_WELL = 0.05, 1.0
"""Sum of squared view cosines over frames, in frames, from which on a texel speaks for itself, and a vertex for its
surroundings."""
BESIDE = 0.25, 0.5
"""Squared view cosine up to which a place that shows the background is one where the shell is a little too wide, and
from which on there is no hair."""
HELD, GOES_ON = 10.0, (3.0, 0.5)
"""How much what is seen counts beside one step from place to place, and such steps around and down: unseen, hair ends
where it does beside."""
EDGE = 0.4, 0.7
"""Share of hair that frames agree on from which on something, and everything, of a texel is hair."""
LEAST_SHARE = 0.02
"""Of hair in a pixel, by what is believed of it: no frame alone rules hair out."""
LEAST_COSINE = 0.05
"""Of a look that tells where hair ends: at its border it curves away."""
BORDER_STEPS = 2
"""Edges beyond what is connected to the crown over which alpha may still run out."""
HAIRLINE_STEPS, HAIRLINE_DEEP = 4, 0.9
"""Of diffusion, which spread the border of hair by two edges or nine millimetres; and from which value on within that
border hair hides the skin."""
LIES_MM, STANDS_MM = 4.0, 10.0
"""Thickness up to which hair lies on the skin and may let it be seen, and from which on it hides it."""


@dataclass(frozen=True, eq=False)
class SeenHair:
    """Of a shell's texels: how often frames look at them, by squared view cosine [T], and the mean of the logarithm of
    the share of hair that these show there [T]."""

    looks: np.ndarray
    log_hair: np.ndarray


def look_for_hair(grid: ShellGrid, texels: TexelSurface, kinds: Mapping[int, np.ndarray], views: Views,
                  share: np.ndarray | None = None) -> SeenHair:
    """What frames show at the shell's texels; kinds {frame: [H, W, 3]}: share of hair, skin and cloth in its pixels, 0
    of all where there is nobody; share [V]: of hair at the vertices, as far as it is known: looks go past what is not;
    None: all is there. About the skull the background says nothing: the shell is a little too wide there."""
    mesh = texels.mesh
    there = np.ones(len(mesh.faces), bool) if share is None else share[mesh.faces].mean(1) > 0.5
    viewer = SurfaceViewer(mesh, RayScene(mesh.vertices, mesh.faces[there]))
    viewer.least_cosine = LEAST_COSINE
    looks, hair = np.zeros((2, len(texels)))
    hangs = np.repeat((np.arange(len(grid.base)) >= grid.domed)[:, None], grid.columns, 1)
    hangs = texels.interpolate(grid.of_vertices(hangs.astype(np.float32))[:, None])[:, 0]
    for f, shares in kinds.items():
        lens = views.intrinsics[f]
        picture = Picture((shares,), np.zeros(shares.shape, np.int8), np.ones(shares.shape[:2], np.float32))
        view = viewer.view(views.camera_from_head[f], lens, shares.shape[1::-1])
        samples, _ = texels.samples(texels.frame_view(view, picture, lens))
        shown, weight = np.clip(samples.colours, 0.0, 1.0), samples.weight
        person = shown.sum(1).clip(max=1.0)
        facing = hangs[samples.rows] * np.clip((weight - BESIDE[0]) / (BESIDE[1] - BESIDE[0]), 0.0, 1.0)
        beside = (1.0 - person) * facing
        told = person * np.log(np.maximum(shown[:, HAIR_PIXEL] / np.maximum(person, 1e-6), LEAST_SHARE))
        looks[samples.rows] += weight * (person + beside)
        hair[samples.rows] += weight * (told + beside * np.log(LEAST_SHARE))
    return SeenHair(looks, hair / np.maximum(looks, 1e-9))


def covered(grid: ShellGrid, texels: TexelSurface, seen: SeenHair) -> np.ndarray:
    """[V] in 0 .. 1 of the shell's vertices: how much hair there is, also where no frame looks."""
    means, weight = texels.to_vertices(seen.log_hair[:, None], seen.looks[:, None])
    means, weight = grid.of_grid(np.exp(means[:, 0])), grid.of_grid(weight[:, 0])
    known = weight / (weight + SEEN_WELL)
    share = np.clip(grid.smoothest(means, HELD * known, 0.0, *GOES_ON), 0.0, 1.0)
    share = grid.of_vertices(share)
    edges = mesh_edges(texels.mesh.faces)[0]
    both = (share[edges] > 0.5).all(1)
    count = len(share)
    graph = sparse.coo_matrix((np.ones(both.sum()), edges[both].T), shape=(count, count))
    _, part = connected_components(graph, directed=False)
    top = part[grid.of_grid(np.arange(count))[: grid.domed // 2].ravel()]
    grown = (part == np.bincount(top).argmax()) & (share > 0.5)
    return share * (diffused(grown.astype(float), texels.mesh.faces, BORDER_STEPS) > 0.0)


def alpha_of(texels: TexelSurface, seen: SeenHair, share: np.ndarray) -> np.ndarray:
    """[T] float32 in 0 .. 1: the share of hair at texels, sharper than frames that are a little apart have it; share
    [V]: at the vertices, which speaks where frames do not look."""
    around = texels.interpolate(share[:, None])[:, 0]
    own = (seen.looks * np.exp(seen.log_hair) + LEAST_SEEN * around) / (seen.looks + LEAST_SEEN)
    own = np.where(around > 0.0, own, 0.0)
    low, high = EDGE
    return smooth_step((own - low) / (high - low)).astype(np.float32)


def at_hairline(grid: ShellGrid, mesh: Mesh, share: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """[V] in 0 .. 1: what alpha is multiplied by, where hair begins on the skull: there the head's own map shows how it
    thins out, and a shell's edge before it would be a cut. share [V] of hair at the vertices of the grid's mesh; radius
    [R, C] mm of the shell."""
    within = diffused((share > 0.5).astype(float), mesh.faces, HAIRLINE_STEPS)
    hides = smooth_step((within - 0.5) / (HAIRLINE_DEEP - 0.5))
    lies = 1.0 - np.clip((radius - grid.base - LIES_MM) / (STANDS_MM - LIES_MM), 0.0, 1.0)
    lies[grid.domed:] = 0.0
    return 1.0 - grid.of_vertices(lies) * (1.0 - hides)
