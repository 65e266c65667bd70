"""Living eyes of the procedural head: eyeballs that are exact spheres, and lids that slide over them.

The head model's eyeballs are slightly oval and a third too large. A living eyeball is a sphere as large as an adult's,
whose front lies where theirs does, of the seed's own size and depth, and the lids keep the distance from it that they
had. Lids move along arcs about its centre, not along the straight displacements of the model, which would cut into it;
they are shut where they meet.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from shared.compute.smooth_step import smooth_step
from shared.geometry.eyeballs import EYE_RADIUS_MM, SIDES, fit_sphere
from shared.geometry.raycast import RayScene
from shared.tracking.head_model import HeadModel
from tools.synthesis.head import Head, random_head

RADIUS_SPREAD, DEPTH_SPREAD_MM = 0.05, 0.5
"""How far an eyeball's radius goes from an adult's, and its front from the model's, to either side, evenly."""
KEPT_MM, FREE_MM = 3.0, 12.0
"""Skin so near an eyeball moves with its surface; skin so far from it stays where it is."""
REACH_MM = 32.0
"""From an eyeball's centre: no lid moves beyond."""
BROW_MM = 60.0
"""From an eyeball's centre: all that hides it from the front."""
BLINK = ("eye_blink_right", "eye_blink_left")
WIDE = ("eye_wide_right", "eye_wide_left")
AT_REST = 0.05
"""Activation of the blink that lids at rest already have (head.random_head)."""
OPEN = 0.45
"""Activation of the model's wide eyes in lids at rest: its own hide the upper half of an iris that looks ahead."""
WIDE_PER_AMOUNT = 2.3
"""Activations of the model's wide eyes that raise the upper lid as far as one blink lowers it."""
SHUT_STEPS = 9
"""Halvings that find where lids meet."""
SLOPES = ((0.0, 0.0), (-0.5, 0.0), (0.5, 0.0), (0.0, -0.25), (0.0, 0.25))
"""Sideways and up: ways of rays that may not meet an eyeball which is shut."""
COLUMNS_MM, STEP_MM, BEFORE_MM = (-2.0, -1.0, 0.0, 1.0, 2.0), 0.1, 300.0
"""Beside the centre of an eyeball: where the opening of the lids is measured; between rays; where they start."""


@dataclass(frozen=True, eq=False)
class LivingEyes:
    """Right, then left: centres [2, 3] and the radius of both, mm; face_side [F] of the head's faces: 0 right eyeball,
    1 left, -1 neither. rest, shut, wide [V, 3]: the head model's vertices with lids at rest, in the shape of a whole
    blink and wide open; meeting: the share of that blink at which they meet."""

    centres: np.ndarray
    radius: float
    face_side: np.ndarray
    rest: np.ndarray
    shut: np.ndarray
    wide: np.ndarray
    meeting: float = 1.0

    def lids(self, amount: float) -> np.ndarray:
        """[V, 3] displacement from the head at rest, mm: amount 0 at rest, 1 shut, below 0 wider open."""
        if amount <= 0:
            return -amount * WIDE_PER_AMOUNT * (self.wide - self.rest)
        share, moved = amount * self.meeting, np.array(self.rest)
        for side, centre in enumerate(self.centres):
            own = (np.sign(self.rest[:, 0]) == (-1, 1)[side]) & (np.abs(self.shut - self.rest).max(1) > 1e-6)
            start, end = self.rest[own] - centre, self.shut[own] - centre
            far, near = np.linalg.norm(start, axis=1), np.linalg.norm(end, axis=1)
            chord = (1 - share) * start + share * end
            length = (1 - share) * far + share * near
            moved[own] = centre + chord * (length / np.linalg.norm(chord, axis=1))[:, None]
        return moved - self.rest

    def with_lids(self, head: Head, amount: float) -> Head:
        """The head, whatever it wears, with its lids moved."""
        vertices = np.array(head.mesh.vertices)
        vertices[:len(self.rest)] += self.lids(amount)
        return replace(head, mesh=head.mesh.replace(vertices=vertices))

    def openings(self, head: Head, amount: float) -> np.ndarray:
        """[2] mm: height of the eyeball seen from the front between the lids, mean over a few columns."""
        faces, scene = self._before(head, amount)
        y = np.arange(-self.radius, self.radius, STEP_MM)
        return np.array([STEP_MM * self._seen(scene, faces, side, COLUMNS_MM, y).sum() / len(COLUMNS_MM)
                         for side in range(len(SIDES))])

    def shown(self, head: Head, amount: float) -> int:
        """How many rays of fixed grids, from the front and askew, meet an eyeball."""
        faces, scene = self._before(head, amount)
        grid = np.arange(-self.radius, self.radius, 3 * STEP_MM)
        return sum(int(self._seen(scene, faces, side, grid, grid, slope).sum())
                   for side in range(len(SIDES)) for slope in SLOPES)

    def _before(self, head: Head, amount: float) -> tuple[np.ndarray, RayScene]:
        """Faces [N] about the eyes, and what rays meet of them."""
        vertices = self.with_lids(head, amount).mesh.vertices
        near = np.linalg.norm(vertices[:, None] - self.centres, axis=2).min(1) < BROW_MM
        faces = np.nonzero(near[head.mesh.faces].any(1))[0]
        return faces, RayScene(vertices, head.mesh.faces[faces])

    def _seen(self, scene: RayScene, faces: np.ndarray, side: int, x: np.ndarray, y: np.ndarray,
              slope: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
        """[N] bool: rays beside the eyeball's front at all x [K] and y [L] that meet it first; slope: of their ways
        sideways and up."""
        grid = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
        front = self.centres[side] + np.column_stack([grid, np.full(len(grid), self.radius)])
        towards = np.array([*slope, -1.0])
        origins = (front - BEFORE_MM * towards).astype(np.float32)
        face = scene.first_faces(origins, np.tile(towards.astype(np.float32), (len(grid), 1)))
        return (face >= 0) & (self.face_side[faces[face]] == side)


def living_head(model: HeadModel, seed: int) -> tuple[Head, LivingEyes]:
    """The head that random_head makes, with open eyes, round eyeballs and the lids kept about them."""
    head = random_head(model, seed, eyes_closed=False, extra=dict.fromkeys(WIDE, OPEN))
    rng = np.random.default_rng([seed, 10])
    size, depth = 1.0 + RADIUS_SPREAD * rng.uniform(-1, 1), DEPTH_SPREAD_MM * rng.uniform(-1, 1)
    eyes = head.face_segment == head.segment_names.index("eyes")
    oval = [_Oval.of(head, eyes, sign) for sign in (-1, 1)]
    radius = size * EYE_RADIUS_MM
    centres = np.stack([one.centre + [0.0, 0.0, one.radius - radius + depth] for one in oval])
    rest, wide, shut = (_rounded(vertices, oval, centres, radius) for vertices in _lid_shapes(model, head))
    vertices = np.concatenate([rest, head.mesh.vertices[len(rest):]])
    head = replace(head, mesh=head.mesh.replace(vertices=vertices))
    right = vertices[head.mesh.faces[:, 0], 0] < 0
    side = np.where(eyes, np.where(right, 0, 1), -1).astype(np.int8)
    found = LivingEyes(centres, radius, side, rest, shut, wide)
    return head, replace(found, meeting=_meeting(found, head))


def _lid_shapes(model: HeadModel, head: Head) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """[V, 3] each: the head model's part of the head at rest, with eyes wide open, and with the blink in full."""
    rest = head.mesh.vertices[:len(model.template)]
    blink, wide = (sum(model.expression_basis[model.expression_names.index(name)] for name in names)
                   for names in (BLINK, WIDE))
    return rest, rest + wide, rest + (1.0 - AT_REST) * blink - OPEN * wide


@dataclass(frozen=True, eq=False)
class _Oval:
    """An eyeball of the head model: its vertices, the sphere nearest to it and what rays from its centre meet."""

    vertices: np.ndarray
    centre: np.ndarray
    radius: float
    scene: RayScene

    @staticmethod
    def of(head: Head, eyes: np.ndarray, sign: int) -> _Oval:
        corners = head.mesh.faces[eyes]
        corners = corners[np.sign(head.mesh.vertices[corners[:, 0], 0]) == sign]
        vertices = np.unique(corners)
        centre, radius = fit_sphere(head.mesh.vertices[vertices])
        return _Oval(vertices, centre, radius, RayScene(head.mesh.vertices, corners))

    def distance(self, towards: np.ndarray) -> np.ndarray:
        """[N] mm from the centre to the surface in unit directions [N, 3]."""
        origins = np.tile(self.centre.astype(np.float32), (len(towards), 1))
        return self.scene.intersect(origins, towards.astype(np.float32))[2]


def _rounded(vertices: np.ndarray, oval: list[_Oval], centres: np.ndarray, radius: float) -> np.ndarray:
    """Vertices [V, 3] about the spheres as they were about the ovals: what is near moves with the surface."""
    moved = np.array(vertices)
    for old, centre in zip(oval, centres, strict=True):
        arm = vertices - old.centre
        near = np.nonzero(np.linalg.norm(arm, axis=1) < REACH_MM)[0]
        length = np.linalg.norm(arm[near], axis=1)
        outward = arm[near] / length[:, None]
        surface = old.distance(outward)
        weight = 1.0 - smooth_step((length - surface - KEPT_MM) / (FREE_MM - KEPT_MM))
        moved[near] += weight[:, None] * (centre - old.centre + (radius - surface)[:, None] * outward)
        own = vertices[old.vertices] - old.centre
        moved[old.vertices] = centre + radius * own / np.linalg.norm(own, axis=1, keepdims=True)
    return moved


def _meeting(eyes: LivingEyes, head: Head) -> float:
    """The share of a whole blink at which lids hide the eyeballs."""
    low, high = 0.0, 1.0
    for _ in range(SHUT_STEPS):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if not eyes.shown(head, middle) else (middle, high)
    return high
