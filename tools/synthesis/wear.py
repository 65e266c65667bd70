"""What a synthetic head wears: glasses, hair over the forehead, a beard. Real geometry that shades, hides and is lit.

Glasses and hair are tubes joined to the head's mesh; they turn with it. Their texture lies in two strips beside the
head's layout that it leaves free (see bust), so that the tracer needs to know nothing of them. Lenses are left
out: thin, clean glass hides little; frames hide and shade. A beard is the skin itself, thicker and rough.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from shared.geometry.mesh import Mesh, normalised, vertex_adjacency, vertex_normals
from shared.geometry.raycast import RayScene
from shared.imaging.value_noise import value_noise
from tools.synthesis.bust import quads
from tools.synthesis.head import Head
from tools.synthesis.surface import Materials

GLASSES_U, HAIR_U = (0.006, 0.034), (0.966, 0.994)
"""Columns of the texture, left and right of the head's layout."""
STRIP_V, MARGIN = (0.10, 0.98), 0.003
SIDES = 8
GLASSES = {"albedo": (0.03, 0.028, 0.026), "specular": 1.0, "roughness": 0.25}
HAIR = {"albedo": (0.055, 0.036, 0.025), "specular": 0.5, "roughness": 0.4}

EYES = {"right": (33, 133), "left": (263, 362)}
"""Landmarks of the corners of the eyes, outer and inner."""
BROW_MIDDLE, FOREHEAD_TOP, FOREHEAD_SIDES = 9, 10, (54, 284)
RIM_MM = (26.0, 20.0)
"""Half width and half height of a rim."""
WRAP, CLEARANCE_MM, FRONT_MM = 0.12, 1.0, 400.0
"""How fast rims recede sideways; what stays free between them and the skin; where rays start."""
EAR_MM, BEFORE_EARS_MM = (14.0, -12.0), 22.0
STRAND_MM, STRAND_GAP_MM = (1.6, 0.5), 4.0
BEARD_SEGMENTS = ("chin", "jaw", "upper_lip_skin")
BEARD_WAVELENGTH_MM = 5.0


@dataclass(frozen=True)
class Tube:
    """vertices [V, 3], faces [F, 3] wound outwards, uvs [U, 2] in the unit square, face_uvs [F, 3]."""

    vertices: np.ndarray
    faces: np.ndarray
    uvs: np.ndarray
    face_uvs: np.ndarray


def tube(path: np.ndarray, radii: tuple[float, float], closed: bool = False) -> Tube:
    """Along points [N, 3]; radii: across the path, sideways and as seen from the front. Open ends stay open."""
    along = normalised(np.roll(path, -1, 0) - np.roll(path, 1, 0) if closed else np.gradient(path, axis=0))
    helper = np.where(np.abs(along[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[0.0, 1.0, 0.0]])
    side = normalised(np.cross(along, helper))
    outward = np.cross(side, along)
    angle = 2 * np.pi * np.arange(SIDES) / SIDES
    ring = radii[0] * np.cos(angle)[:, None] * side[:, None] + radii[1] * np.sin(angle)[:, None] * outward[:, None]
    rows = len(path) + closed
    row, column = np.meshgrid(np.arange(rows), np.arange(SIDES + 1), indexing="ij")
    index, uv_index = row % len(path) * SIDES + column % SIDES, row * (SIDES + 1) + column
    uvs = np.stack([column / SIDES, row / (rows - 1)], -1).reshape(-1, 2)
    return Tube((path[:, None] + ring).reshape(-1, 3), quads(index), uvs, quads(uv_index))


def with_glasses(head: Head, radius_mm: float) -> Head:
    """The head with rims, bridge and temples of that thickness."""
    marks, scene = head.landmarks(), RayScene(head.mesh.vertices, head.mesh.faces)
    tubes, inner = [], []
    for corners in EYES.values():
        centre = marks[list(corners)].mean(0) + [0.0, -2.0, 0.0]
        side, angle = np.sign(centre[0]), 2 * np.pi * np.arange(40) / 40
        rim = centre + np.stack([RIM_MM[0] * np.cos(angle), RIM_MM[1] * np.sin(angle), 0 * angle], 1)
        rim[:, 2] -= WRAP * side * rim[:, 0]
        rim[:, 2] += (_surface_z(scene, rim[:, 0], rim[:, 1]) - rim[:, 2]).max() + radius_mm + CLEARANCE_MM
        outwards = side * rim[:, 0]
        tubes += [tube(rim, (radius_mm, radius_mm), closed=True),
                  _temple(head, rim[np.argmax(outwards)], radius_mm)]
        inner.append(rim[np.argmin(outwards)])
    t = np.linspace(0, 1, 9)[:, None]
    bridge = inner[0] * (1 - t) + inner[1] * t + 4 * t * (1 - t) * [[0.0, 3.0, 1.0]]
    bridge[:, 2] += max(0.0, (_surface_z(scene, bridge[:, 0], bridge[:, 1]) - bridge[:, 2]).max() + radius_mm)
    return _joined(head, [*tubes, tube(bridge, (radius_mm, radius_mm))], GLASSES_U)


def _temple(head: Head, hinge: np.ndarray, radius_mm: float) -> Tube:
    """From the rim's outer end [3] around the side of the head to the ear."""
    y, z = head.mesh.vertices[:, 1], head.mesh.vertices[:, 2]
    beside = (np.abs(y - 0.5 * (hinge[1] + EAR_MM[0])) < 15.0) & (z > BEFORE_EARS_MM) & (z < hinge[2])
    across = np.sign(hinge[0]) * (np.abs(head.mesh.vertices[beside, 0]).max() + radius_mm + CLEARANCE_MM)
    bend, ear = np.array([across, hinge[1], hinge[2] - 14.0]), np.array([across, *EAR_MM])
    line = np.concatenate([np.linspace(hinge, bend, 5), np.linspace(bend, ear, 16)[1:]])
    return tube(line, (radius_mm, radius_mm))


def _surface_z(scene: RayScene, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """[N] z of what is seen from the front at x, y [N]; minus infinity beside the head."""
    origins = np.stack([x, y, np.full(len(x), FRONT_MM)], 1).astype(np.float32)
    return FRONT_MM - scene.intersect(origins, np.tile(np.float32([0, 0, -1]), (len(x), 1)))[2]


def with_fringe(head: Head, cover: float, seed: int) -> Head:
    """The head with strands that hang from the hairline to the brows and cover that share of the forehead."""
    rng = np.random.default_rng([seed, 7])
    marks, scene = head.landmarks(), RayScene(head.mesh.vertices, head.mesh.faces)
    left, right = sorted(marks[mark][0] for mark in FOREHEAD_SIDES)
    top, bottom = marks[FOREHEAD_TOP][1] + 12.0, marks[BROW_MIDDLE][1] + 4.0
    count = round(cover * (right - left) / (2 * STRAND_MM[0]))
    tubes = []
    for place in np.linspace(left, right, count) if count > 1 else []:
        lean, length = rng.uniform(-0.15, 0.15), rng.uniform(0.8, 1.1)
        height = np.linspace(top, top - length * (top - bottom), 14)
        across = place + rng.uniform(-1.0, 1.0) + lean * (top - height)
        depth = _surface_z(scene, across, height) + STRAND_GAP_MM * np.linspace(0.15, 1.0, 14) + rng.uniform(0, 1.5)
        if np.isfinite(depth).all():
            tubes.append(tube(np.stack([across, height, depth], 1), STRAND_MM))
    return _joined(head, tubes, HAIR_U)


def with_beard(head: Head, length_mm: float, seed: int) -> Head:
    """The head with cheeks, chin and upper lip that thick, in tufts."""
    return thickened(head, BEARD_SEGMENTS, ("lips", "inner_mouth", "neck"), length_mm, BEARD_WAVELENGTH_MM,
                     np.random.default_rng([seed, 8]))


def thickened(head: Head, segments: tuple[str, ...], bare: tuple[str, ...], length_mm: float, wavelength_mm: float,
              rng: np.random.Generator) -> Head:
    """The head with the named segments that thick, in tufts of that wavelength; those of bare stay as they are."""
    mesh = head.mesh
    inside = np.isin(head.face_segment, [head.segment_names.index(name) for name in segments])
    share = np.zeros(len(mesh.vertices))
    np.maximum.at(share, mesh.faces[inside].ravel(), 1.0)
    kept = np.isin(head.face_segment, [head.segment_names.index(name) for name in bare])
    share[np.unique(mesh.faces[kept])] = 0.0
    adjacency = vertex_adjacency(mesh.faces, len(share))
    for _ in range(3):
        share = np.minimum(share, adjacency @ share / np.maximum(adjacency.sum(1).A1, 1.0))
    tufts = 0.75 + 0.25 * np.clip(value_noise(mesh.vertices, wavelength_mm, rng), -1, 1)
    moved = mesh.vertices + (length_mm * share * tufts)[:, None] * vertex_normals(mesh.vertices, mesh.faces)
    return replace(head, mesh=mesh.replace(vertices=moved))


def _joined(head: Head, tubes: list[Tube], columns: tuple[float, float]) -> Head:
    """The head with tubes after its own vertices, textured in a strip of columns."""
    mesh, segment = head.mesh, head.segment_names.index("neck")
    edges = np.linspace(*columns, len(tubes) + 1)
    parts, segments = [mesh], [head.face_segment]
    count, uv_count = len(mesh.vertices), len(mesh.uvs)
    for part, low, high in zip(tubes, edges[:-1], edges[1:], strict=True):
        u = low + (high - low) * (0.1 + 0.8 * part.uvs[:, 0])
        v = STRIP_V[0] + (STRIP_V[1] - STRIP_V[0]) * part.uvs[:, 1]
        parts.append(Mesh(part.vertices, part.faces + count, np.stack([u, v], 1), part.face_uvs + uv_count))
        segments.append(np.full(len(part.faces), segment, head.face_segment.dtype))
        count, uv_count = count + len(part.vertices), uv_count + len(part.uvs)
    joined = Mesh(*(np.concatenate([getattr(part, name) for part in parts]).astype(kind) for name, kind in
                    (("vertices", float), ("faces", np.int32), ("uvs", float), ("face_uvs", np.int32))))
    return replace(head, mesh=joined, face_segment=np.concatenate(segments))


def coloured(materials: Materials) -> Materials:
    """The textures with the strips of glasses and hair painted; neither counts as face skin."""
    size = len(materials.mask)
    centre = (np.arange(size) + 0.5) / size
    rows = slice(0, round((1.01 - STRIP_V[0]) * size))
    values = {name: np.array(getattr(materials, name)) for name in ("albedo", "specular", "roughness", "mask")}
    for look, strip in ((GLASSES, centre < GLASSES_U[1] + MARGIN), (HAIR, centre > HAIR_U[0] - MARGIN)):
        for name, value in {**look, "mask": 0.0}.items():
            values[name][rows, strip] = value
    return Materials(**values)
