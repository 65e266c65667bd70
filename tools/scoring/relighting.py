"""Relights a solved head with our own renderer and compares it with a subject's path-traced truth under that light."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from shared.appearance.light_models import LogLight
from shared.inverse.problem import InverseResult, InverseSettings, shade_vertices
from shared.io.arrays import load_arrays
from shared.io.images import read_exr, read_png
from shared.rendering.envmap import cube_from_latlong
from shared.rendering.precomputed_transfer import precompute_transfer
from shared.rendering.render import SurfaceMaps, render_frame
from tools.scoring import measures
from tools.scoring.score import camera_intrinsics, score_geometry

RELIGHT_RESOLUTION, RELIGHT_DIRECTIONS = 16, 6 * 16**2
"""As many directions as texels, so that no lamp slips between them."""


class _RelitClip:
    """What shade_vertices reads: the cameras of the relit pictures, in the result's head space."""

    def __init__(self, poses: np.ndarray):
        self.camera_from_head, self.moves, self.light_index = poses, "head", np.zeros(len(poses), int)


def result_poses(truth_poses: np.ndarray, alignment) -> np.ndarray:
    """camera_from_head [F, 4, 4] of the truth -> of the result, in its unit; alignment: truth_from_result."""
    poses = truth_poses.copy()
    poses[:, :3, 3] = (truth_poses[:, :3, :3] @ alignment.translation + truth_poses[:, :3, 3]) / alignment.scale
    poses[:, :3, :3] = truth_poses[:, :3, :3] @ alignment.rotation
    return poses


def relight_errors(
    subject: Path, result: InverseResult, settings: InverseSettings, found_poses: np.ndarray, index: np.ndarray
) -> dict[str, dict]:
    """{light: measures.image_errors} on the face skin over the views of each unseen light.

    found_poses [F, 4, 4] of the source's frames index [F]. The lights are the true ones; only the head is ours.
    """
    viewer, rng = result.viewer, np.random.default_rng(0)
    truth = load_arrays(subject / "gt" / "poses.npz")["camera_from_head"][index]
    alignment, _ = score_geometry(subject, viewer.mesh, truth, found_poses, rng)
    views = load_arrays(subject / "relight" / "poses.npz")
    poses = result_poses(np.stack(list(views.values())), alignment)
    intrinsics = camera_intrinsics(subject)
    maps = SurfaceMaps(result.maps["diffuse_albedo"], result.maps["specular_intensity"])
    sizes = replace(settings.sizes, directions=RELIGHT_DIRECTIONS)
    precomputed = precompute_transfer(viewer, sizes, settings.appearance.visibility)
    scores = {}
    for path in sorted((subject / "relight").glob("*_envmap.exr")):
        name = path.name.removesuffix("_envmap.exr")
        light = np.maximum(cube_from_latlong(read_exr(path), RELIGHT_RESOLUTION), 1e-6)
        state = replace(
            result.solution.state, params=np.log(light.astype(np.float64)), light_model=LogLight(RELIGHT_RESOLUTION)
        )
        solution = replace(result.solution, state=state)
        clip = _RelitClip(poses)
        shading = shade_vertices(clip, settings.appearance, viewer, precomputed, solution, lambda items, label: items)
        pairs = []
        for f, view in enumerate(views):
            mask = read_png(subject / "relight" / f"{name}_{view}_mask.png") > 127
            image, _ = render_frame(viewer, shading, maps, f, poses[f], intrinsics, mask.shape[::-1])
            pairs.append((read_exr(subject / "relight" / f"{name}_{view}_radiance.exr")[mask], image[mask]))
        scores[name] = measures.image_errors(pairs)
    return scores
