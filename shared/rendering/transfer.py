"""Precomputed transfer in head space: visibility, cosine form factors and interreflection of surface points.

The head moves rigidly, so what a point sees of the sphere of directions never changes; a frame only rotates the
light. One trace per geometry gives, for points v and directions j (solid angle dw each),

    direct[v, j]  = V[v, j] max(0, n_v . w_j) dw / pi           so that diffuse radiance = albedo * (direct @ L)
    bounce[v, k]  = the same sum over blocked rays, gathered by the surface node k that they hit

where L [J] is the light along the directions. Interreflection is radiosity over a few hundred to thousand nodes that
cover the surface: with E the irradiance over pi, E_nodes = direct_n L + bounce_nn (albedo * E_nodes), solved exactly,
so all diffuse bounces are counted, and E = direct L + bounce (albedo_nodes * E_nodes). It stays linear in the light.

Memory: 2 bytes per point and direction plus 2 per point and node; 8000 points, 1024 directions and 1200 nodes take
36 MB. Rays: half of the directions per point, embree's 4 M rays per second and core.

References: [Sloan2002] (interreflected transfer); [Goral1984] (radiosity).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from shared.compute.compiled import compiled
from shared.compute.threads import share_out, thread_count
from shared.geometry.embree import FACE, FAR, FARTHEST, GEOMETRY, MASK, call_embree, ray_buffer
from shared.geometry.mesh import Mesh, normalised, vertex_normals
from shared.geometry.raycast import RAY_START_MM, RayScene

_RAYS_PER_BATCH = 2_000_000
_POINTS_PER_BLOCK = 256
"""Whose weights of all directions and nodes stay in the processor's cache."""
_NORMAL_MATTERS_MM = 12.0


@dataclass(frozen=True)
class Points:
    """Surface points in head space: positions [P, 3] mm, unit shading normals [P, 3]."""

    positions: np.ndarray
    normals: np.ndarray

    def __len__(self) -> int:
        return len(self.positions)

    def take(self, index: np.ndarray) -> Points:
        """The points index [n] int."""
        return Points(self.positions[index], self.normals[index])

    def followed_by(self, other: Points) -> Points:
        """These points, then the other ones."""
        return Points(np.concatenate([self.positions, other.positions]), np.concatenate([self.normals, other.normals]))


@dataclass(frozen=True)
class Nodes:
    """Where light bounces: points [K] on the surface and the node nearest to each face of the mesh [F]."""

    points: Points
    of_face: np.ndarray


@dataclass(frozen=True)
class Transfer:
    """direct [P, J] and bounce [P, K], half floats as in the module's formulae; blocked [P]: cosine-weighted fraction
    of the hemisphere that the head itself covers; visible [P, J] packed bits (numpy.packbits along directions)."""

    direct: np.ndarray
    bounce: np.ndarray
    blocked: np.ndarray
    visible: np.ndarray

    def take(self, index: np.ndarray | slice) -> Transfer:
        """The transfer of the points at index."""
        return Transfer(self.direct[index], self.bounce[index], self.blocked[index], self.visible[index])

    def followed_by(self, other: Transfer) -> Transfer:
        """That of these points, then of the other's, along the same directions and with the same nodes."""
        pairs = zip((self.direct, self.bounce, self.blocked, self.visible),
                    (other.direct, other.bounce, other.blocked, other.visible), strict=True)
        return Transfer(*(np.concatenate(pair) for pair in pairs))

    def visibility(self, index: slice | np.ndarray = slice(None)) -> np.ndarray:
        """[P', J] bool: does the point see that direction (horizon included)?"""
        return np.unpackbits(self.visible[index], axis=1, count=self.direct.shape[1]).astype(bool)


def mesh_points(mesh: Mesh, index: np.ndarray | slice = slice(None)) -> Points:
    """The mesh's vertices with their angle-weighted normals."""
    return Points(mesh.vertices[index], vertex_normals(mesh.vertices, mesh.faces)[index])


def spread_vertices(vertices: np.ndarray, count: int, allowed: np.ndarray | None = None) -> np.ndarray:
    """Indices of at most count vertices, spread evenly over the area: one per occupied cell of a voxel grid.

    vertices [V, 3] mm; allowed [V] bool or None. The cells have the smallest of a fixed series of sizes of which no
    more than count are occupied; within a cell the vertex nearest to the cell's mean wins. Of equally near ones, as
    two in a cell always are, one is drawn by its number (Knuth's multiplicative hash): the first would be one that a
    subdivision started from, and never one that it added. Sizes found by bisection would end where a vertex crosses
    from one cell to the next, so that a vertex that moved by a rounding would change all the others.
    """
    candidates = np.arange(len(vertices)) if allowed is None else np.nonzero(allowed)[0]
    if len(candidates) <= count:
        return candidates
    points = vertices[candidates]
    low, high = 0, 1  # numbers of sizes: too many cells, few enough
    while len(np.unique(_cells(points, _cell_size(high)))) > count:
        low, high = high, 2 * high
    while high - low > 1:
        middle = (low + high) // 2
        fits = len(np.unique(_cells(points, _cell_size(middle)))) <= count
        low, high = (low, middle) if fits else (middle, high)
    edge = _cell_size(high)
    cells, inverse = np.unique(_cells(points, edge), return_inverse=True)
    size = np.bincount(inverse)
    mean = np.stack([np.bincount(inverse, points[:, k]) / size for k in range(3)], axis=1)
    distance = np.rint(((points - mean[inverse]) ** 2).sum(1) / (1e-3 * edge) ** 2)
    drawn = candidates.astype(np.uint64) * np.uint64(2654435761) % np.uint64(1 << 32)
    order = np.lexsort((drawn, distance, inverse))
    first = np.searchsorted(inverse[order], np.arange(len(cells)))
    return np.sort(candidates[order[first]])


def _cell_size(number: int) -> float:
    """Edge of a cell in mm, from 1 um on in steps of 0.5 %."""
    return 1e-3 * 1.005**number


def _cells(points: np.ndarray, size: float) -> np.ndarray:
    grid = np.floor((points - points.min(0)) / size).astype(np.int64)
    extent = grid.max(0) + 1
    return (grid[:, 0] * extent[1] + grid[:, 1]) * extent[2] + grid[:, 2]


def position_and_normal(points: Points) -> np.ndarray:
    """[P, 6]: nearness on the surface, so that the two sides of a thin part (an ear, a lip) stay apart."""
    return np.concatenate([points.positions, _NORMAL_MATTERS_MM * points.normals], axis=1)


def nearest_points(target: Points, source: Points) -> np.ndarray:
    """For each target point [P] the index of the nearest source point, counting position and orientation."""
    return cKDTree(position_and_normal(source)).query(position_and_normal(target), workers=thread_count())[1]


def bounce_nodes(mesh: Mesh, count: int, layout: np.ndarray | None = None) -> Nodes:
    """Spreads about count nodes over the mesh and assigns each face to the nearest one. layout [V, 3]: where the
    vertices lie for the spreading, None: where they are."""
    normals = vertex_normals(mesh.vertices, mesh.faces)
    index = spread_vertices(mesh.vertices if layout is None else layout, count)
    points = Points(mesh.vertices[index], normals[index])
    corners = mesh.vertices[mesh.faces], normals[mesh.faces]
    centres = Points(corners[0].mean(1), normalised(corners[1].mean(1)))
    return Nodes(points, nearest_points(centres, points).astype(np.int32))


def trace_transfer(
    scene: RayScene,
    points: Points,
    nodes: Nodes,
    directions: np.ndarray,
    progress=iter,
    visibility: bool = True,
) -> Transfer:
    """Traces every direction above each point's horizon, once.

    directions [J, 3]: a direction_set; progress: wraps the sequence of batches to show how far it is;
    visibility off: every point sees all directions above its horizon, as on a convex surface, and nothing bounces.
    """
    count, total = len(points), len(directions)
    direct = np.zeros((count, total), np.float16)
    bounce = np.zeros((count, len(nodes.points)), np.float16)
    blocked = np.zeros(count, np.float32)
    visible = np.zeros((count, (total + 7) // 8), np.uint8)
    starts = (points.positions + RAY_START_MM * points.normals).astype(np.float32)
    normals, along = np.asarray(points.normals, np.float64), np.asarray(directions, np.float64)
    embree = scene.triangles

    def trace(first: int, last: int) -> None:
        part = slice(first, min(first + _POINTS_PER_BLOCK, last))
        weight = np.empty((part.stop - first, total), np.float32)
        _weigh_cosines(normals[part], along, weight)
        if visibility:
            reached = np.zeros((len(weight), len(nodes.points)), np.float32)
            _trace_points(
                embree.intersect, embree.scene, *ray_buffer(), starts[part], along, nodes.of_face, weight, reached
            )
            bounce[part], blocked[part] = reached, reached.sum(1)
        direct[part], visible[part] = weight, np.packbits(weight > 0, axis=1)

    batch = max(1, 2 * _RAYS_PER_BATCH // total)
    for start in progress(range(0, count, batch)):
        last = min(start + batch, count)
        firsts = range(start, last, _POINTS_PER_BLOCK)
        share_out(len(firsts), lambda k, firsts=firsts, last=last: trace(firsts[k], last))
    return Transfer(direct, bounce, blocked, visible)


@compiled
def _weigh_cosines(normals, directions, weight):
    """Cosine times solid angle over pi of each direction [J, 3] at each normal [P, 3] -> weight [P, J]."""
    for p in range(len(normals)):
        for j in range(len(directions)):
            cosine = 0.0
            for k in range(3):
                cosine += normals[p, k] * directions[j, k]
            weight[p, j] = max(cosine, 0.0) * (4.0 / len(directions))


@compiled
def _trace_points(function, scene, ray, words, address, starts, directions, node_of_face, weight, reached):
    """weight [P, J] of directions above the horizon: 0 where the head stands in the way, and its weight added to
    reached [P, K] at the node that is met."""
    for p in range(len(starts)):
        for j in range(len(directions)):
            if weight[p, j] == 0:
                continue
            for k in range(3):
                ray[k], ray[4 + k] = starts[p, k], directions[j, k]
            ray[FARTHEST] = FAR
            words[MASK] = words[GEOMETRY] = -1
            call_embree(function, scene, address)
            if words[GEOMETRY] != -1:
                reached[p, node_of_face[words[FACE]]] += weight[p, j]
                weight[p, j] = 0.0


def node_radiosity(nodes: Transfer, albedo: np.ndarray, direct: np.ndarray) -> np.ndarray:
    """The nodes' radiosity b = albedo * E over pi, with all diffuse bounces, under direct irradiance e over pi, both
    [K, C] or [K, N, C].

    nodes: the transfer of the nodes themselves (bounce B is [K, K]); albedo a [K, C]. Solves (I - diag(a) B) b = a e.
    """
    form = nodes.bounce.astype(np.float64)
    solved = []
    for c, own in enumerate(albedo.T.astype(np.float64)):
        sent_on = own[:, None] * direct[..., c].reshape(len(form), -1)
        solved.append(np.linalg.solve(np.eye(len(form)) - own[:, None] * form, sent_on).reshape(direct.shape[:-1]))
    return np.stack(solved, axis=-1)


def irradiance(
    transfer: Transfer, light: np.ndarray, radiosity: np.ndarray | None = None, batch: int = 4096
) -> np.ndarray:
    """Irradiance over pi of each point: light [J, N] (N = frames x channels), radiosity [K, N] or None -> [P, N] f32.

    Works through the points in batches so that the half-precision tables are widened a part at a time.
    """
    direct = _widened_product(transfer.direct, light, batch)
    return direct if radiosity is None else direct + bounced_irradiance(transfer, radiosity, batch)


def bounced_irradiance(transfer: Transfer, radiosity: np.ndarray, batch: int = 4096) -> np.ndarray:
    """The part of irradiance that came by way of the nodes: radiosity [K, N] -> [P, N] float32."""
    return _widened_product(transfer.bounce, radiosity, batch)


def _widened_product(table: np.ndarray, values: np.ndarray, batch: int) -> np.ndarray:
    values = np.ascontiguousarray(values, np.float32)
    result = np.empty((len(table), values.shape[1]), np.float32)

    def multiply(k: int) -> None:
        part = slice(k * batch, (k + 1) * batch)
        np.matmul(table[part].astype(np.float32), values, out=result[part])

    share_out(-(-len(result) // batch), multiply)
    return result
