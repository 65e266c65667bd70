"""Where on the true surface cast shadows end, and how much of a re-render's error lies there.

A shadow's edge is traced on the true mesh as the camera sees it: between neighbouring pixels, both of which face the
lamp, one is lit and the other is not. The terminator, where the surface itself turns away from the lamp, is none.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from shared.contract.subject import load_subject
from shared.geometry.mesh import Mesh, interpolate, normalised, vertex_normals
from shared.geometry.raycast import RAY_START_MM, RayScene, camera_hits
from shared.geometry.transforms import world_from_head
from shared.io.arrays import load_arrays
from shared.io.images import read_exr, read_png
from shared.io.meshes import read_obj
from shared.rendering.envmap import latlong_directions
from tools.scoring.measures import srgb
from tools.scoring.score import camera_intrinsics, find_image, read_linear

EDGE_MM = 3.0
"""How near the edge of a cast shadow a point counts as at it."""
LEAST_COSINE = 0.1
"""Where the lamp grazes, the mesh's facets shadow each other, and it lights hardly anything."""
LAMP_COSINE = np.cos(np.radians(15.0))


def lamp_direction(envmap: np.ndarray) -> np.ndarray:
    """Lat-long radiance [H, 2 H, 3] -> unit direction [3] of its brightest place: the centre of what is at least half
    as bright within 15 degrees of the brightest pixel."""
    directions, brightness = latlong_directions(len(envmap)).reshape(-1, 3), envmap.sum(-1).ravel()
    peak = directions[brightness.argmax()]
    lamp = (brightness >= 0.5 * brightness.max()) & (directions @ peak > LAMP_COSINE)
    solid_angle = np.sqrt(1.0 - directions[lamp, 1] ** 2)
    return normalised((brightness[lamp] * solid_angle) @ directions[lamp])


@dataclass(frozen=True)
class SeenSurface:
    """What the pixels of a picture see: points [H, W, 3] mm, NaN beside the mesh; facing [H, W] bool: turned to the
    lamp; lit [H, W] bool: and nothing before it."""

    points: np.ndarray
    facing: np.ndarray
    lit: np.ndarray


class LitMesh:
    """A mesh of which it can be asked where the light of one direction reaches it."""

    def __init__(self, mesh: Mesh):
        self._mesh, self._scene = mesh, RayScene(mesh.vertices, mesh.faces)
        self._normals = vertex_normals(mesh.vertices, mesh.faces)

    def seen(
        self, camera_from_head: np.ndarray, intrinsics: np.ndarray, size: tuple[int, int], towards: np.ndarray
    ) -> SeenSurface:
        """size: width and height, px; towards [3]: the lamp, in head space; camera_from_head [4, 4]; intrinsics [3, 3].
        """
        face, bary, _ = camera_hits(self._scene, camera_from_head, intrinsics, *size)
        hit = face >= 0
        corners = face[hit], bary[hit].astype(np.float64)
        place = interpolate(self._mesh.vertices, self._mesh.faces, *corners)
        normal = normalised(interpolate(self._normals, self._mesh.faces, *corners))
        points = np.full((*face.shape, 3), np.nan)
        facing, lit = np.zeros(face.shape, bool), np.zeros(face.shape, bool)
        points[hit], facing[hit] = place, normal @ towards > LEAST_COSINE
        rays = np.broadcast_to(towards, place.shape)
        lit[hit] = facing[hit] & ~self._scene.occluded(place + RAY_START_MM * normal, rays)
        return SeenSurface(points, facing, lit)


def near_shadow_edges(seen: SeenSurface, reach_mm: float = EDGE_MM) -> np.ndarray:
    """[H, W] bool: within reach_mm of a cast shadow's edge that the picture shows."""
    edges = [_flips(seen, along) for along in (0, 1)]
    near = np.zeros(seen.lit.shape, bool)
    if sum(map(len, edges)):
        there = np.isfinite(seen.points[..., 0])
        distance, _ = cKDTree(np.concatenate(edges)).query(seen.points[there], distance_upper_bound=reach_mm)
        near[there] = np.isfinite(distance)
    return near


def _flips(seen: SeenSurface, along: int) -> np.ndarray:
    """[N, 3] points midway between neighbours along an axis of which the lamp reaches one; not across an outline, where
    they lie farther apart than EDGE_MM."""
    one, two = (slice(None, -1), slice(1, None)) if along == 0 else (np.s_[:, :-1], np.s_[:, 1:])
    flips = seen.facing[one] & seen.facing[two] & (seen.lit[one] != seen.lit[two])
    first, second = seen.points[one][flips], seen.points[two][flips]
    return (0.5 * (first + second))[np.linalg.norm(first - second, axis=1) < EDGE_MM]


def share_of_residual(residual: np.ndarray, near: np.ndarray) -> float:
    """How much of the sum of squares of residual [N, ...] lies where near [N] is True."""
    squares = (residual.reshape(len(residual), -1).astype(np.float64) ** 2).sum(1)
    return float(squares[near].sum() / max(squares.sum(), 1e-30))


def shadow_edge_residual(subject: Path, export: Path) -> dict[str, float]:
    """Of the frames that hold truth and that the result re-renders, on the face skin: `residual`, the share of the
    squared error of the sRGB codes within EDGE_MM of cast shadows' edges; `pixels`, the share of pixels there;
    `frames`, how many frames that is. Shares are NaN without a frame."""
    truth, envmap = load_arrays(subject / "gt" / "poses.npz"), read_exr(subject / "gt" / "envmap.exr")
    mesh, lamp = LitMesh(read_obj(subject / "gt" / "mesh.obj")), lamp_direction(envmap)
    lens, moves, residuals, near = camera_intrinsics(subject), load_subject(subject).moves, [], []
    for frame in truth["gt_frames"].tolist():
        stem, render = subject / "gt" / "frames" / f"{frame:04d}", find_image(export / "renders", f"{frame:04d}")
        if render is None:
            continue
        skin, pose = read_png(Path(f"{stem}_mask.png")) > 127, truth["camera_from_head"][frame]
        towards = lamp @ world_from_head(pose[None], moves)[0]
        seen = mesh.seen(pose, lens, skin.shape[::-1], towards)
        near.append(near_shadow_edges(seen)[skin])
        residuals.append(srgb(read_exr(f"{stem}_radiance.exr")[skin]) - srgb(read_linear(render)[skin]))
    if not near:
        return {"residual": float("nan"), "pixels": float("nan"), "frames": 0}
    edge = np.concatenate(near)
    return {"residual": share_of_residual(np.concatenate(residuals), edge), "pixels": float(edge.mean()),
            "frames": len(near)}
