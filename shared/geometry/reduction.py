"""A mesh with fewer faces: vertices are taken away one by one, each drawn into a neighbour, the least harmful first.

What stays is a part of the mesh: vertices and UVs keep their numbers, so that blend shapes, normals and segments are
looked up and not made anew, and the two sides of a seam share their vertices as before.

Harm is measured in five dimensions, places and UVs in mm, by quadrics: squared distances from the planes of all faces
that a vertex stands for [Garland1998], for each side of a seam by itself [Hoppe1999]. Along lines that must stay, which
are borders, seams and the edges of lips and lids, distances from the lines count too, and a vertex goes along its line
only. No face turns over, in space or in the map, and the surface stays a manifold. In the end the vertices move by
hundredths of a mm along their normals: faces between points of a round surface lie below it, moved ones about it. UVs
beside seams and borders move likewise, so that faces show what the whole surface shows there.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import scipy.sparse as sparse

from shared.compute.compiled import compiled, compiled_part
from shared.compute.sparse_solve import factorised
from shared.geometry.eyeballs import Eyeball
from shared.geometry.mesh import (
    Mesh,
    face_normals,
    interpolate,
    mesh_edges,
    normalised,
    unique_pairs,
    vertex_normals,
)
from shared.geometry.raycast import RAY_START_MM, RayScene
from shared.geometry.surface import Surface

OUTLINED = ("lids", "lips", "inner_mouth", "eye_sockets", "eyes")
"""Segments whose edges are lines that must stay."""
UV_WEIGHT = 0.5
"""How much a shift of the texture by one mm counts against a shift of the surface."""
LINE_WEIGHT = 1.0
"""How much lines count against faces."""
STEEPEST_TURN = 0.3
"""Cosine of the angle by which a face may turn at once."""
FARTHEST_MM, STIFFNESS = 1.0, 0.15
"""Where faces are moved nearer to the surface: beyond it they are of something else; share by which moves count."""
UV_FARTHEST_MM, UV_STIFFNESS, LEAST_AREA = 3.0, 0.02, 0.1
"""The same of the map, and the share of its area there that a face keeps at least."""
_PLACES = ((0.6, 0.2, 0.2), (0.2, 0.6, 0.2), (0.2, 0.2, 0.6), (0.45, 0.45, 0.1), (0.1, 0.45, 0.45), (0.45, 0.1, 0.45))
"""Corner weights of the points on a face where its distance is measured, and what it shows."""
SLIMMEST = 0.05
"""Twice a face's area over the sum of its squared sides, below which it does not get slimmer: 0.58 is equilateral."""
_FACE = ("forehead", "brows", "nose", "cheek_left", "cheek_right", "upper_lip_skin", "chin", "jaw")
WEIGHTS = {"eyes": 8.0, "lids": 8.0, "lips": 8.0, **dict.fromkeys(_FACE, 2.0)}
"""How much faces of some segments count against others: whoever looks at a head looks at its face, there at eyes and
lips first; lids must fit about an eyeball that turns, and lips upon each other."""
FEW_FACES, FEW_WEIGHTS = 10_000, {"lids": 3.0, "lips": 3.0, "eyes": 1.5}
"""Where fewer faces than this are wanted, so much more count those of some segments: textures else shift by half a
millimetre there."""
_SEAM, _OUTLINE, _BORDER, _FIXED = 1, 2, 4, 8
_MOST_FACES = 64
"""Around a vertex that may still be taken away."""
_NEVER = 1e30
_TERMS = 21
"""Of a quadric in five dimensions: x' A x + 2 b' x + c as the upper triangle of A, then b, then c."""


@dataclass(frozen=True, eq=False)
class ReducedMesh:
    """mesh: few faces over the whole mesh's vertices and UVs, which keep their numbers whether used or not; faces [n]
    int, in order: the faces of the whole mesh that are left, with their segments and other vertices."""

    mesh: Mesh
    faces: np.ndarray

    def eyeball(self, whole: Eyeball) -> Eyeball:
        """What is left of an eyeball of the whole mesh; it turns about the same centre."""
        faces = np.nonzero(np.isin(self.faces, whole.faces))[0]
        return replace(whole, vertices=np.unique(self.mesh.faces[faces]), faces=faces)


def reduced(surface: Surface, wanted: Sequence[int]) -> tuple[ReducedMesh, ...]:
    """The surface with each of the wanted numbers of faces, which fall, or with one less; with more where nothing else
    can be taken away. The same surface gives the same meshes, to the last bit.
    """
    mesh = surface.mesh
    labels = np.zeros(len(mesh.faces), np.int64)
    if surface.face_segment is not None:
        labels = np.where(surface.faces_of(OUTLINED), 1 + surface.face_segment.astype(np.int64), 0)
    pairs, wedges, _ = unique_pairs(np.column_stack([mesh.faces.ravel(), mesh.face_uvs.ravel()]))
    whole = wedges = wedges.reshape(-1, 3)
    mm_per_uv = _mm_per_uv(mesh)
    spots = np.column_stack([mesh.vertices[pairs[:, 0]], UV_WEIGHT * mm_per_uv * mesh.uvs[pairs[:, 1]]])
    spots = np.ascontiguousarray(spots, np.float64)
    lines, kinds = _lines(mesh, wedges, labels)
    weight = np.ones(len(labels))
    for name, own in WEIGHTS.items() if surface.face_segment is not None else ():
        weight[surface.faces_of((name,))] = own
    quadrics = _quadrics(spots, wedges, lines, weight)
    faces, left, found = np.array(mesh.faces, np.int64), np.arange(len(mesh.faces)), []
    for before, count in pairwise((math.inf, *wanted)):
        if count < FEW_FACES <= before and surface.face_segment is not None:
            for name, more in FEW_WEIGHTS.items():
                quadrics[np.unique(whole[surface.faces_of((name,))])] *= more
        alive = np.ones(len(faces), bool)
        _collapse(faces, wedges, labels[left], alive, kinds, spots, quadrics, count)
        faces, wedges, left = faces[alive], wedges[alive], left[alive]
        few = mesh.replace(faces=faces.astype(mesh.faces.dtype), face_uvs=pairs[wedges, 1].astype(mesh.face_uvs.dtype))
        found.append(ReducedMesh(_fitted(few, mesh, kinds, mm_per_uv) if len(left) < len(mesh.faces) else mesh, left))
    return tuple(found)


def _mm_per_uv(mesh: Mesh) -> float:
    """Length of one unit of UV on the surface, on average."""
    area = np.linalg.norm(face_normals(mesh.vertices, mesh.faces), axis=1).sum()
    uv_area = np.abs(_map_areas(mesh.uvs, mesh.face_uvs)).sum()
    return float(np.sqrt(area / uv_area)) if uv_area > 0.0 else 0.0


def _map_areas(uvs: np.ndarray, face_uvs: np.ndarray) -> np.ndarray:
    """[F] twice the areas of faces in the map, below 0 where they are mirrored there."""
    return face_normals(np.column_stack([uvs, np.zeros(len(uvs))]), face_uvs)[:, 2]


def _lines(mesh: Mesh, wedges: np.ndarray, labels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """wedges [F, 3]: corners that are the same to space and map; labels [F] -> whether the edge from each corner to the
    next is part of a line [F, 3] bool, and the kind of each vertex [V]: 0 beside all lines, that of its line, or _FIXED
    where a line ends or meets another."""
    edges, edge, shared = mesh_edges(mesh.faces)
    lowest = np.minimum(mesh.faces, np.roll(mesh.faces, -1, axis=1)) == mesh.faces
    following = np.roll(wedges, -1, axis=1)
    ends = np.stack([np.where(lowest, wedges, following), np.where(lowest, following, wedges)], axis=-1).reshape(-1, 2)
    ends = np.column_stack([ends, np.repeat(labels, 3)])
    low, high = np.full((len(edges), 3), np.iinfo(np.int64).max), np.full((len(edges), 3), -1)
    np.minimum.at(low, edge.ravel(), ends)
    np.maximum.at(high, edge.ravel(), ends)
    differs = low != high
    kind = _SEAM * differs[:, :2].any(1) + _OUTLINE * differs[:, 2] + _BORDER * (shared == 1) + _FIXED * (shared > 2)
    of_vertex, count = np.zeros(len(mesh.vertices), np.int64), np.zeros(len(mesh.vertices), np.int64)
    on_line = kind > 0
    for column in edges[on_line].T:
        np.bitwise_or.at(of_vertex, column, kind[on_line])
        np.add.at(count, column, 1)
    mixed = np.zeros(len(mesh.vertices), bool)
    for column in edges[on_line].T:
        np.logical_or.at(mixed, column, kind[on_line] != of_vertex[column])
    of_vertex[mixed | (count == 1) | (count > 2)] = _FIXED
    return on_line[edge], of_vertex


def _quadrics(spots: np.ndarray, wedges: np.ndarray, lines: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """[W, _TERMS] of the planes of faces around each wedge, by area in the five dimensions, and of lines; times the
    weight [F] of the face."""
    quadrics = np.zeros((len(spots), _TERMS))
    a, b, c = np.moveaxis(spots[wedges], 1, 0)
    along, along_length = _unit(b - a)
    across, across_length = _unit((c - a) - ((c - a) * along).sum(1, keepdims=True) * along)
    plane = _terms(a, (along, across)) * (0.5 * weight * along_length * across_length)[:, None]
    for corner in range(3):
        np.add.at(quadrics, wedges[:, corner], plane / 3.0)
        on_line = lines[:, corner]
        one, two = wedges[on_line, corner], wedges[on_line, (corner + 1) % 3]
        along, length = _unit(spots[two] - spots[one])
        line = _terms(spots[one], (along,)) * (LINE_WEIGHT * weight[on_line] * np.square(length))[:, None]
        np.add.at(quadrics, one, line)
        np.add.at(quadrics, two, line)
    return quadrics


def _unit(vectors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """[N, 5] -> unit vectors and lengths; zero stays zero."""
    length = np.linalg.norm(vectors, axis=1)
    return vectors / np.maximum(length, 1e-20)[:, None], length


def _terms(point: np.ndarray, tangents: tuple[np.ndarray, ...]) -> np.ndarray:
    """[N, _TERMS] of the squared distance from the flats through point [N, 5] with orthonormal tangents [N, 5]."""
    matrix = np.broadcast_to(np.eye(5), (len(point), 5, 5)).copy()
    for tangent in tangents:
        matrix -= tangent[:, :, None] * tangent[:, None, :]
    slope = -np.einsum("nij,nj->ni", matrix, point)
    return np.column_stack([matrix[:, *np.triu_indices(5)], slope, -(slope * point).sum(1)])


def _fitted(few: Mesh, whole: Mesh, kinds: np.ndarray, mm_per_uv: float) -> Mesh:
    """few with its vertices moved along the whole surface's normals to where its faces are nearest to that surface, and
    its UVs to where these show what it shows there, by least squares over points on them. kinds [V]: see _lines; UVs of
    seams and borders stay."""
    bary, normals = np.array(_PLACES), face_normals(few.vertices, few.faces)
    area, normals = np.linalg.norm(normals, axis=1), normalised(normals)
    points = np.einsum("pk,fki->fpi", bary, few.vertices[few.faces]).reshape(-1, 3)
    distance, uvs = _met_along(whole, points, np.repeat(normals, len(bary), axis=0))
    known = np.nonzero(np.abs(distance) < FARTHEST_MM)[0]
    face, place = np.divmod(known, len(bary))
    directions = vertex_normals(whole.vertices, whole.faces)
    # How far a point goes along its face's normal when a corner goes along its own.
    effect = bary[place] * (directions[few.faces[face]] * normals[face][:, None]).sum(-1)
    along = _least_squares(few.faces[face], effect, distance[known, None], area[face], STIFFNESS, len(whole.vertices))
    aside = uvs[known] - interpolate(few.uvs, few.face_uvs, face, bary[place])
    near = mm_per_uv * np.linalg.norm(aside, axis=1) < UV_FARTHEST_MM
    face, place, aside = face[near], place[near], aside[near]
    stays = np.zeros(len(few.uvs), bool)
    stays[few.face_uvs] = kinds[few.faces] & ~_OUTLINE != 0
    corners = few.face_uvs[face]
    moves = _least_squares(corners, bary[place] * ~stays[corners], aside, area[face], UV_STIFFNESS, len(few.uvs))
    uvs = _without_turns(few, np.clip(few.uvs + moves, 0.0, 1.0))
    return few.replace(vertices=whole.vertices + along * directions, uvs=uvs)


def _without_turns(mesh: Mesh, uvs: np.ndarray) -> np.ndarray:
    """UVs [T, 2] in place of a mesh's own, which stay where a face would turn over in the map or lose its area."""
    uvs, before = uvs.copy(), _map_areas(mesh.uvs, mesh.face_uvs)
    while True:
        turned = mesh.face_uvs[_map_areas(uvs, mesh.face_uvs) * before < LEAST_AREA * np.square(before)]
        if np.array_equal(uvs[turned], mesh.uvs[turned]):
            return uvs
        uvs[turned] = mesh.uvs[turned]


def _least_squares(
    corners: np.ndarray, effect: np.ndarray, wanted: np.ndarray, weight: np.ndarray, stiffness: float, count: int
) -> np.ndarray:
    """[count, C] what each of count corners adds, so that at N points, of corners [N, 3] by their effect [N, 3], the
    sum is near what is wanted [N, C], of some weight [N]; small by the stiffness, a share of a corner's mean weight."""
    used, column = np.unique(corners, return_inverse=True)
    rows = np.repeat(np.arange(len(corners)), 3)
    system = sparse.coo_matrix((effect.ravel(), (rows, column.ravel())), shape=(len(corners), len(used))).tocsr()
    weighted = system.T @ sparse.diags(weight)
    normal = (weighted @ system).tocsc()
    found = np.zeros((count, wanted.shape[1]))
    if effect.any():
        stiff = normal + sparse.diags(np.full(len(used), stiffness * normal.diagonal().mean()))
        found[used] = factorised(stiff).solve(weighted @ wanted)
    return found


def _met_along(whole: Mesh, points: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """[N] mm from points [N, 3] to the surface along directions [N, 3], below 0 against them, whichever is nearer among
    faces that face the same way; infinite where there is none. UVs [N, 2] there."""
    scene, facing = RayScene(whole.vertices, whole.faces), face_normals(whole.vertices, whole.faces)
    found, uvs = np.full(len(points), np.inf), np.zeros((len(points), 2))
    for sign in (1.0, -1.0):
        face, bary, distance = scene.intersect(points - sign * RAY_START_MM * directions, sign * directions)
        hit = np.nonzero(face >= 0)[0]
        hit = hit[(facing[face[hit]] * directions[hit]).sum(1) > 0.0]
        signed = sign * (distance[hit].astype(np.float64) - RAY_START_MM)
        nearer = np.abs(signed) < np.abs(found[hit])
        hit = hit[nearer]
        found[hit], uvs[hit] = signed[nearer], interpolate(whole.uvs, whole.face_uvs, face[hit], bary[hit])
    return found, uvs


@compiled_part
def _harm(quadrics, spots, gone, kept):
    """Of wedge gone becoming wedge kept."""
    total, term = 0.0, 0
    for i in range(5):
        x = spots[kept, i]
        total += (quadrics[gone, term] + quadrics[kept, term]) * x * x
        total += 2.0 * (quadrics[gone, 15 + i] + quadrics[kept, 15 + i]) * x
        term += 1
        for j in range(i + 1, 5):
            total += 2.0 * (quadrics[gone, term] + quadrics[kept, term]) * x * spots[kept, j]
            term += 1
    return max(total + quadrics[gone, 20] + quadrics[kept, 20], 0.0)


@compiled_part
def _turns_over(spots, a, b, old, new):
    """Does the face (a, b, old) turn too far, in space or in the map, when old becomes new?"""
    both = size = new_size = 0.0
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        x, y = spots[b, j] - spots[a, j], spots[b, k] - spots[a, k]
        before = x * (spots[old, k] - spots[a, k]) - y * (spots[old, j] - spots[a, j])
        after = x * (spots[new, k] - spots[a, k]) - y * (spots[new, j] - spots[a, j])
        both += before * after
        size += before * before
        new_size += after * after
    if both <= 0.0 or both * both < STEEPEST_TURN**2 * size * new_size:
        return True
    if _too_slim(math.sqrt(size), math.sqrt(new_size), spots, a, b, old, new, 0, 3):
        return True
    x, y = spots[b, 3] - spots[a, 3], spots[b, 4] - spots[a, 4]
    was = x * (spots[old, 4] - spots[a, 4]) - y * (spots[old, 3] - spots[a, 3])
    becomes = x * (spots[new, 4] - spots[a, 4]) - y * (spots[new, 3] - spots[a, 3])
    if was < 0.0:
        was, becomes = -was, -becomes
    return was > 0.0 and _too_slim(was, becomes, spots, a, b, old, new, 3, 5)


@compiled_part
def _too_slim(was, becomes, spots, a, b, old, new, start, end):
    """Is the face (a, b, new) slimmer than SLIMMEST and than (a, b, old) in these dimensions? was, becomes: twice their
    areas."""
    base = before = after = 0.0
    for i in range(start, end):
        base += (spots[b, i] - spots[a, i]) ** 2
        before += (spots[old, i] - spots[a, i]) ** 2 + (spots[old, i] - spots[b, i]) ** 2
        after += (spots[new, i] - spots[a, i]) ** 2 + (spots[new, i] - spots[b, i]) ** 2
    return becomes < SLIMMEST * (base + after) and becomes * (base + before) <= was * (base + after)


@compiled_part
def _edge(faces, wedges, labels, ring, count, u):
    """Of the edge from the ring's vertex to u: its kind; the wedges that go and stay on its one side, then on its other
    side, which are the same where it is no seam."""
    ahead = behind = -1
    for m in range(count):
        f, k = ring[m] // 3, ring[m] % 3
        if faces[f, (k + 1) % 3] == u:
            ahead = ring[m]
        elif faces[f, (k + 2) % 3] == u:
            behind = ring[m]
    kind = 0
    if ahead < 0 or behind < 0:
        kind, step = _BORDER, 1 if behind < 0 else 2
        ahead = behind = max(ahead, behind)
        gone, kept = wedges[ahead // 3, ahead % 3], wedges[ahead // 3, (ahead % 3 + step) % 3]
        return kind, gone, kept, gone, kept
    gone, kept = wedges[ahead // 3, ahead % 3], wedges[ahead // 3, (ahead % 3 + 1) % 3]
    other_gone, other_kept = wedges[behind // 3, behind % 3], wedges[behind // 3, (behind % 3 + 2) % 3]
    if other_gone != gone or other_kept != kept:
        kind |= _SEAM
    if labels[ahead // 3] != labels[behind // 3]:
        kind |= _OUTLINE
    return kind, gone, kept, other_gone, other_kept


@compiled_part
def _may_go(faces, wedges, alive, spots, first, following, near, ring, count, u, gone, kept, other_gone, other_kept):
    """May the ring's vertex v become u? near [V] is v where its neighbours are, and -2 - v where u has them, too."""
    shared = 0
    v = faces[ring[0] // 3, ring[0] % 3]
    for m in range(count):
        f, k = ring[m] // 3, ring[m] % 3
        a, b = (k + 1) % 3, (k + 2) % 3
        near[faces[f, a]] = near[faces[f, b]] = v
        if faces[f, a] == u or faces[f, b] == u:
            shared += 1
            continue
        old = wedges[f, k]
        if old != gone and old != other_gone:
            return False
        if _turns_over(spots, wedges[f, a], wedges[f, b], old, kept if old == gone else other_kept):
            return False
    # The link condition: v and u have no neighbours in common but those of the faces that they share, and no face of u
    # is between two of these.
    near[u], corner = -1, first[u]
    while corner >= 0:
        f, both = corner // 3, 0
        if alive[f]:
            for k in range(3):
                w = faces[f, k]
                if near[w] == v:
                    near[w] = -2 - v
                    shared -= 1
                both += near[w] == -2 - v
            if both == 2:
                return False
        corner = following[corner]
    return shared == 0


@compiled_part
def _ranked(tree, harm, v, value):
    """Sets harm[v]; tree: of two neighbours in each row the less harmful vertex, whose winner is in tree[1]."""
    harm[v] = value
    node = (len(tree) // 2 + v) // 2
    while node >= 1:
        one, two = tree[2 * node], tree[2 * node + 1]
        tree[node] = one if harm[one] <= harm[two] else two
        node //= 2


@compiled_part
def _drawn_in(faces, wedges, alive, first, last, following, ring, count, u, gone, kept, other_kept, around):
    """The ring's vertex becomes u -> how many faces went, and how many vertices, now in around, are next to u or u."""
    went, corner, before, found = 0, 0, -1, 0
    for m in range(count):
        f, k = ring[m] // 3, ring[m] % 3
        if faces[f, (k + 1) % 3] == u or faces[f, (k + 2) % 3] == u:
            alive[f] = False
            went += 1
        else:
            faces[f, k], wedges[f, k] = u, kept if wedges[f, k] == gone else other_kept
            following[last[u]], following[ring[m]] = ring[m], -1
            last[u] = ring[m]
    corner, first[u] = first[u], -1
    while corner >= 0:
        after = following[corner]
        if alive[corner // 3]:
            if before < 0:
                first[u] = corner
            else:
                following[before] = corner
            before = corner
            for k in range(3):
                around[found] = faces[corner // 3, k]
                found += 1
        corner = after
    last[u] = before
    if before >= 0:
        following[before] = -1
    return went, found


@compiled
def _collapse(faces, wedges, labels, alive, kinds, spots, quadrics, wanted):
    """Takes vertices away until wanted faces are left: changes faces [F, 3], wedges [F, 3], alive [F], quadrics.

    labels [F]; kinds [V]; spots [W, 5]: places and UVs of wedges. The corners around a vertex are a list: first and
    last [V], following [3 F].
    """
    vertex_count, left = len(kinds), len(faces)
    first, last, following = np.full(vertex_count, -1), np.full(vertex_count, -1), np.full(3 * len(faces), -1)
    for corner in range(3 * len(faces)):
        v = faces[corner // 3, corner % 3]
        if first[v] < 0:
            first[v] = corner
        else:
            following[last[v]] = corner
        last[v] = corner
    leaves = 1
    while leaves < vertex_count:
        leaves *= 2
    harms, tree = np.full(leaves, _NEVER), np.zeros(2 * leaves, np.int64)
    for v in range(leaves):
        tree[leaves + v] = v
    for node in range(leaves - 1, 0, -1):
        tree[node] = tree[2 * node]
    near, valued = np.full(vertex_count, -1), np.full(vertex_count, -1)
    ring, around = np.empty(_MOST_FACES, np.int64), np.empty(3 * len(faces), np.int64)
    # First all vertices are valued, then those around each change, and the best once more, since its second neighbours
    # may have changed.
    waiting, changes = 0, 0
    everyone, best_one = vertex_count, -1
    while left > wanted:
        best_one = -1
        if everyone > 0:
            everyone -= 1
            v = everyone
        elif waiting > 0:
            waiting -= 1
            v = around[waiting]
            if valued[v] == changes:
                continue
            valued[v] = changes
        else:
            v = best_one = tree[1]
            if harms[v] >= _NEVER:
                break
        count, corner = 0, first[v] if kinds[v] != _FIXED else -1
        while corner >= 0 and count < _MOST_FACES:
            if alive[corner // 3]:
                ring[count] = corner
                count += 1
            corner = following[corner]
        least, best = _NEVER, (-1, 0, 0, 0, 0)
        for n in range(2 * count if count < _MOST_FACES else 0):
            u = faces[ring[n // 2] // 3, (ring[n // 2] % 3 + 1 + n % 2) % 3]
            kind, gone, kept, other_gone, other_kept = _edge(faces, wedges, labels, ring, count, u)
            if kind != kinds[v] or (n % 2 == 1 and not kind & _BORDER) or (other_gone == gone and other_kept != kept):
                continue
            harm = _harm(quadrics, spots, gone, kept)
            if other_gone != gone:
                harm += _harm(quadrics, spots, other_gone, other_kept)
            if harm < least and _may_go(faces, wedges, alive, spots, first, following, near, ring, count, u,
                                        gone, kept, other_gone, other_kept):
                least, best = harm, (u, gone, kept, other_gone, other_kept)
        if best_one != v or least > harms[v]:
            _ranked(tree, harms, v, least)
            continue
        u, gone, kept, other_gone, other_kept = best
        went, waiting = _drawn_in(faces, wedges, alive, first, last, following, ring, count, u, gone, kept,
                                  other_kept, around)
        left -= went
        changes += 1
        first[v] = -1
        _ranked(tree, harms, v, _NEVER)
        for term in range(_TERMS):
            quadrics[kept, term] += quadrics[gone, term]
            if other_gone != gone:
                quadrics[other_kept, term] += quadrics[other_gone, term]
