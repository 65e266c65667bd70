"""How well a result's map of materials agrees with what the truth says is skin, hair, cloth and so on.

Intersection over union of each label, twice: of texels by their area on the result's surface, each with the label that
most of the truth's frames show there, weighted by the square of the view cosine; and of the pixels of these frames that
the result covers. Hair with a surface of its own hides what lies behind it, and its pixels are hair. Where either of
them is unknown nothing is compared; how much the result leaves open stands beside.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from shared.geometry.mesh import Mesh, normalised, vertex_normals
from shared.geometry.parts import mesh_part
from shared.geometry.raycast import RAY_START_MM, RayScene
from shared.geometry.transforms import camera_centres, project
from shared.hair.hair_files import read_hair
from shared.hair.joined import joined_mesh
from shared.imaging.image_sampling import MINIMUM_VIEW_COSINE, texel_size
from shared.imaging.material_labels import HAIR, LABELS, UNKNOWN
from shared.imaging.texels import TexelSurface
from shared.imaging.texture import sample_bilinear
from shared.io.images import read_png
from shared.io.material_maps import read_material
from tools.scoring.buffers import BufferRenderer

TEXELS = 512
"""Edge of the map on which texels are compared, at most."""


def label_scores(frames: Path, export: Path, mesh: Mesh, poses: dict[int, np.ndarray], intrinsics: np.ndarray) -> dict:
    """{texels: {label: IoU}, pixels: {label: IoU}, unknown: share of the texels that the result leaves open, covered:
    {label: share of the truth's pixels that the result covers}}; labels that neither has are left out.

    frames: the truth's folder of %04d_label.png; export: with maps/material.exr, and perhaps hair; mesh, poses {frame:
    camera_from_head [4, 4]} and intrinsics [3, 3] px are the result's.
    """
    truth = {frame: read_png(path) for frame, path in label_files(frames).items() if frame in poses}
    found = read_material(export / "maps" / "material.exr")
    texels = TexelSurface(mesh, min(TEXELS, len(found)))
    shown, labels = with_hair(mesh, found, export)
    votes = true_votes(texels, shown, truth, poses, intrinsics)
    step = len(found) // texels.size
    block = found.reshape(texels.size, step, texels.size, step, -1).mean((1, 3)).reshape(texels.size**2, -1)
    seen = votes.sum(1) > 0
    label, expected = block[texels.pixel][seen].argmax(1), votes[seen].argmax(1)
    area = np.square(texel_size(mesh, texels.size))[texels.face[seen]]
    pixels = pixel_labels(shown, labels, truth, poses, intrinsics)
    both = pixels[0] != UNKNOWN
    known = expected != UNKNOWN
    named = known & (label != UNKNOWN)
    all_true = np.concatenate([image.ravel() for image in truth.values()])
    there, covered = (np.bincount(values, minlength=len(LABELS)) for values in (all_true, pixels[1]))
    return {
        "texels": agreement(label[named], expected[named], area[named]),
        "pixels": agreement(pixels[0][both], pixels[1][both], np.ones(both.sum())),
        "unknown": float(area[known & (label == UNKNOWN)].sum() / max(area[known].sum(), 1e-12)),
        "covered": {name: float(covered[k] / there[k]) for k, name in enumerate(LABELS) if k != UNKNOWN and there[k]},
    }


def label_files(frames: Path) -> dict[int, Path]:
    """{frame: file} of the truth's labels; empty where it has none."""
    return {int(path.name[:4]): path for path in sorted(frames.glob("*_label.png"))}


def with_hair(head: Mesh, found: np.ndarray, export: Path) -> tuple[Mesh, np.ndarray]:
    """What a result shows, and its labels: the head with its map [S, S, len(LABELS)], and beside it hair with a surface
    of its own, of which more than half is there, [S, 2 S, len(LABELS)]."""
    hair = read_hair(export)
    if hair is None:
        return head, found
    there = sample_bilinear(hair.alpha, hair.mesh.uvs[hair.mesh.face_uvs].mean(1)).ravel() > 0.5
    beside = np.broadcast_to(np.eye(len(LABELS), dtype=found.dtype)[HAIR], found.shape)
    return joined_mesh(head, mesh_part(hair.mesh, there)[0]), np.concatenate([found, beside], axis=1)


def true_votes(texels: TexelSurface, shown: Mesh, truth: dict[int, np.ndarray], poses: dict[int, np.ndarray],
               intrinsics: np.ndarray) -> np.ndarray:
    """[T, len(LABELS)]: squared view cosines of the frames that show each label at a texel that nothing of what is
    shown hides; truth {frame: labels [H, W]}, poses {frame: [4, 4]}, intrinsics [3, 3] px."""
    mesh = texels.mesh
    scene = RayScene(shown.vertices, shown.faces)
    places = texels.interpolate(mesh.vertices)
    normals = normalised(texels.interpolate(vertex_normals(mesh.vertices, mesh.faces)))
    votes = np.zeros((len(texels), len(LABELS)))
    for frame, image in truth.items():
        towards = normalised(camera_centres(poses[frame]) - places).astype(np.float32)
        cosine = (towards * normals).sum(1)
        column, row = np.floor(project(places, poses[frame], intrinsics)[0]).astype(int).T
        inside = (column >= 0) & (row >= 0) & (column < image.shape[1]) & (row < image.shape[0])
        rows = np.nonzero(inside & (cosine > MINIMUM_VIEW_COSINE))[0]
        rows = rows[~scene.occluded(places[rows] + RAY_START_MM * normals[rows], towards[rows])]
        votes[rows, image[row[rows], column[rows]]] += cosine[rows] ** 2
    return votes


def pixel_labels(mesh: Mesh, found: np.ndarray, truth: dict[int, np.ndarray], poses: dict[int, np.ndarray],
                 intrinsics: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Labels [N] of the result and of the truth, of all pixels that the mesh covers and where the truth is known; found
    [S, ..., len(LABELS)]: the mesh's map; the others as of true_votes."""
    viewer, pairs = BufferRenderer(mesh, {"material": found}), []
    for frame, image in truth.items():
        row, column = np.nonzero(image != UNKNOWN)
        seen = viewer.view(poses[frame], intrinsics, np.stack([column, row], 1))
        hit = seen["coverage"] > 0.5
        pairs.append((seen["material"][hit].argmax(1), image[row[hit], column[hit]]))
    result, expected = (np.concatenate(side) for side in zip(*pairs, strict=True))
    return result, expected


def agreement(found: np.ndarray, truth: np.ndarray, weight: np.ndarray) -> dict[str, float]:
    """{label: intersection over union} of labels found and true [N] of some weight [N]; what neither has is left out.
    """
    scores = {}
    for k, name in enumerate(LABELS):
        either = weight[(found == k) | (truth == k)].sum()
        if k != UNKNOWN and either > 0:
            scores[name] = float(weight[(found == k) & (truth == k)].sum() / either)
    return scores
