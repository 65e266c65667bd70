"""The head's outline in the frames: points of the occluding contour of the mesh against the border of the person mask.

A point of the occluding contour is where an edge of the mesh turns from the camera's side to the far side. It counts
where nothing of the mesh lies beyond it and the mask's border is near: there the outline has to touch the border. To
first order the outline moves as the point of the contour does along the surface's normal, which lies in the picture's
plane: sliding of the contour over the surface changes nothing ([Cipolla2000], chapter 4).

The unknown is a displacement of the vertices of the mesh before its last subdivision, smooth as large steps are, so
that ears and skull, which no track and little shading reaches, move as a whole.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import scipy.sparse as sparse

from shared.compute.robust import cauchy_weight
from shared.compute.run_context import SILENT, RunContext
from shared.compute.sparse_solve import factorised
from shared.geometry.mesh import Mesh, loop_subdivision, mesh_edges, normalised, vertex_normals
from shared.geometry.raycast import RayScene
from shared.geometry.transforms import project, projection_slope
from shared.imaging.image_sampling import remap
from shared.imaging.views import Views
from shared.shape.step import large_step_metric

CAUCHY_SCALE, FARTHEST_SIGMAS = 2.5, 8.0
LEAST_MET = 2.0 / 3.0
"""Share of the outline that has to have a border within reach. Where hair or a hat makes the border, a part of it comes
near by chance, and the head would grow out to meet it. Long hair leaves 0.16 and 0.59, bare and cropped heads over 0.7.
"""
BEYOND_PX = 2.5
"""How far outside of the outline a ray has to miss the mesh."""


@dataclass(frozen=True)
class ContourSettings:
    """sigma_px: what a mask's border is good for; reach_mm: borders farther away are something else's; correlated:
    how many points of the occluding contour count as one; frames: looked at; rounds: most steps; smoothness, sigma_mm:
    as of the shape; known_mm: how far vertices that are known may move."""

    sigma_px: float = 1.5
    reach_mm: float = 8.0
    correlated: float = 4.0
    frames: int = 24
    rounds: int = 5
    smoothness: float = 4.0
    sigma_mm: float = 8.0
    known_mm: float = 0.2


@dataclass(frozen=True)
class OccludingContour:
    """Points of the occluding contour in all frames that have a border near: frame [n], edge [n, 2], share [n] of the
    way along it, slope [n, 3] of the distance by the point's place, px per mm, distance [n] px; met: how many of all
    points of the occluding contour these are.
    """

    frame: np.ndarray
    edge: np.ndarray
    share: np.ndarray
    slope: np.ndarray
    distance: np.ndarray
    met: float


def mask_distance(mask: np.ndarray) -> np.ndarray:
    """[H, W] (0: background) -> signed distance to the mask's border in pixels, float32, positive outside.

    Between a background pixel's centre and its neighbour's inside the border lies half way.
    """
    person = (mask > 0).astype(np.uint8)
    outside = cv2.distanceTransform(1 - person, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    inside = cv2.distanceTransform(person, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.where(person > 0, 0.5 - inside, outside - 0.5).astype(np.float32)


def occluding_contour(
    mesh: Mesh, usable: np.ndarray, views: Views, distances: Sequence[np.ndarray], reach_mm: float
) -> OccludingContour:
    """The mesh's occluding contour in the views. usable [faces] bool: faces whose edges count; distances: of each view
    [H, W], see mask_distance; reach_mm: farther borders are something else's."""
    normals, scene = vertex_normals(mesh.vertices, mesh.faces), RayScene(mesh.vertices, mesh.faces)
    edges = mesh_edges(mesh.faces[usable])[0]
    parts, count = [], 0
    frames = zip(distances, views.camera_from_head, views.intrinsics, strict=True)
    for f, (distance, pose, lens) in enumerate(frames):
        turning, share, outward = _turning_points(mesh, normals, edges, scene, pose, lens)
        points = _between(mesh.vertices, turning, share)
        pixels, depth = project(points, pose, lens)
        apart = remap(distance, pixels).astype(np.float64)
        inside = ((pixels > 1.0) & (pixels < np.array(distance.shape[::-1]) - 1.0)).all(1)
        near = inside & (np.abs(apart) < reach_mm * lens[0, 0] / depth)
        count += int(inside.sum())
        slope = np.einsum("nix,ni->nx", projection_slope(points, pose, lens), outward)
        parts.append((np.full(near.sum(), f), turning[near], share[near], slope[near], apart[near]))
    arrays = [np.concatenate(part) for part in zip(*parts, strict=True)]
    return OccludingContour(*arrays, met=len(arrays[0]) / max(count, 1))


def _turning_points(mesh, normals, edges, scene, pose, intrinsics) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of the edges [E, 2] those that the outline crosses [n, 2], the share of the way where [n], and the outward
    direction in the picture [n, 2]."""
    centre = -pose[:3, 3] @ pose[:3, :3]
    cosine = (normalised(centre - mesh.vertices) * normals).sum(1)
    turning = edges[cosine[edges[:, 0]] * cosine[edges[:, 1]] < 0]
    share = cosine[turning[:, 0]] / (cosine[turning[:, 0]] - cosine[turning[:, 1]])
    points, across = (_between(values, turning, share) for values in (mesh.vertices, normals))
    slope = projection_slope(points, pose, intrinsics)
    outward = normalised(np.einsum("nix,nx->ni", slope, across))
    pixels = project(points, pose, intrinsics)[0] + BEYOND_PX * outward
    rays = (pixels - intrinsics[:2, 2]) / intrinsics[[0, 1], [0, 1]]
    rays = np.concatenate([rays, np.ones((len(pixels), 1))], axis=1) @ pose[:3, :3]
    free = scene.first_faces(np.broadcast_to(centre, rays.shape), rays) < 0
    return turning[free], share[free], outward[free]


def fit_outline(
    mesh: Mesh,
    usable: np.ndarray,
    known: np.ndarray,
    views: Views,
    settings: ContourSettings,
    context: RunContext = SILENT,
) -> tuple[Mesh, dict]:
    """The mesh moved so that its outline meets the borders of the views' masks, as long as that helps held-out frames,
    and a record of the mean distances in px.

    mesh: one that was subdivided; usable [faces] bool: whose edges count; known [V] bool: vertices that stay, since
    something better tells where they are.
    """
    spread, parents = _before_subdivision(mesh)
    prior = large_step_metric(parents, spread.shape[1], settings.smoothness, settings.sigma_mm)
    prior = prior + sparse.diags(known[: spread.shape[1]] / settings.known_mm**2)
    start, moved, note = mesh.vertices, np.zeros((spread.shape[1], 3)), context.note
    distances = [mask_distance(views.mask(f)) for f in range(len(views))]
    contour = occluding_contour(mesh, usable, views, distances, settings.reach_mm)
    if contour.met < LEAST_MET:
        note(f"outline: {contour.met:.0%} of it lies near the masks' borders: they are not the head's")
        return mesh, {"met": contour.met}
    first = best = _mean_distance(contour, views.fitted, settings)
    for _ in range(settings.rounds):
        moved = moved + _step(spread, prior, moved, contour, views.fitted, settings)
        trial = mesh.replace(vertices=start + spread @ moved)
        contour = occluding_contour(trial, usable, views, distances, settings.reach_mm)
        now = _mean_distance(contour, views.fitted, settings)
        note(f"outline: {best[0]:.2f} -> {now[0]:.2f} px fitted, {best[1]:.2f} -> {now[1]:.2f} px held out")
        if not now[1] < best[1]:
            break
        mesh, best = trial, now
    pairs = zip(("fitted_px", "held_out_px"), first, best, strict=True)
    return mesh, {"met": contour.met} | {name: {"before": before, "after": after} for name, before, after in pairs}


def _before_subdivision(mesh: Mesh) -> tuple[sparse.csr_matrix, np.ndarray]:
    """Loop's matrix [V, C] from the vertices before the last subdivision, which come first, and their faces [F / 4, 3];
    a mesh that none made stands for itself."""
    if len(mesh.faces) % 4 == 0:
        children = mesh.faces.reshape(-1, 4, 3)
        parents = np.stack([children[:, k, k] for k in range(3)], axis=1)
        spread, faces = loop_subdivision(parents, int(parents.max()) + 1)
        if np.array_equal(faces, mesh.faces):
            return spread, parents
    return sparse.identity(len(mesh.vertices), format="csr"), mesh.faces


def _step(spread, prior, moved, contour: OccludingContour, fitted: np.ndarray, settings: ContourSettings) -> np.ndarray:
    """Change [C, 3] of the displacement moved [C, 3] of the vertices before the subdivision."""
    used, count = fitted[contour.frame], spread.shape[0]
    distance, slope = contour.distance[used], contour.slope[used]
    own = 1.0 / (settings.sigma_px**2 * settings.correlated)
    weight = cauchy_weight(distance, CAUCHY_SCALE * settings.sigma_px, own)
    ends = np.stack([1.0 - contour.share[used], contour.share[used]], axis=1)
    entries = np.repeat(np.arange(len(distance)), 2), contour.edge[used].ravel()
    at = sparse.csr_matrix((ends.ravel(), entries), (len(distance), count)) @ spread
    rows = sparse.hstack([sparse.diags(slope[:, k]) @ at for k in range(3)]).tocsr()
    weighted = rows.T @ sparse.diags(weight)
    matrix = weighted @ rows + sparse.block_diag([prior] * 3)
    gradient = weighted @ distance + (prior @ moved).T.ravel()
    return factorised(matrix).solve(-gradient).reshape(3, -1).T


def _mean_distance(contour: OccludingContour, fitted: np.ndarray, settings: ContourSettings) -> tuple[float, float]:
    """Robust mean distance from the border in fitted and in held-out frames, px; 0 where no border is near."""
    bounded = np.minimum(np.abs(contour.distance), FARTHEST_SIGMAS * settings.sigma_px)
    values = (bounded[chosen[contour.frame]] for chosen in (fitted, ~fitted))
    return tuple(float(value.mean()) if len(value) else 0.0 for value in values)


def _between(values: np.ndarray, edges: np.ndarray, share: np.ndarray) -> np.ndarray:
    return values[edges[:, 0]] * (1.0 - share[:, None]) + values[edges[:, 1]] * share[:, None]
