"""The parameters of inverse_render as its solvers' settings."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from shared.appearance.light import LightPriors
from shared.appearance.light_tint import LightTint
from shared.appearance.measured_skin import SURFACE_SPREAD
from shared.appearance.problem import AppearanceSettings
from shared.appearance.skin_prior import SkinVariation
from shared.contract.job import Parameters
from shared.contract.wording import unknown_name
from shared.errors import InputError
from shared.inverse.lamp_distance import NEAREST_MM
from shared.inverse.problem import InverseSettings
from shared.published.settings import ReferenceSettings, Weights
from shared.published.shading import Sampling
from shared.rendering.near_lamp import FAR
from shared.rendering.precomputed_transfer import Sizes
from shared.selection.candidates import PARTS
from shared.shape.gauss_newton import ShapeSettings

LAMP_DISTANCES = {"auto": None, "far": FAR}


def read_settings(
    params: Parameters, checkpoint: Path | None = None, tints: tuple[LightTint | None, ...] = ()
) -> InverseSettings:
    """All settings; checkpoint: the reference solver's own file, or None; tints: what grey places say of each light.
    InputError for what cannot go together."""
    appearance = AppearanceSettings(
        light_model=params.light_model,
        resolutions=tuple(n for n in (8, 16, 32) if n <= params.light_resolution) or (params.light_resolution,),
        steps=params.light_steps,
        independent=params.independent_samples,
        priors=LightPriors(smooth=params.light_smoothness),
        white_sigma=params.light_colour_sigma,
        tints=tints,
        skin=SkinVariation(params.skin_brightness_sigma, params.skin_colour_sigma),
        visibility=params.visibility,
        bounce=params.bounce,
        specular=params.specular,
        roughness=params.roughness,
        fit_roughness=params.fit_roughness,
        local_roughness=params.local_roughness,
        specular_prior=(params.specular_prior, SURFACE_SPREAD),
        coarse_points=params.coarse_points,
    )
    contour = {} if params.silhouette else {"contour": None}
    shape = ShapeSettings(
        subdivisions=params.shape_subdivisions,
        rounds=params.shape_steps,
        frames=params.shape_frames,
        smoothness=params.shape_smoothness,
        sigma_mm=params.shape_sigma,
        **contour,
    )
    return InverseSettings(
        sizes=Sizes(params.points, params.directions, params.bounce_nodes),
        appearance=appearance,
        light_frames=params.light_frames,
        map_size=params.map_size,
        hold_out_every=params.hold_out_every,
        shape=shape if params.shape else None,
        fit_frames=params.fit_frames,
        normal_map=params.normal_map,
        pose_rounds=params.pose_rounds,
        lamp_distance=read_lamp_distance(params.lamp_distance),
        smooth_rim=not params.mesh,
        reference=read_reference(params, checkpoint) if params.solver == "reference" else None,
        selection=read_forced(params.fixed_parts) if params.model == "auto" else None,
    )


def read_lamp_distance(text: str) -> float | None:
    """mm, or FAR; None: to be solved. InputError for anything else."""
    if text in LAMP_DISTANCES:
        return LAMP_DISTANCES[text]
    try:
        distance = float(text)
    except ValueError:
        distance = 0.0
    if not NEAREST_MM <= distance < np.inf:
        raise InputError("no distance of a lamp", where="--set inverse_render.lamp_distance", got=text,
                         expected=f"{', '.join(LAMP_DISTANCES)} or {NEAREST_MM:g} mm or more")
    return distance


def read_forced(text: str) -> frozenset[str]:
    """Parts of the model that are not chosen; InputError for one that there is not."""
    forced = frozenset(filter(None, (name.strip() for name in text.split(","))))
    for name in sorted(forced.difference(PARTS)):
        raise unknown_name("part of the model", name, PARTS, "--set inverse_render.fixed_parts")
    return forced


def read_reference(params: Parameters, checkpoint: Path | None = None) -> ReferenceSettings:
    """The reference solver's settings."""
    prefix, given = "reference_", params.as_dict()
    own = {name.removeprefix(prefix): value for name, value in given.items() if name.startswith(prefix)}
    samples = {name: own.pop(f"{name}_samples") for name in ("light", "cosine", "lobe")}
    weights = {name: own.pop(name) for name in ("mask", "laplacian", "white_light", "roughness_variation", "diffuse")}
    return ReferenceSettings(
        sampling=Sampling(**samples, visibility=params.visibility, specular=params.specular),
        weights=Weights(**weights),
        resolution=own.pop("light_resolution"),
        roughness=params.roughness,
        light_model=params.light_model,
        checkpoint=checkpoint,
        **own,
    )
