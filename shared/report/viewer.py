"""The mesh for the page's 3D view: quantised and packed into base64 text; light as order-2 harmonics; some of the
facial actions.

Reference: [Ramamoorthi2001] (irradiance by nine harmonics).
"""

from __future__ import annotations

import base64
from collections.abc import Sequence

import numpy as np

from shared.geometry.blend_shapes import BlendShape
from shared.geometry.mesh import Mesh

SHOWN_ACTIONS = ("eyeBlinkLeft", "eyeBlinkRight", "browInnerUp", "browDownLeft", "jawOpen", "mouthSmileLeft",
                 "mouthSmileRight", "mouthPucker")
ACTION_STEP_MM, LEAST_STEPS = 0.01, 5
"""Offsets are written as multiples of it; where they stay below so many the vertex does not move."""

WET = (0.2, 0.63)
"""Roughness and specular intensity of eyes: the view's lamp has no extent, so they stand for a tear film under a small
one, whose catchlight fills some pixels. 0.63 times F0 = 0.04 is that of an index of refraction of 1.376."""


def packed(
    mesh: Mesh, normals: np.ndarray, wet: np.ndarray | None = None, actions: Sequence[BlendShape] = ()
) -> dict:
    """For viewer.js: one vertex per distinct corner, positions and UVs as uint16, normals as int8, base64.

    normals [V, 3]: those of the mesh that this one was reduced from; wet [V] bool: vertices of the eyes, whose normals
    have a fourth component of 127, else 0. actions: of the mesh, of which those of SHOWN_ACTIONS are packed.
    -> {"count", "positions", "normals", "uvs", "faces", "low" [3], "size" [3], "actions"};
    position = low + size * q / 65535 mm. An action is {"name", "vertices", "offsets", "half"}: int16 in steps of
    ACTION_STEP_MM; "half" at weight 0.5, "" where the way is straight.
    """
    uv_codes = np.round(np.clip(mesh.uvs, 0.0, 1.0) * 65535).astype(np.int64)
    keys = np.column_stack([mesh.faces.ravel(), uv_codes[mesh.face_uvs.ravel()]])
    corners, index = np.unique(keys, axis=0, return_inverse=True)
    used = corners[:, 0]
    low, high = mesh.vertices[used].min(0), mesh.vertices[used].max(0)
    size = np.maximum(high - low, 1e-9)
    positions, padded = np.zeros((len(corners), 4), "<u2"), np.zeros((len(corners), 4), np.int8)
    positions[:, :3] = np.round((mesh.vertices[used] - low) / size * 65535)
    padded[:, :3] = np.round(normals[used] * 127)
    if wet is not None:
        padded[:, 3] = np.where(wet[used], 127, 0)
    return {
        "count": int(index.size),
        "positions": _text(positions),
        "normals": _text(padded),
        "uvs": _text(corners[:, 1:].astype("<u2")),
        "faces": _text(index.ravel().astype("<u4")),
        "low": [round(float(value), 4) for value in low],
        "size": [round(float(value), 4) for value in size],
        "actions": [_packed_action(shape, used) for shape in actions if shape.name in SHOWN_ACTIONS],
    }


def _packed_action(shape: BlendShape, used: np.ndarray) -> dict:
    """used [n]: vertex of each packed one."""
    between = dict(shape.between).get(0.5)
    moves = np.stack([shape.offsets, shape.offsets if between is None else between])
    steps = np.round(moves / ACTION_STEP_MM).clip(-32767, 32767).astype("<i2")
    row = np.full(max(used.max(), shape.vertices.max()) + 1, -1)
    row[shape.vertices] = np.where(np.abs(steps).max((0, 2)) >= LEAST_STEPS, np.arange(len(shape.vertices)), -1)
    corners = np.nonzero(row[used] >= 0)[0]
    full, half = steps[:, row[used[corners]]]
    return {"name": shape.name, "vertices": _text(corners.astype("<u4")), "offsets": _text(full),
            "half": "" if between is None else _text(half)}


def _text(array: np.ndarray) -> str:
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode("ascii")


def irradiance_harmonics(envmap: np.ndarray) -> np.ndarray:
    """[H, W, 3] lat-long radiance -> [9, 3] such that sum_k c_k Y_k(n) is irradiance / pi for the normal n.

    Y_k as polynomials 1, y, z, x, xy, yz, 3z^2-1, xz, x^2-y^2 with their constants folded into c ([Ramamoorthi2001],
    eqs. 3 and 8: the clamped cosine weighs the orders by pi, 2 pi / 3, pi / 4).
    """
    height, width = envmap.shape[:2]
    v, u = np.meshgrid((np.arange(height) + 0.5) / height, (np.arange(width) + 0.5) / width, indexing="ij")
    ring = np.sin(np.pi * v)
    x, y, z = np.sin(2 * np.pi * u) * ring, np.cos(np.pi * v), -np.cos(2 * np.pi * u) * ring
    basis = np.stack([np.ones_like(x), y, z, x, x * y, y * z, 3 * z * z - 1, x * z, x * x - y * y], axis=-1)
    constants = np.array([0.282095, *[0.488603] * 3, 1.092548, 1.092548, 0.315392, 1.092548, 0.546274])
    cosine = np.array([1.0, *[2 / 3] * 3, *[0.25] * 5])
    solid_angle = ring * (2 * np.pi / width) * (np.pi / height)
    moments = np.einsum("hw,hwk,hwc->kc", solid_angle, basis, envmap)
    return moments * (constants**2 * cosine)[:, None]
