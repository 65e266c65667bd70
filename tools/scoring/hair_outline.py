"""How far the outline of a result's hair lies from the true one, where hair stands before the background.

Each place of the true outline that shows hair looks for the nearest place of the result's outline, head and hair
together, in the frames that hold truth. Both outlines are those where half a pixel is covered, a fraction of a pixel
exactly. A pixel's size is that of the true surface's depth there.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from scipy.ndimage import distance_transform_edt

from shared.geometry.mesh import Mesh
from shared.hair.hair_files import read_hair
from shared.hair.joined import joined_alpha, joined_mesh
from shared.imaging.image_sampling import SurfaceViewer
from shared.imaging.material_labels import HAIR
from shared.io.images import read_exr, read_png
from shared.rendering.render import head_coverage
from tools.scoring.labels import label_files
from tools.scoring.measures import summary

FINER = 4
"""Parts of a pixel along an edge in which outlines are drawn."""
SAMPLES = 4
"""Rays along each edge of a pixel that tell how much of it the result covers."""
BORDER_PX = 3
"""Beside the picture's border nothing is an outline."""


def hair_outline_errors(
    frames: Path, export: Path, mesh: Mesh, poses: dict[int, np.ndarray], intrinsics: np.ndarray
) -> dict | None:
    """{frames, mean, median, p95 mm, outwards: median mm by which the result's hair is too wide}; None where no outline
    of the truth shows hair.

    frames: the truth's folder of %04d_label.png, _head.png and _depth.exr; export: with hair.obj where there is one;
    mesh, poses {frame: camera_from_head [4, 4]} and intrinsics [3, 3] px are the result's.
    """
    hair = read_hair(export)
    shown, alpha = (mesh, None) if hair is None else (joined_mesh(mesh, hair.mesh), joined_alpha(hair.alpha))
    viewer, found = SurfaceViewer.of(shown), []
    for frame, path in label_files(frames).items():
        if frame not in poses:
            continue
        true = read_png(frames / f"{frame:04d}_head.png") / np.float32(255)
        coverage = head_coverage(viewer, alpha, poses[frame], intrinsics, true.shape[::-1], SAMPLES)
        pixel_mm = read_exr(frames / f"{frame:04d}_depth.exr") / intrinsics[0, 0]
        found.append(outline_offsets(true, coverage.astype(np.float32), read_png(path) == HAIR, pixel_mm))
    offsets = np.concatenate([*found, np.empty(0)])
    if not len(offsets):
        return None
    return {"frames": len(found), **summary(np.abs(offsets)), "outwards": float(np.median(offsets))}


def outline_offsets(true: np.ndarray, found: np.ndarray, hair: np.ndarray, pixel_mm: np.ndarray) -> np.ndarray:
    """[N] mm at places along the outline of true [H, W], a coverage in [0, 1], that show hair [H, W] bool: how far
    outwards the nearest outline of found [H, W] lies; pixel_mm [H, W]: sizes of pixels, 0 beside the head."""
    inside, other = _finer(true) > 0.5, _finer(found) > 0.5
    if not other.any():
        return np.empty(0)
    edge = inside & ~cv2.erode(inside.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    row, column = np.nonzero(edge)
    height, width = true.shape
    y, x = row // FINER, column // FINER
    within = (np.minimum(x, width - 1 - x) >= BORDER_PX) & (np.minimum(y, height - 1 - y) >= BORDER_PX)
    # A pixel of the outline may be labelled as what is behind it: its neighbours tell.
    beside = cv2.dilate(hair.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    size = cv2.dilate(pixel_mm.astype(np.float32), np.ones((3, 3), np.uint8))
    kept = within & beside[y, x] & (size[y, x] > 0.0)
    # Half a step: distances are counted to the nearest place of the other kind.
    outwards = np.where(other, distance_transform_edt(other) - 0.5, 0.5 - distance_transform_edt(~other))
    own = 0.5  # of the edge's places to the true outline itself
    return ((outwards[row, column] - own) / FINER * size[y, x])[kept]


def _finer(coverage: np.ndarray) -> np.ndarray:
    return cv2.resize(coverage, None, fx=FINER, fy=FINER, interpolation=cv2.INTER_LINEAR)
