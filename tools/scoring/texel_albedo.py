"""Is the albedo right wherever the confidence says so? All of the head's surface counts, not the face's skin alone.

Points spread evenly over the result's surface, seen by the camera or not. The truth at each is the albedo at the true
surface's point nearest to it, of those that some frame shows: where hair hangs, the camera knows the hair. Positions
and normals count together, so that the two sides of an ear stay apart. What lies far from all that is known has no
truth.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from shared.geometry.mesh import Mesh, interpolate, normalised, vertex_normals
from shared.geometry.raycast import RAY_START_MM, RayScene
from shared.geometry.transforms import Similarity, camera_centres
from shared.imaging.texture import sample_bilinear
from tools.scoring import measures
from tools.scoring.align import random_places

RESULT_POINTS, TRUE_POINTS = 50_000, 1_000_000
THINNED, NEAR_MM = 8, 5.0
"""One true point in so many is enough, a millimetre apart, for points of the result that are not so near to any."""
NORMAL_MM = 5.0
"""Distance that counts as much as normals one radian apart."""
FARTHEST_MM, ASIDE_MM = 20.0, 1.0
"""From a point of the result to the true point whose albedo it should have: hair lies that far above the head's skin.
To one side it may lie as far off as it does above or below, or so far; past a true mesh's border nothing is known."""


@dataclass(frozen=True)
class AlbedoPairs:
    """At N points even over the result's surface: its faces face [N], true and found albedo [N, 3] and its confidence
    [N]."""

    face: np.ndarray
    truth: np.ndarray
    found: np.ndarray
    confidence: np.ndarray

    def wrong_where_sure(
        self, gain: np.ndarray, segment: np.ndarray | None = None, names: tuple[str, ...] = ()
    ) -> dict:
        """{share: of the surface on which the result is confident, wrong: share of that which is off by more than
        WRONG_DELTA_E after gain [3], of_segments: {name: its part of `wrong`, biggest first}}.

        segment [faces]: index into names, None: no segments. Where it is nowhere confident nothing is wrong.
        """
        sure = self.confidence > measures.CONFIDENT
        off = np.zeros(len(sure), bool)
        off[sure] = measures.albedo_differences(self.truth[sure], self.found[sure] * gain) > measures.WRONG_DELTA_E
        scores = {"share": float(sure.mean()), "wrong": float(off.sum() / max(sure.sum(), 1))}
        if segment is not None:
            count = np.bincount(segment[self.face[off]], minlength=len(names)) / max(sure.sum(), 1)
            scores["of_segments"] = {names[k]: float(count[k]) for k in np.argsort(-count, kind="stable") if count[k]}
        return scores


def albedo_pairs(
    truth: tuple[Mesh, np.ndarray, np.ndarray],
    result: tuple[Mesh, np.ndarray, np.ndarray],
    truth_from_result: Similarity,
    rng: np.random.Generator,
) -> AlbedoPairs:
    """truth: mesh, albedo [H, W, 3] linear and the poses [F, 4, 4] that show it; result: mesh, albedo [H, W, 3] linear
    and confidence [H, W]."""
    true_mesh, true_albedo, poses = truth
    mesh, albedo, confidence = result
    points, normals, uv, _ = _spread(true_mesh, TRUE_POINTS, rng)
    shown = np.nonzero(_shown(true_mesh, points, normals, poses))[0]
    own_points, own_normals, own_uv, face = _spread(mesh, RESULT_POINTS, rng)
    own_points, own_normals = truth_from_result.points(own_points), own_normals @ truth_from_result.rotation.T
    apart, nearest = _nearest(np.concatenate([points[shown], NORMAL_MM * normals[shown]], 1),
                              np.concatenate([own_points, NORMAL_MM * own_normals], 1))
    known = np.nonzero(np.isfinite(apart))[0]
    nearest = shown[nearest[known]]
    offset = own_points[known] - points[nearest]
    above = (offset * normals[nearest]).sum(1, keepdims=True)
    beside = np.linalg.norm(offset - above * normals[nearest], axis=1) < np.maximum(np.abs(above[:, 0]), ASIDE_MM)
    known, nearest = known[beside], nearest[beside]
    return AlbedoPairs(
        face[known], sample_bilinear(true_albedo, uv[nearest]), sample_bilinear(albedo, own_uv[known]),
        sample_bilinear(confidence, own_uv[known]).reshape(len(known)),
    )


def _nearest(places: np.ndarray, wanted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance [N] to and index [N] of the nearest of random places [P, 6] to each wanted [N, 6]; inf beyond
    FARTHEST_MM. Those that are not near have the nearest of one place in THINNED: to look through all of them would
    take a hundred times as long as where a place is near."""
    apart, nearest = cKDTree(places[::THINNED]).query(wanted, distance_upper_bound=FARTHEST_MM)
    nearest *= THINNED
    near = np.nonzero(apart < NEAR_MM)[0]
    apart[near], nearest[near] = cKDTree(places).query(wanted[near], distance_upper_bound=2.0 * NEAR_MM)
    return apart, nearest


def _spread(mesh: Mesh, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Random points even over the mesh: points [N, 3], normals [N, 3], uv [N, 2] and faces [N]."""
    face, bary = random_places(mesh, count, rng)
    normals = vertex_normals(mesh.vertices, mesh.faces)
    at_corners = ((mesh.vertices, mesh.faces), (normals, mesh.faces), (mesh.uvs, mesh.face_uvs))
    points, normals, uv = (interpolate(values, faces, face, bary) for values, faces in at_corners)
    return points, normalised(normals), uv, face


def _shown(mesh: Mesh, points: np.ndarray, normals: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """[N] bool: points [N, 3] of the mesh, with normals [N, 3], that some of the poses [F, 4, 4] turn to the camera
    with nothing before them."""
    scene, shown = RayScene(mesh.vertices, mesh.faces), np.zeros(len(points), bool)
    for centre in camera_centres(poses):
        towards = centre - points
        rows = np.nonzero(~shown & ((towards * normals).sum(1) > 0.0))[0]
        shown[rows] = ~scene.occluded(points[rows] + RAY_START_MM * normals[rows], towards[rows])
    return shown
