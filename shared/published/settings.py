"""The reference solver's numbers, at the published values."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from shared.published.shading import Sampling


@dataclass(frozen=True)
class Weights:
    """Of the losses, beside an L1 image loss of weight 1."""

    mask: float = 0.1
    laplacian: float = 10.0
    white_light: float = 0.1
    roughness_variation: float = 0.1
    diffuse: float = 0.01


@dataclass(frozen=True)
class ReferenceSettings:
    """iterations, one frame each; pixels: of the frame, drawn anew each time, 0: all; resolution, smallest: edges of
    the light's first and last mip; rates: Adam's for vertices (mm), light and textures; smoothing: lambda of the large
    steps; vertices: whether they move; light_model: see light_models, cubemap: each texel's radiance by itself;
    checkpoint: file to go on from, written every checkpoint_every iterations, or None."""

    iterations: int = 6000
    pixels: int = 0
    sampling: Sampling = field(default_factory=Sampling)
    weights: Weights = field(default_factory=Weights)
    resolution: int = 256
    smallest: int = 8
    vertex_rate: float = 0.1
    light_rate: float = 0.1
    texture_rate: float = 0.001
    smoothing: float = 19.0
    vertices: bool = True
    roughness: float = 0.45
    light_model: str = "cubemap"
    seed: int = 0
    checkpoint: Path | None = None
    checkpoint_every: int = 100
