"""A head's mesh in parts that turn by themselves: the head, and the eyeballs where they are known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from shared.geometry.eyeballs import SIDES, Eyeball
from shared.geometry.mesh import Mesh, shading_normals
from shared.geometry.quads import QuadMesh

HEAD, EYES, HAIR = "head", tuple(f"eye_{side}" for side in SIDES), "hair"
"""Names of the parts; the eyes in the order of SIDES; hair is a mesh beside the head's."""


@dataclass(frozen=True, eq=False)
class RigidPart:
    """mesh: its vertices in the axes of head space, counted from the pivot [3] mm that the part turns about; normals
    [V, 3]: those that the vertices have in the whole mesh; vertices [V] int: which ones of it they are."""

    name: str
    mesh: Mesh
    normals: np.ndarray
    pivot: np.ndarray
    vertices: np.ndarray


def head_parts(
    mesh: Mesh, eyes: Sequence[Eyeball] = (), normals: np.ndarray | None = None
) -> tuple[RigidPart, ...]:
    """The head, then the right and the left eyeball, which turn about their centres; the head alone without eyes.

    All share the atlas: UVs stay where they are. Faces keep their order within a part. normals [V, 3]: of a mesh that
    this one was reduced from, with vertices that it does not use and no part has; None: its own.
    """
    if normals is None:
        normals = shading_normals(mesh)
        if not eyes:
            return (RigidPart(HEAD, mesh, normals, np.zeros(3), np.arange(len(mesh.vertices))),)
    rest = np.ones(len(mesh.faces), bool)
    for eye in eyes:
        rest[eye.faces] = False
    whole = [(HEAD, np.nonzero(rest)[0], np.zeros(3))]
    whole += [(name, np.sort(eye.faces), eye.centre) for name, eye in zip(EYES if eyes else (), eyes, strict=True)]
    return tuple(_part(mesh, normals, *each) for each in whole)


def hair_part(hair: Mesh) -> RigidPart:
    """Hair that stands off the head, which goes with it as it is: all of its mesh, with its own normals."""
    return RigidPart(HAIR, hair, shading_normals(hair), np.zeros(3), np.arange(len(hair.vertices)))


def _part(mesh: Mesh, normals: np.ndarray, name: str, faces: np.ndarray, pivot: np.ndarray) -> RigidPart:
    part, used = mesh_part(mesh, faces)
    return RigidPart(name, part.replace(vertices=part.vertices - pivot), normals[used], pivot, used)


def mesh_part(whole: Mesh, kept: np.ndarray) -> tuple[Mesh, np.ndarray]:
    """The faces kept, [F] bool or their numbers [n] int, as a mesh of their own, and which vertices of the whole it has
    [m] int."""
    used, corners = _by_first_use(whole.faces[kept])
    used_uvs, uv_corners = _by_first_use(whole.face_uvs[kept])
    return Mesh(whole.vertices[used], corners, whole.uvs[used_uvs], uv_corners), used


def quad_part(whole: QuadMesh, kept: np.ndarray) -> tuple[QuadMesh, np.ndarray]:
    """The quads kept [Q] bool as a mesh of their own, and which vertices of the whole it has [n] int."""
    used, corners = _by_first_use(whole.quads[kept])
    used_uvs, uv_corners = _by_first_use(whole.quad_uvs[kept])
    return QuadMesh(whole.vertices[used], corners, whole.uvs[used_uvs], uv_corners), used


def _by_first_use(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """[F, K] indices -> those that occur, in the order in which they do, and the corners in their numbers [F, K].

    Neighbours get numbers close to each other, which USD keeps in fewer bytes.
    """
    used, first, which = np.unique(corners, return_index=True, return_inverse=True)
    order = np.argsort(first)
    number = np.empty(len(used), int)
    number[order] = np.arange(len(used))
    return used[order], number[which].reshape(corners.shape)


def part_runs(face_count: int, eyes: Sequence[Eyeball]) -> list[tuple[str, int, int]]:
    """Runs of faces that belong to one part, in the mesh's order: (name, first face, face after the last)."""
    part = np.zeros(face_count, int)
    for k, eye in enumerate(eyes):
        part[eye.faces] = k + 1
    starts = [0, *(np.nonzero(np.diff(part))[0] + 1).tolist()]
    names = (HEAD, *EYES)
    return [(names[part[a]], a, b) for a, b in zip(starts, [*starts[1:], face_count], strict=True)]
