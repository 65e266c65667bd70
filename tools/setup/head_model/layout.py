"""Texture layout of the head alone, in the unit square.

Skin, mouth bag and eye sockets are one island that fills a rectangle: the surface is cut along the
middle line from behind the hairline to the nape, laid out flat by a harmonic map with the boundary on
the rectangle's sides ([Tutte1963]: never folds), then relaxed under the symmetric Dirichlet energy
[Smith2015], whose inverse term keeps every triangle unfolded. The boundary slides along the sides. The
face asks for more texels per mm than scalp and neck, the hidden cavities for few. The four halves of the
eyeballs lie in a strip below.
"""

import numpy as np
from scipy.sparse.linalg import splu

from shared.geometry.mesh import boundary_loop, graph_laplacian, vertex_adjacency
from tools.setup.head_model.relaxation import relax
from tools.setup.head_model.segments import SEGMENT_NAMES
from tools.setup.head_model.topology import EYE_LEFT, EYE_RIGHT, HeadTopology

MARGIN = 4 / 1024
STRIP = 0.078
"""Height of the strip of the eyeballs."""
EYE_DISC = 0.066
"""Diameter of one half of an eyeball in the strip."""
TIP_BEHIND_HAIRLINE_MM = 30.0
# Wished texels per mm relative to the face, and the say in the relaxation.
DENSITY = {
    "ears": 0.7,
    "neck": 0.4,
    "scalp": 0.42,
    "jaw": 0.8,
    "inner_mouth": 0.25,
    "eye_sockets": 0.3,
    "lids": 1.25,
    "lips": 1.1,
    "nose": 1.1,
}
IMPORTANCE = {"ears": 0.3, "neck": 0.1, "scalp": 0.15, "jaw": 0.6, "inner_mouth": 0.1, "eye_sockets": 0.1}
DENSITY_SMOOTHING = 6


def texture_layout(template: np.ndarray, topology: HeadTopology, segment: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """uvs [T, 2] in the unit square, v up, and face_uvs [F, 3]."""
    eyes = np.isin(topology.part, (EYE_LEFT, EYE_RIGHT))
    path = _cut_path(template, topology, segment)
    faces, source = _cut(topology.faces[~eyes], template, path)
    uvs = _skin_island(template[source], faces, segment[~eyes], _path_sides(faces, source, path))
    uvs = _mirrored_mean(uvs, source, topology.mirror)
    uvs = uvs * (1 - 2 * MARGIN, 1 - STRIP - 2 * MARGIN) + (MARGIN, STRIP + MARGIN)
    face_uvs = np.zeros_like(topology.faces)
    face_uvs[~eyes] = faces
    for slot, (part, front) in enumerate(((EYE_RIGHT, False), (EYE_RIGHT, True), (EYE_LEFT, True), (EYE_LEFT, False))):
        members, discs, local = _eye_half(template, topology, part, front)
        centre = (0.5 + (slot - 1.5) * (EYE_DISC + 3 * MARGIN), STRIP / 2)
        face_uvs[members] = local + len(uvs)
        uvs = np.concatenate([uvs, centre + EYE_DISC / 2 * discs])
    return uvs, face_uvs.astype(np.int32)


def _cut_path(template: np.ndarray, topology: HeadTopology, segment: np.ndarray) -> np.ndarray:
    """Vertices of the cut along the middle line, from behind the hairline over the crown to the rim at the
    nape.
    """
    adjacency = vertex_adjacency(topology.faces, len(template))
    forehead = np.unique(topology.faces[segment == SEGMENT_NAMES.index("forehead")])
    hairline = template[forehead, 1].max()
    allowed = np.isin(
        np.arange(len(template)),
        topology.faces[np.isin(segment, [SEGMENT_NAMES.index("scalp"), SEGMENT_NAMES.index("neck")])],
    )
    allowed &= topology.mirror == np.arange(len(template))
    # The throat is on the middle line too: stay behind the ears there.
    allowed &= (template[:, 2] < 0) | (template[:, 1] > hairline)
    start = np.nonzero(allowed)[0][np.argmax(template[allowed, 2])]
    path = [start]
    while True:
        following = [v for v in adjacency[path[-1]].indices if allowed[v] and v not in path]
        if not following:
            break
        path.append(following[0])
    path = np.array(path)
    steps = np.linalg.norm(np.diff(template[path], axis=0), axis=1)
    return path[np.searchsorted(np.cumsum(steps), TIP_BEHIND_HAIRLINE_MM) :]


def _cut(faces: np.ndarray, template: np.ndarray, path: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Open the surface along the path: faces on the side x < 0 get copies of its vertices (the tip stays one).

    Returns faces over the kept vertices and the head vertex that each came from.
    """
    kept, local = np.unique(faces, return_inverse=True)
    faces = local.reshape(-1, 3)
    doubled = np.searchsorted(kept, path[1:])
    copy = np.arange(len(kept))
    copy[doubled] = len(kept) + np.arange(len(doubled))
    right = template[kept][faces].mean(1)[:, 0] < 0
    faces = np.where(right[:, None], copy[faces], faces)
    return faces, np.concatenate([kept, path[1:]])


def _path_sides(faces: np.ndarray, source: np.ndarray, path: np.ndarray) -> list[np.ndarray]:
    """The boundary's four sides as vertex runs, counter-clockwise from the lower left: bottom, right, top, left.

    Neighbouring sides share their corner vertex. The cut's two banks make the left side, the top and the
    right side.
    """
    loop = boundary_loop(faces)
    tip = int(np.nonzero(source[loop] == path[0])[0][0])
    loop = np.roll(loop, -tip)
    bank = len(path) - 1
    corner = round(bank * 0.36)
    cuts = [corner, bank, len(loop) - bank, len(loop) - corner]
    left, bottom, right = (loop[a : b + 1] for a, b in zip(cuts, cuts[1:], strict=False))
    top = np.concatenate([loop[cuts[3] :], loop[: corner + 1]])
    return [bottom, right, top, left]


def _skin_island(vertices: np.ndarray, faces: np.ndarray, segment: np.ndarray, sides: list[np.ndarray]) -> np.ndarray:
    """[N, 2] the cut surface in the unit square."""
    count = len(vertices)
    fixed_u, fixed_v = np.zeros(count, bool), np.zeros(count, bool)
    fixed_u[np.concatenate([sides[1], sides[3]])] = True
    fixed_v[np.concatenate([sides[0], sides[2]])] = True
    start = _harmonic(vertices, faces, sides)
    density = np.array([DENSITY.get(name, 1.0) for name in SEGMENT_NAMES])[segment]
    density = _smoothed(np.log(density), vertices, faces)
    importance = np.array([IMPORTANCE.get(name, 1.0) for name in SEGMENT_NAMES])[segment]
    return relax(start, vertices, faces, np.exp(density), importance, np.stack([fixed_u, fixed_v], axis=1))


def _harmonic(vertices: np.ndarray, faces: np.ndarray, sides: list[np.ndarray]) -> np.ndarray:
    """[N, 2] Tutte's embedding with uniform weights, boundary spaced by length along the unit square's sides."""
    corners = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], np.float64)
    position = np.zeros((len(vertices), 2))
    on_rim = np.zeros(len(vertices), bool)
    for k, side in enumerate(sides):
        steps = np.linalg.norm(np.diff(vertices[side], axis=0), axis=1)
        along = np.concatenate([[0], np.cumsum(steps)]) / steps.sum()
        position[side] = corners[k] + along[:, None] * (corners[(k + 1) % 4] - corners[k])
        on_rim[side] = True
    laplacian = graph_laplacian(faces, len(vertices))
    inner = np.nonzero(~on_rim)[0]
    right_hand = -(laplacian[inner][:, on_rim] @ position[on_rim])
    position[inner] = splu(laplacian[inner][:, inner].tocsc()).solve(right_hand)
    return position


def _smoothed(values: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Per-face values [F], averaged over vertex neighbourhoods a few times so that densities change gently."""
    corners = faces.ravel()
    counts = np.bincount(corners, minlength=len(vertices))
    for _ in range(DENSITY_SMOOTHING):
        at_vertex = np.bincount(corners, np.repeat(values, 3), len(vertices)) / counts
        values = at_vertex[faces].mean(1)
    return values


def _mirrored_mean(uvs: np.ndarray, source: np.ndarray, mirror: np.ndarray) -> np.ndarray:
    """The layout averaged with its own mirror image about u = 1/2: exactly symmetric."""
    goal = uvs * (-1, 1) + (1, 0)
    copies: dict[int, list[int]] = {}
    for k, vertex in enumerate(source):
        copies.setdefault(int(vertex), []).append(k)
    # A vertex on the cut has two copies, one on each bank: its partner is the one on the other bank.
    partner = [
        min(copies[int(mirror[vertex])], key=lambda other, k=k: float(np.linalg.norm(uvs[other] - goal[k])))
        for k, vertex in enumerate(source)
    ]
    return (uvs + goal[partner]) / 2


def _eye_half(
    template: np.ndarray, topology: HeadTopology, part: int, front: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Half an eyeball as a disc of radius 1: its faces [n], places [m, 2], corners of the faces [n, 3].

    Azimuthal equidistant projection about the eye's axis: radius is the angle from the pole.
    """
    members = np.nonzero(topology.part == part)[0]
    vertices = topology.vertices_of(part)
    centre = template[vertices].mean(0)
    is_front = template[topology.faces[members]].mean(1)[:, 2] > centre[2]
    members = members[is_front == front]
    used, local = np.unique(topology.faces[members], return_inverse=True)
    ray = template[used] - centre
    across = ray[:, :2] * (1 if front else -1, 1)
    angle = np.arctan2(np.linalg.norm(across, axis=1), ray[:, 2] if front else -ray[:, 2])
    disc = across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9) * angle[:, None]
    return members, disc / angle.max(), local.reshape(-1, 3)
