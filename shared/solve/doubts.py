"""What the fitted model shows to be wrong with the clip: signs of causes that none of its parameters can follow.

Each sign is a number that is small when a still light shines on a rigid head and the codes mean what they are said to
mean:
- frame_gain, frame_tint: deviation of the logarithm by which whole frames are brighter, or redder against bluer, than
  the model: exposure or white balance drifts;
- albedo_by_orientation: deviation of the part of the skin's log albedo that follows the surface's normals. A lamp on
  the head shades each point alike in every frame, and so ends up in the albedo;
- unlikely_colour: by how many deviations skin and light together leave the priors on the colours of both.
"""

from __future__ import annotations

import numpy as np
import torch

from shared.color import LUMINANCE
from shared.mesh import normalised
from shared.solve.appearance import AppearanceSolver
from shared.solve.scale import scale_prior

WANDERING_GAIN, WANDERING_TINT = 0.03, 0.04
"""Clips with everything locked have 0.003 to 0.006 and 0.003 to 0.011, one under a single hard lamp 0.017 and 0.032."""
ORIENTED_ALBEDO, UNLIKELY_COLOUR = 0.3, 3.0
"""Good clips have 0.02 to 0.2 and 0.5 to 1.4; a third of the light moving along gives 0.3 to 0.5."""
POINTS = 500
LEAST_MODEL = 0.01
"""Linear radiance below which a ratio to it is noise."""


def signs_of(solver: AppearanceSolver) -> dict[str, float]:
    """{"frame_gain", "frame_tint", "albedo_by_orientation", "unlikely_colour"} of a solver at its solution, baked."""
    capture = solver.capture
    part = solver.subset(slice(None, None, -(-len(capture.points) // POINTS)))
    if solver.settings.specular:
        part.bake_lobes()
    gains = frame_gains(part, part.model(*part.forward(part.state.light)))
    weight = part.trust * torch.from_numpy(part.capture.skin.astype(np.float32))[None, :, None]
    radiance = ((weight * part.colours).sum((1, 2)) / weight.sum()).double().numpy()
    skin = capture.skin
    signs = {
        "frame_gain": gains.mean(1).std(),
        "frame_tint": (gains[:, 0] - gains[:, 2]).std(),
        "albedo_by_orientation": by_orientation(solver.state.albedo[skin], capture.points.normals[skin]),
        "unlikely_colour": unlikely_colour(radiance, solver.settings.white_sigma),
    }
    return {name: round(float(value), 4) for name, value in signs.items()}


def doubts_about(signs: dict[str, float]) -> list[str]:
    """What a person should know, from signs_of."""
    found = []
    if signs["frame_gain"] > WANDERING_GAIN:
        found.append(f"the face's brightness wanders by {signs['frame_gain']:.0%} from frame to frame, more than its "
                     "turn explains: lock the exposure and keep the light still")
    if signs["frame_tint"] > WANDERING_TINT:
        found.append(f"the face's colour wanders by {signs['frame_tint']:.0%} from frame to frame: lock the white "
                     "balance and keep the light still")
    if signs["albedo_by_orientation"] > ORIENTED_ALBEDO:
        found.append(f"the skin's albedo follows the surface's orientation by {signs['albedo_by_orientation']:.0%}: "
                     "part of the light moves with the head, or the clip does not tell light from skin")
    if signs["unlikely_colour"] > UNLIKELY_COLOUR:
        found.append(f"skin and light together have an unlikely colour ({signs['unlikely_colour']:.1f} deviations): "
                     "coloured light, a filter, or a colour.transfer that is not the camera's")
    return found


def frame_gains(solver: AppearanceSolver, model: torch.Tensor) -> np.ndarray:
    """[F, 3] median logarithm of the samples over the model [3, P, F]; 0 where a frame shows nothing."""
    used = (solver.limits == 0) & (solver.trust > 0) & (model > LEAST_MODEL) & (solver.colours > LEAST_MODEL)
    ratio = torch.log(solver.colours.clamp_min(1e-6) / model.clamp_min(1e-6))
    ratio = torch.where(used, ratio, torch.full_like(ratio, torch.nan))
    return ratio.nanmedian(dim=1).values.nan_to_num().T.double().numpy()


def by_orientation(albedo: np.ndarray, normals: np.ndarray) -> float:
    """Standard deviation of the part of log luminance of albedo [P, 3] that quadratics in the normals [P, 3] explain.

    Quadratics hold nearly all that a lamp does to a matte surface (Ramamoorthi and Hanrahan, An Efficient
    Representation for Irradiance Environment Maps, SIGGRAPH 2001).
    """
    x, y, z = normalised(normals).T
    design = np.stack([np.ones_like(x), x, y, z, x * y, y * z, x * z, x * x - y * y, 3 * z * z - 1], axis=1)
    brightness = np.log(np.maximum(albedo @ LUMINANCE, 1e-3))
    return float((design @ np.linalg.lstsq(design, brightness, rcond=None)[0]).std())


def unlikely_colour(radiance: np.ndarray, white_sigma: float) -> float:
    """Root of what is left of the priors' squared residuals for skin of mean radiance [3] under the best light."""
    matrix, right = scale_prior(np.log(np.maximum(radiance, 1e-6)), white_sigma)
    return float(np.linalg.norm(matrix @ np.linalg.lstsq(matrix, right, rcond=None)[0] - right))
