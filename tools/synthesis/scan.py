"""A scanned head in place of the procedural one: the ground truth of a subject, to be filmed anew under another light.

Reads SUBJECT/gt/: mesh.obj (mm, head space), albedo.exr, specular.exr, roughness.exr, mask.exr, all in the mesh's UV
layout.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from shared.errors import InputError
from shared.geometry.mesh import Mesh
from shared.io.images import read_exr
from shared.io.meshes import read_obj
from tools.synthesis.surface import Materials

TEXTURES = {"albedo": 3, "specular": 1, "roughness": 1, "mask": 1}
"""Channels of each."""


def read_scan(subject: Path) -> tuple[Mesh, Materials]:
    """The mesh and its textures, resized to the albedo's size where they differ.

    InputError for what is missing, not square or has other channels, and for a head that does not stand upright about
    the origin.
    """
    truth = subject / "gt"
    missing = [name for name in ("mesh.obj", *(f"{name}.exr" for name in TEXTURES)) if not (truth / name).is_file()]
    if missing:
        raise InputError("holds no scan", where=str(truth), got=f"no {', '.join(missing)}",
                         hint="give the folder of a subject with ground truth")
    mesh = read_obj(truth / "mesh.obj")
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    if not ((low < -40.0) & (high > 40.0) & (high < 400.0)).all():
        raise InputError("is no head about the origin", where=str(truth / "mesh.obj"),
                         got=f"from {low.round(1).tolist()} to {high.round(1).tolist()}",
                         expected="mm, x to the head's left, y up, z out of the face")
    textures = {name: _texture(truth / f"{name}.exr", channels) for name, channels in TEXTURES.items()}
    size = textures["albedo"].shape[:2][::-1]
    resized = {name: np.ascontiguousarray(cv2.resize(image, size, interpolation=cv2.INTER_LINEAR))
               for name, image in textures.items()}
    return mesh, Materials(**resized)


def _texture(path: Path, channels: int) -> np.ndarray:
    """[S, S, 3] or [S, S] float32."""
    image = np.asarray(read_exr(path), np.float32)
    if image.ndim == 3 and channels == 1:
        image = image[..., 0]
    if image.shape[0] != image.shape[1] or image.ndim != (3 if channels == 3 else 2):
        raise InputError("not a texture of its kind", where=str(path), got=f"{image.shape}",
                         expected=f"a square one of {channels} channels")
    return image
