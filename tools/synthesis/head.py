"""The procedural subject: a random head of the head model with fine bumps, and how it moves before the camera."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from shared.geometry.mesh import Mesh, interpolate, vertex_normals
from shared.geometry.transforms import rigid, rotation_from_vector
from shared.imaging.value_noise import value_noise
from shared.tracking.head_model import HeadModel
from tools.synthesis.bust import with_bust

IDENTITY_DEVIATION = 0.8
BUMPS_MM = ((9.0, 0.10), (4.0, 0.05))
"""Wavelength and standard deviation of the bumps on the skin, both in mm."""
SMOOTH_SEGMENTS = ("eyes", "inner_mouth", "eye_sockets")
FACE_SEGMENTS = ("forehead", "brows", "nose", "cheek_left", "cheek_right", "upper_lip_skin", "chin")
NECK_PIVOT = np.array([0.0, -95.0, -25.0])
YAW_DEG, PITCH_DEG = 27.0, 12.0
DRIFT_DEG, DRIFT_MM = 0.7, 2.0


@dataclass(frozen=True)
class Head:
    """mesh; face_segment [F] index into segment_names; landmark_face [468] and landmark_bary [468, 3]."""

    mesh: Mesh
    face_segment: np.ndarray
    segment_names: tuple[str, ...]
    landmark_face: np.ndarray
    landmark_bary: np.ndarray

    def landmarks(self) -> np.ndarray:
        """[468, 3] places of the landmarks, mm."""
        return interpolate(self.mesh.vertices, self.mesh.faces, self.landmark_face, self.landmark_bary)


def random_head(model: HeadModel, seed: int, eyes_closed: bool, extra: Mapping[str, float] | None = None) -> Head:
    """A head of the given model (any level): random identity, a slight expression, bumps as displacements.

    extra: activations by name that come on top of the expression.
    """
    rng = np.random.default_rng([seed, 1])
    identity = rng.normal(0, IDENTITY_DEVIATION, len(model.identity_basis))
    expression = np.zeros(len(model.expression_basis))
    smile = rng.uniform(0.0, 0.25)
    amounts = {"mouth_smile_left": smile, "mouth_smile_right": smile * rng.uniform(0.7, 1.3),
               "brow_inner_up": rng.uniform(0, 0.15), "eye_blink_left": 1.0 if eyes_closed else 0.05,
               "eye_blink_right": 1.0 if eyes_closed else 0.05}
    for name, amount in [*amounts.items(), *(extra or {}).items()]:
        expression[model.expression_names.index(name)] += amount
    mesh = model.mesh(identity, expression)
    mesh = with_bust(mesh.replace(vertices=mesh.vertices + _bumps(model, mesh, rng)))
    segment = np.full(len(mesh.faces), model.segment_names.index("neck"), np.uint8)
    segment[:len(model.faces)] = model.face_segment
    return Head(mesh, segment, model.segment_names, model.landmark_face, model.landmark_bary)


def face_part(head: Head) -> Mesh:
    """The skin of the face alone, a fifth of the mesh; unused vertices and uvs are dropped."""
    keep = np.isin(head.face_segment, [head.segment_names.index(name) for name in FACE_SEGMENTS])
    vertices, faces = np.unique(head.mesh.faces[keep], return_inverse=True)
    uvs, face_uvs = np.unique(head.mesh.face_uvs[keep], return_inverse=True)
    return Mesh(head.mesh.vertices[vertices], faces.reshape(-1, 3).astype(np.int32), head.mesh.uvs[uvs],
                face_uvs.reshape(-1, 3).astype(np.int32))


def _bumps(model: HeadModel, mesh: Mesh, rng: np.random.Generator) -> np.ndarray:
    """[V, 3] displacement along the normals; none on eyes and in the mouth."""
    height = sum(value_noise(mesh.vertices, wavelength, rng) * amount for wavelength, amount in BUMPS_MM)
    height[np.unique(mesh.faces[model.segment(*SMOOTH_SEGMENTS)])] = 0.0
    return vertex_normals(mesh.vertices, mesh.faces) * height[:, None]


def head_turn(
    frames: int, distance_mm: float, height_mm: float, seed: int, yaw_deg: float = YAW_DEG, pitch_deg: float = PITCH_DEG
) -> np.ndarray:
    """camera_from_head [F, 4, 4]: a slow look to one side, to the other, up and down, and back.

    The head turns about a pivot in the neck and drifts a little; height_mm: head-space y at the image centre when the
    head looks straight ahead; yaw_deg, pitch_deg: how far it turns and nods to either side.
    """
    rng = np.random.default_rng([seed, 2])
    time = (np.arange(frames) + 0.25) / frames
    sway = np.where(time < 0.5, -np.sin(4 * np.pi * time), 0.0)
    nod = np.where(time >= 0.5, -np.sin(4 * np.pi * time), 0.0)
    drift = np.stack([smooth_random(time, rng) for _ in range(6)], 1)
    angles = np.radians(np.stack([pitch_deg * nod, yaw_deg * sway, 0 * time], 1) + DRIFT_DEG * drift[:, :3])
    turn = (rotation_from_vector(angles * [0, 1, 0]) @ rotation_from_vector(angles * [1, 0, 0])
            @ rotation_from_vector(angles * [0, 0, 1]))
    world_place = NECK_PIVOT - turn @ NECK_PIVOT - [0.0, height_mm, 0.0] + DRIFT_MM * drift[:, 3:]
    camera_from_world = np.diag([1.0, -1.0, -1.0])
    return rigid(camera_from_world @ turn, world_place @ camera_from_world.T + [0.0, 0.0, distance_mm])


def smooth_random(time: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A slowly varying random curve of about unit size."""
    curve = np.zeros_like(time)
    for cycles in (1, 2, 3):
        curve += rng.normal() * np.sin(2 * np.pi * (cycles * time + rng.random())) / cycles
    return curve
