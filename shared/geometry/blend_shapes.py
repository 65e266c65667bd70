"""Blend shapes: how a mesh's vertices move and normals move as one action goes from nothing, 0, to all, 1."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from shared.geometry.mesh import Mesh, shading_normals, vertex_normals

BLINKS = "eyeBlinkRight", "eyeBlinkLeft"
"""Names of the actions that shut the right and the left eye."""
LOOKS_DOWN, LOOKS_UP = ("eyeLookDownRight", "eyeLookDownLeft"), ("eyeLookUpRight", "eyeLookUpLeft")
"""Of those with which the lids of the right and the left eye follow its gaze."""
LOOK_RAD = np.radians(30.0)
"""How far the gaze is down or up where the weight of these is 1."""
LID_ACTIONS = (*BLINKS, *LOOKS_DOWN, *LOOKS_UP)


@dataclass(frozen=True, eq=False)
class BlendShape:
    """vertices [n] int, in order: those that move; offsets [n, 3] float32 mm at weight 1. between: (weight in (0, 1),
    offsets [n, 3]) in order, in-betweens where the way there is not straight. normals [1 + k, n, 3] float32: what is
    added to unit normals at weight 1, then at each of k in-betweens; None where that is not known."""

    name: str
    vertices: np.ndarray
    offsets: np.ndarray
    between: tuple[tuple[float, np.ndarray], ...] = ()
    normals: np.ndarray | None = None

    @classmethod
    def of(
        cls, name: str, moves: np.ndarray, least_mm: float, between: tuple[tuple[float, np.ndarray], ...] = ()
    ) -> BlendShape:
        """From displacements moves [V, 3] mm and those of in-betweens, of vertices that one of them moves by more than
        least_mm. Up to 4 least_mm they move by so much less, at most least_mm, that no step is left beside the others.
        """
        largest = np.max([np.linalg.norm(each, axis=1) for each in (moves, *(own for _, own in between))], axis=0)
        used = np.nonzero(largest > least_mm)[0]
        share = np.minimum(4.0 / 3.0 * (1.0 - least_mm / largest[used]), 1.0)[:, None]
        return cls(name, used.astype(np.int32), (share * moves[used]).astype(np.float32),
                   tuple((weight, (share * own[used]).astype(np.float32)) for weight, own in between))

    def at(self, weight: float) -> np.ndarray:
        """[n, 3] mm at a weight: straight from one in-between to the next; below 0 the first of these ways goes on,
        above 1 the last one, as UsdSkel has it."""
        weights = [0.0, *(place for place, _ in self.between), 1.0]
        knots = [np.zeros_like(self.offsets), *(own for _, own in self.between), self.offsets]
        k = int(np.clip(np.searchsorted(weights, weight, side="right") - 1, 0, len(weights) - 2))
        share = (weight - weights[k]) / (weights[k + 1] - weights[k])
        return (1.0 - share) * knots[k] + share * knots[k + 1]

    def applied(self, vertices: np.ndarray, weight: float) -> np.ndarray:
        """Vertices [V, 3] mm with the action at a weight."""
        moved = np.array(vertices, np.float64)
        moved[self.vertices] += self.at(weight)
        return moved

    def of_part(self, part: np.ndarray) -> BlendShape:
        """The same for a mesh of the vertices part [m] alone: its first vertex is part[0]."""
        place = np.full(max(part.max(initial=0), self.vertices.max(initial=0)) + 1, -1)
        place[part] = np.arange(len(part))
        moved = place[self.vertices]
        order = np.argsort(moved)[np.count_nonzero(moved < 0):]
        return replace(self, vertices=moved[order].astype(np.int32), offsets=self.offsets[order],
                       between=tuple((weight, own[order]) for weight, own in self.between),
                       normals=None if self.normals is None else self.normals[:, order])


def with_normals(shapes: Sequence[BlendShape], mesh: Mesh) -> tuple[BlendShape, ...]:
    """The shapes of a mesh with what they add to its shading normals; nothing where the faces around a moved vertex
    lose their area."""
    rest, found = shading_normals(mesh), []
    for shape in shapes:
        moving = np.zeros(len(mesh.vertices), bool)
        moving[shape.vertices] = True
        faces, before, added = mesh.faces[moving[mesh.faces].any(1)], rest[shape.vertices], []
        for offsets in (shape.offsets, *(own for _, own in shape.between)):
            moved = np.array(mesh.vertices, np.float64)
            moved[shape.vertices] += offsets
            after = vertex_normals(moved, faces)[shape.vertices]
            added.append(np.where(np.abs(after).max(1, keepdims=True) > 0.0, after - before, 0.0))
        found.append(replace(shape, normals=np.array(added, np.float32)))
    return tuple(found)


@dataclass(frozen=True, eq=False)
class LidActions:
    """The actions that move the lids of the right and the left eye, LID_ACTIONS, by their names."""

    shapes: Mapping[str, BlendShape]

    @classmethod
    def of(cls, shapes: Sequence[BlendShape]) -> LidActions | None:
        """None where one is missing."""
        named = {shape.name: shape for shape in shapes}
        return cls({name: named[name] for name in LID_ACTIONS}) if named.keys() >= set(LID_ACTIONS) else None

    @staticmethod
    def weights(shut: np.ndarray, pitch: np.ndarray) -> dict[str, np.ndarray]:
        """{name: weight [F] in [0, 1]}; shut [F, 2]: how far each eye is; pitch [F, 2] radians: how far its gaze is up
        from where it is with lids at rest. Lids follow the gaze as far as they are open."""
        look = np.clip(pitch / LOOK_RAD, -1.0, 1.0) * (1.0 - shut)
        kinds = zip((BLINKS, LOOKS_DOWN, LOOKS_UP), (shut, np.maximum(-look, 0.0), np.maximum(look, 0.0)), strict=True)
        return {name: kind[:, eye] for names, kind in kinds for eye, name in enumerate(names)}

    def moved(self, vertices: np.ndarray, shut: np.ndarray, pitch: np.ndarray) -> np.ndarray:
        """Vertices [V, 3] mm with the lids as weights has them; shut [2], pitch [2]."""
        for name, weight in self.weights(shut[None], pitch[None]).items():
            vertices = self.shapes[name].applied(vertices, float(weight[0]))
        return vertices
