"""Points of the occluding contour of a mesh in the frames, and how far each lies from where the head ends there.

A point of the occluding contour is where an edge of the mesh turns from the camera's side to the far side. Where it is
the face's and the picture shows the face's edge near, before hair, neck or background, it has to touch that edge;
elsewhere, where nothing of the mesh lies beyond it and the person mask's border is near, it has to touch the border. To
first order the outline moves as the point of the contour does along the surface's normal, which lies in the picture's
plane: sliding of the contour over the surface changes nothing ([Cipolla2000], chapter 4).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
import scipy.sparse as sparse

from shared.compute.robust import cauchy_weight
from shared.compute.threads import share_out
from shared.geometry.mesh import Mesh, mesh_edges, normalised, vertex_normals
from shared.geometry.raycast import RayScene
from shared.geometry.transforms import camera_centres, pixel_rays, project, projection_slope
from shared.imaging.color import encode_srgb
from shared.imaging.image_sampling import remap
from shared.imaging.views import Views
from shared.shape.face_edge import face_edges

CAUCHY_SCALE, OUTSIDE_SIGMAS = 2.5, 2.0
SIGMAS_OFF = 3.0
"""An edge farther from the outline than so many deviations of what is known of the surface is one within the face."""
BEYOND_PX, WITHIN_PX = 2.5, 1.5
"""How far outside of the outline a ray has to miss what the outline belongs to, and inside of it has to meet it."""
BEHIND_MM, ROUND_MM = 3.0, 25.0
"""What lies so far behind a point of the contour is something else; the surface inside of it bulges so far at most."""

FACING = 0.5
"""Cosine from which on skin faces the camera well enough to say what its usual code is."""


@dataclass(frozen=True)
class ContourSettings:
    """sigma_px, edge_sigma_px: what a mask's border and a face's edge in the picture are good for; reach_mm,
    edge_reach_mm: those farther away are something else's; correlated: how many points of the occluding contour count
    as one; frames: looked at; rounds: most steps; smoothness, sigma_mm: as of the shape."""

    sigma_px: float = 1.5
    edge_sigma_px: float = 0.7
    reach_mm: float = 8.0
    edge_reach_mm: float = 5.0
    correlated: float = 4.0
    frames: int = 24
    rounds: int = 8
    smoothness: float = 4.0
    sigma_mm: float = 8.0


@dataclass(frozen=True)
class Outlined:
    """What of a mesh may form an outline: usable [faces] bool: at a mask's border; face [faces] bool: where the picture
    shows the face's edge, too; bare [faces] bool: skin that hardly anybody's hair grows on or falls over;
    known_mm [faces]: how far the surface may lie from where the mesh has it, infinite: nothing tells."""

    usable: np.ndarray
    face: np.ndarray
    bare: np.ndarray
    known_mm: np.ndarray

    def subdivided(self, count: int) -> Outlined:
        """The same of the mesh when it is subdivided into count faces."""
        times = count // len(self.face)
        return Outlined(*(np.repeat(faces, times) for faces in (self.usable, self.face, self.bare, self.known_mm)))

    def vertices_known_mm(self, mesh: Mesh) -> np.ndarray:
        """[V]: known_mm of the vertices, the best of their faces'."""
        known_mm = np.full(len(mesh.vertices), np.inf)
        np.minimum.at(known_mm, mesh.faces, self.known_mm[:, None])
        return known_mm


@dataclass(frozen=True)
class OccludingContour:
    """Points of the occluding contour in all frames that have a border or an edge near: frame [n], edge [n, 2], share
    [n] of the way along it, slope [n, 3] of the distance by the point's place, px per mm, distance [n] px, positive
    outside, on_edge [n] bool: from an edge in the picture, not from the mask; met: how many of all points that a border
    may be near have one.
    """

    frame: np.ndarray
    edge: np.ndarray
    share: np.ndarray
    slope: np.ndarray
    distance: np.ndarray
    on_edge: np.ndarray
    met: float

    def sigma_px(self, settings: ContourSettings) -> np.ndarray:
        """The distances' standard deviations [n]."""
        return np.where(self.on_edge, settings.edge_sigma_px, settings.sigma_px)

    def weight(self, settings: ContourSettings) -> np.ndarray:
        """[n] of the squared distances."""
        sigma = self.sigma_px(settings)
        return cauchy_weight(self.distance, CAUCHY_SCALE * sigma, 1.0 / (sigma**2 * settings.correlated))

    def ends(self, chosen: np.ndarray, values: np.ndarray, count: int) -> sparse.csr_matrix:
        """[n, count]: of the chosen points, the values [n, 2] at both ends of their edges, by the share of each."""
        shares = np.stack([1.0 - self.share[chosen], self.share[chosen]], axis=1)
        entries = np.repeat(np.arange(len(shares)), 2), self.edge[chosen].ravel()
        return sparse.csr_matrix(((shares * values).ravel(), entries), (len(shares), count))


@dataclass(frozen=True, eq=False)
class Outlines:
    """Where frames show that a head ends: distances: of each view [H, W], see mask_distance; codes: of each view
    [H, W, 3] sRGB codes in 0..1."""

    distances: Sequence[np.ndarray]
    codes: Sequence[np.ndarray]

    @classmethod
    def of(cls, views: Views) -> Outlines:
        """All of the views'."""
        count = range(len(views))
        codes = [encode_srgb(views.picture(f).levels[0]).astype(np.float32) for f in count]
        return cls([mask_distance(views.mask(f)) for f in count], codes)


def mask_distance(mask: np.ndarray) -> np.ndarray:
    """[H, W] (0: background) -> signed distance to the mask's border in pixels, float32, positive outside.

    Between a background pixel's centre and its neighbour's inside the border lies half way.
    """
    person = (mask > 0).astype(np.uint8)
    outside = cv2.distanceTransform(1 - person, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    inside = cv2.distanceTransform(person, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.where(person > 0, 0.5 - inside, outside - 0.5).astype(np.float32)


def occluding_contour(
    mesh: Mesh, outlined: Outlined, views: Views, outlines: Outlines, settings: ContourSettings, bordered: bool = True
) -> OccludingContour:
    """The mesh's occluding contour in the views, where they show that the head ends near. bordered: the masks' borders
    are the head's; else they only tell what is background."""
    normals, scene = vertex_normals(mesh.vertices, mesh.faces), RayScene(mesh.vertices, mesh.faces)
    edges = mesh_edges(mesh.faces[outlined.usable | outlined.face])[0]
    of_face, bare = np.zeros(len(mesh.vertices), bool), np.unique(mesh.faces[outlined.bare])
    of_face[mesh.faces[outlined.face]] = True
    known_mm = outlined.vertices_known_mm(mesh)

    def of_frame(f: int) -> tuple[tuple[np.ndarray, ...], int, int]:
        """The view's part of the contour, how many of its free points have a border near, and how many they are."""
        pose, lens = views.camera_from_head[f], views.intrinsics[f]
        cosine = (normalised(camera_centres(pose) - mesh.vertices) * normals).sum(1)
        turning = _turning_points(mesh, normals, cosine, edges, scene, pose, lens)
        pixels, outward = turning.pixels, turning.outward
        inside = ((pixels > 1.0) & (pixels < np.array(views.size) - 1.0)).all(1)
        px_per_mm = lens[0, 0] / turning.depth
        apart = remap(outlines.distances[f], pixels).astype(np.float64)
        near = inside & turning.free & (np.abs(apart) < settings.reach_mm * px_per_mm)
        met, count = int(near.sum()), int((inside & turning.free).sum())
        on_edge = np.zeros(len(apart), bool)
        sought = np.nonzero(inside & of_face[turning.edge].all(1))[0]
        if len(sought):
            reach_mm = np.minimum(SIGMAS_OFF * known_mm[turning.edge[sought]].min(1), settings.edge_reach_mm)
            facing = mesh.vertices[bare[cosine[bare] > FACING]]
            skin = np.median(remap(outlines.codes[f], project(facing, pose, lens)[0]), axis=0).astype(np.float64)
            reach_px = reach_mm * px_per_mm[sought]
            edge = face_edges(outlines.codes[f], pixels[sought], outward[sought], reach_px, skin)
            beside = remap(outlines.distances[f], pixels[sought] + np.nan_to_num(edge)[:, None] * outward[sought])
            farthest = OUTSIDE_SIGMAS * settings.sigma_px
            own = np.isfinite(edge) & (beside < farthest) & ((beside > -farthest) | ~(turning.free[sought] & bordered))
            apart[sought[own]], on_edge[sought[own]] = -edge[own], True
        near = near & bordered | on_edge
        values = turning.edge, turning.share, turning.slope, apart, on_edge
        return (np.full(near.sum(), f), *(value[near] for value in values)), met, count

    parts, met, counts = zip(*share_out(len(views), of_frame), strict=True)
    arrays = [np.concatenate(part) for part in zip(*parts, strict=True)]
    return OccludingContour(*arrays, met=sum(met) / max(sum(counts), 1))


class _TurningPoints(NamedTuple):
    """Where an outline in sight crosses edges [n, 2] of the mesh, at a share [n] of the way; pixels [n, 2], depth [n]
    mm, the outward direction in the picture [n, 2], the slope [n, 3] of a place along it by the point's, px per mm, and
    free [n] bool: nothing of the mesh lies beyond."""

    edge: np.ndarray
    share: np.ndarray
    pixels: np.ndarray
    depth: np.ndarray
    outward: np.ndarray
    slope: np.ndarray
    free: np.ndarray


def _turning_points(mesh, normals, cosine, edges, scene, pose, intrinsics) -> _TurningPoints:
    """Of the edges [E, 2] those that an outline in sight crosses; cosine [V]: between normals and the way to the
    camera."""
    turning = edges[cosine[edges[:, 0]] * cosine[edges[:, 1]] < 0]
    share = cosine[turning[:, 0]] / (cosine[turning[:, 0]] - cosine[turning[:, 1]])
    points, across = (_between(values, turning, share) for values in (mesh.vertices, normals))
    slope = projection_slope(points, pose, intrinsics)
    outward = normalised(np.einsum("nix,nx->ni", slope, across))
    pixels, depth = project(points, pose, intrinsics)

    def seen(pixels: np.ndarray) -> np.ndarray:
        """Depth [n] of the mesh, infinite beside it."""
        rays = pixel_rays(pixels, intrinsics) @ pose[:3, :3]
        return scene.intersect(np.broadcast_to(camera_centres(pose), rays.shape), rays)[2]

    within, beyond = seen(pixels - WITHIN_PX * outward), seen(pixels + BEYOND_PX * outward)
    free = np.isinf(beyond)
    own = free | (within > depth - ROUND_MM) & (within < depth + BEHIND_MM) & (beyond > depth + BEHIND_MM)
    parts = turning, share, pixels, depth, outward, np.einsum("nix,ni->nx", slope, outward), free
    return _TurningPoints(*(part[own] for part in parts))


def _between(values: np.ndarray, edges: np.ndarray, share: np.ndarray) -> np.ndarray:
    return values[edges[:, 0]] * (1.0 - share[:, None]) + values[edges[:, 1]] * share[:, None]
