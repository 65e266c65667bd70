"""What the fitted model shows to be wrong with the clip: diagnostics of causes that none of its parameters can follow.

Each diagnostic is a number that is small when a still light shines on a rigid head and the codes mean what they are
said to mean:
- frame_gain, frame_tint: deviation of the logarithm by which whole frames are brighter, or redder against bluer, than
  the model: exposure or white balance drifts;
- albedo_by_orientation: deviation of the part of the skin's log albedo that follows the surface's normals. A lamp on
  the head shades each point alike in every frame, and so ends up in the albedo;
- unlikely_colour: by how many deviations skin and light together leave the priors on the colours of both;
- covered_eyes, covered_forehead: share of the points there that fit far worse than the face does: what stands off the
  skin, as glasses and strands of hair do, moves and shades otherwise than the surface that it is taken for.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from scipy.spatial import cKDTree

from shared.appearance.albedo_scale import scale_prior
from shared.appearance.light_tint import LightTint
from shared.appearance.problem import AppearanceProblem, AppearanceState
from shared.appearance.sample_errors import SampleErrors
from shared.compute.robust import ROBUST_SCALE
from shared.geometry.mesh import Mesh, normalised, segments_at
from shared.imaging.color import LUMINANCE

WANDERING_GAIN, WANDERING_TINT = 0.03, 0.04
"""Clips with everything locked have 0.003 to 0.006 and 0.003 to 0.011, one under a single hard lamp 0.017 and 0.032."""
ORIENTED_ALBEDO, UNLIKELY_COLOUR = 0.3, 3.0
"""Good clips have 0.03 to 0.26 and 0.5 to 1.4; a third of the light moving along gives 0.3 to 0.5."""
BIWEIGHT_REACH, ROBUST_ROUNDS, SKIN_SPREAD = 4.685 * ROBUST_SCALE, 12, (0.02, 0.1)
"""Of the logarithm of a person's skin: median deviations that are possible; more is hair, or light in the albedo."""
COVERED, FAR_WORSE = 0.35, 3.0
"""Share of a region's points, and how many times worse than the face's median they fit: 0 to 0.1 without anything
before the skin (0.3 where a lamp moves with the head), 0.4 with glasses, 0.5 with a fringe."""
NEAR_EYES_MM, FEWEST_POINTS = 30.0, 20
POINTS = 500
LEAST_MODEL = 0.01
"""Linear radiance below which a ratio to it is noise."""


def face_regions(
    mesh: Mesh, face_segment: np.ndarray | None, segment_names: tuple[str, ...], positions: np.ndarray
) -> dict[str, np.ndarray]:
    """{"eyes", "forehead"} -> [P] bool: which points [P, 3] on the skin lie around the eyes, and on the forehead.
    face_segment [F] int; positions [P, 3] mm."""
    if face_segment is None or "eyes" not in segment_names:
        return {}
    eyes = mesh.vertices[mesh.faces[face_segment == segment_names.index("eyes")].ravel()]
    forehead = segments_at(mesh, face_segment, positions) == segment_names.index("forehead")
    return {"eyes": (cKDTree(eyes).query(positions)[0] < NEAR_EYES_MM) & ~forehead, "forehead": forehead}


def diagnostics_of(
    problem: AppearanceProblem, state: AppearanceState, regions: Mapping[str, np.ndarray] | None = None
) -> dict[str, float]:
    """The diagnostics by name of a problem at a solved state; regions [P] bool by name: see face_regions."""
    capture, settings = problem.capture, problem.settings
    some = slice(None, None, -(-len(capture.points) // POINTS))
    part = problem.take(some)
    seen = replace(state, albedo=state.albedo[some])
    model = seen.radiance(*part.transport(seen).forward(seen.light))
    gains, residual = frame_gains(part.errors, model), normalised_residuals(part.errors, model)
    weight = part.skin_weight
    radiance = ((weight * part.errors.colours).sum((1, 2)) / weight.sum()).double().numpy()
    relative = np.log(part.skin_radiance()[1]) if settings.tints else None
    skin = capture.skin
    diagnostics = {
        "frame_gain": gains.mean(1).std(),
        "frame_tint": (gains[:, 0] - gains[:, 2]).std(),
        "albedo_by_orientation": by_orientation(state.albedo[skin], capture.points.normals[skin]),
        "unlikely_colour": unlikely_colour(radiance, settings.white_sigma, relative, settings.tints),
        **{f"covered_{name}": covered_share(residual, region[some]) for name, region in (regions or {}).items()},
    }
    return {name: round(float(value), 4) for name, value in diagnostics.items()}


def diagnostic_warnings(measured: dict[str, float], moves: str = "head") -> list[str]:
    """What a person should know, measured: see diagnostics_of; moves: the head or the camera."""
    found = []
    if measured["frame_gain"] > WANDERING_GAIN:
        found.append(f"the face's brightness wanders by {measured['frame_gain']:.0%} from frame to frame, more than "
                     "its turn explains: lock the exposure and keep the light still")
    if measured["frame_tint"] > WANDERING_TINT:
        found.append(f"the face's colour wanders by {measured['frame_tint']:.0%} from frame to frame: lock the white "
                     "balance and keep the light still")
    if measured["albedo_by_orientation"] > ORIENTED_ALBEDO:
        found.append(f"the skin's albedo follows the surface's orientation by {measured['albedo_by_orientation']:.0%}: "
                     + "part of the light moves with the head, or " * (moves == "head")
                     + "the clip does not tell light from skin")
    if measured["unlikely_colour"] > UNLIKELY_COLOUR:
        found.append(f"skin and light together have an unlikely colour ({measured['unlikely_colour']:.1f} deviations): "
                     "coloured light, a filter, or a colour.transfer that is not the camera's")
    for name, words in (("covered_eyes", "around the eyes"), ("covered_forehead", "of the forehead")):
        if measured.get(name, 0.0) > COVERED:
            found.append(f"{measured[name]:.0%} of the skin {words} fits far worse than the face does: glasses, hair "
                         "or something else in front of it, which the maps show as skin")
    return found


def normalised_residuals(errors: SampleErrors, model: torch.Tensor) -> np.ndarray:
    """[P] mean absolute residual of the model [3, P, F] over the assumed noise."""
    error, inactive = errors.errors(model)
    total = (errors.view_weight * (~inactive) * error.sqrt()).sum((0, 2))
    return (total / (3.0 * errors.view_weight.sum((0, 2))).clamp_min(1e-9)).double().numpy()


def covered_share(residual: np.ndarray, region: np.ndarray) -> float:
    """Share of a region's points [P] bool whose residual [P] is far above the median; 0 where the region has too few.
    """
    if region.sum() < FEWEST_POINTS:
        return 0.0
    return float((residual[region] > FAR_WORSE * np.median(residual)).mean())


def frame_gains(errors: SampleErrors, model: torch.Tensor) -> np.ndarray:
    """[F, 3] median logarithm of the samples over the model [3, P, F]; 0 where a frame shows nothing."""
    used = (errors.saturation == 0) & (errors.view_weight > 0) & (model > LEAST_MODEL) & (errors.colours > LEAST_MODEL)
    ratio = torch.log(errors.colours.clamp_min(1e-6) / model.clamp_min(1e-6))
    ratio = torch.where(used, ratio, torch.full_like(ratio, torch.nan))
    return ratio.nanmedian(dim=1).values.nan_to_num().T.double().numpy()


def by_orientation(albedo: np.ndarray, normals: np.ndarray) -> float:
    """Standard deviation of the part of log luminance of albedo [P, 3] that quadratics in the normals [P, 3] explain.

    Quadratics hold nearly all that a lamp does to a matte surface [Ramamoorthi2001]. Points far from the others count
    for nothing: hair over the forehead and a beard look up and down, too. Biweights, from the median on [Beaton1974].
    """
    x, y, z = normalised(normals).T
    design = np.stack([np.ones_like(x), x, y, z, x * y, y * z, x * z, x * x - y * y, 3 * z * z - 1], axis=1)
    brightness = np.log(np.maximum(albedo @ LUMINANCE, 1e-3))
    shaded = np.full(len(brightness), np.median(brightness))
    for _ in range(ROBUST_ROUNDS):
        off = brightness - shaded
        reach = BIWEIGHT_REACH * float(np.clip(np.median(np.abs(off)), *SKIN_SPREAD))
        weight = np.square(np.clip(1.0 - np.square(off / reach), 0.0, None))
        root = np.sqrt(weight)
        shaded = design @ np.linalg.lstsq(design * root[:, None], brightness * root, rcond=None)[0]
    mean = np.average(shaded, weights=weight)
    return float(np.sqrt(np.average(np.square(shaded - mean), weights=weight)))


def unlikely_colour(
    radiance: np.ndarray,
    white_sigma: float,
    relative_light: np.ndarray | None = None,
    tints: Sequence[LightTint | None] = (),
) -> float:
    """Root of what is left of the priors' squared residuals for skin of mean radiance [3] under the best light;
    relative_light [L, 3], tints: see scale_prior."""
    log_radiance = np.log(np.maximum(radiance, 1e-6))
    matrix, right = scale_prior(log_radiance, white_sigma, relative_light=relative_light, tints=tints)
    return float(np.linalg.norm(matrix @ np.linalg.lstsq(matrix, right, rcond=None)[0] - right))
