"""Shading of pixels as published: diffuse light by multiple importance sampling, highlights by the split sum.

    diffuse   albedo sum_i V_i L_i cos_i / (pi (m p_light + n p_cosine))   m light, n cosine samples, balance heuristic
    specular  specular_intensity [F0 A(n.o, r) + B(n.o, r)] V~ L_prefiltered(reflected, r)

with visibility V by a ray of each sample and V~ the mean visibility of 64 directions sampled from the lobe's D. No
light bounces. Gradients reach light, albedo, specular intensity, roughness, and through positions and normals the
vertices; visibility and the samples themselves count as constant, as published.

References: [Xu2025]; [Veach1995] (balance heuristic); [Karis2013] (split sum).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from shared.geometry.raycast import RAY_START_MM, RayScene
from shared.published.light import CubeSampler, LightSampling, PrefilteredLight, split_sum_energy
from shared.published.raster import SurfacePoints
from shared.rendering.brdf import F0

_PIXELS_AT_ONCE = 4000


@dataclass(frozen=True)
class Sampling:
    """light, cosine: samples of the diffuse integral per pixel; lobe: of V~; visibility off: nothing is in the way, and
    the diffuse integral is that of a prefiltered map (no samples); specular off: matte."""

    light: int = 256
    cosine: int = 256
    lobe: int = 64
    visibility: bool = True
    specular: bool = True


@dataclass(frozen=True)
class TorchMaterial:
    """What the surface is made of at P pixels: albedo [P, 3], specular_intensity [P], roughness [P]."""

    albedo: torch.Tensor
    specular_intensity: torch.Tensor
    roughness: torch.Tensor


def tangent_frames(axis: torch.Tensor) -> torch.Tensor:
    """shared.rendering.split_sum.frames_about in torch: [P, 3] -> [P, 3, 3], rows two tangents and the axis."""
    x, y, z = axis.unbind(1)
    sign = torch.where(z >= 0.0, 1.0, -1.0).to(axis.dtype)
    a = -1.0 / (sign + z)
    b = x * y * a
    first = torch.stack([1.0 + sign * x * x * a, sign * b, -sign * x], dim=1)
    second = torch.stack([b, sign + y * y * a, -y], dim=1)
    return torch.stack([first, second, axis], dim=1)


class Shader:
    """Shades pixels of one light resolution. generator: of all random numbers, on the CPU."""

    def __init__(self, resolution: int, sampling: Sampling, smallest: int = 8, dtype=torch.float32):
        self.sampling, self.dtype = sampling, dtype
        self.prefiltered = PrefilteredLight(resolution, smallest, dtype)
        self._lookup = CubeSampler(resolution)

    def __call__(
        self,
        light: torch.Tensor,
        points: SurfacePoints,
        texture: TorchMaterial,
        scene: RayScene,
        world_from_head: np.ndarray,
        generator: torch.Generator,
        importance: torch.Tensor | None = None,
    ) -> torch.Tensor:
        """Linear radiance [P, 3] of pixels whose head stands in the light by world_from_head [3, 3].

        importance: the light [6 n^2, 3] whose brightness directs the samples; the light itself when None.
        """
        turn = torch.from_numpy(np.ascontiguousarray(world_from_head)).to(self.dtype)
        normal, towards = points.normal @ turn.T, points.towards @ turn.T
        levels = self.prefiltered.mips(light)
        if self.sampling.visibility:
            sampler = LightSampling(light if importance is None else importance)
            parts = [
                self._diffuse(light, sampler, normal[part], points.position[part], scene, turn, generator)
                for part in _blocks(len(normal))
            ]
            irradiance = torch.cat(parts) if parts else normal.new_zeros((0, 3))
        else:
            irradiance = self.prefiltered.irradiance(levels, normal)
        radiance = texture.albedo * irradiance
        if not self.sampling.specular:
            return radiance
        cosine = (normal * towards).sum(1)
        reflected = torch.nn.functional.normalize(2.0 * cosine[:, None] * normal - towards, dim=1)
        lobe = split_sum_energy(cosine, texture.roughness, F0) * texture.specular_intensity
        if self.sampling.visibility:
            lobe = lobe * self.visible_share(
                normal, towards, texture.roughness, points.position, scene, turn, generator
            )
        return radiance + lobe[:, None] * self.prefiltered.reflection(levels, reflected, texture.roughness)

    def _random(self, shape: tuple[int, ...], generator: torch.Generator) -> torch.Tensor:
        return torch.rand(shape, generator=generator, dtype=self.dtype)

    def _strata(self, pixels: int, count: int, generator: torch.Generator) -> torch.Tensor:
        """[pixels, count] one random number in each of count equal parts of 0 .. 1."""
        steps = torch.arange(count, dtype=self.dtype)
        return ((steps + self._random((pixels, count), generator)) / count).clamp_max(1.0 - 1e-6)

    def _diffuse(self, light, sampler: LightSampling, normal, position, scene, turn, generator) -> torch.Tensor:
        """Irradiance over pi [P, 3]; normal in the light's space, position in the head's."""
        pixels, total = len(normal), self.sampling.light + self.sampling.cosine
        with torch.no_grad():
            towards_light = torch.stack(
                [
                    self._strata(pixels, self.sampling.light, generator),
                    *self._random((2, pixels, self.sampling.light), generator),
                ],
                dim=-1,
            )
            sampled = sampler.sample(towards_light.reshape(-1, 3)).reshape(pixels, -1, 3)
            hemisphere = _cosine_directions(
                self._strata(pixels, self.sampling.cosine, generator),
                self._random((pixels, self.sampling.cosine), generator),
            )
            about = torch.einsum("psi,pij->psj", hemisphere, tangent_frames(normal.detach()))
            directions = torch.cat([sampled, about], dim=1)
            cosine = torch.einsum("psj,pj->ps", directions, normal.detach())
            density = self.sampling.light * sampler.density(directions.reshape(-1, 3)).reshape(pixels, total)
            density = density + self.sampling.cosine * cosine.clamp_min(0.0) / np.pi
            seen = self._open(position, normal, directions, cosine > 0.0, scene, turn)
            weight = torch.where(seen, 1.0 / (np.pi * density.clamp_min(1e-12)), torch.zeros_like(density))
            kept = weight.reshape(-1) > 0
        factor = weight * torch.einsum("psj,pj->ps", directions, normal).clamp_min(0.0)
        radiance = self._lookup.fixed(light, directions.reshape(-1, 3)[kept])
        pixel = torch.arange(pixels).repeat_interleave(total)[kept]
        return normal.new_zeros((pixels, 3)).index_add(0, pixel, factor.reshape(-1)[kept][:, None] * radiance)

    def _open(self, position, normal, directions, wanted, scene: RayScene, turn) -> torch.Tensor:
        """[P, S] bool: directions [P, S, 3] of the light's space, where wanted, that meet nothing. Rays on the CPU."""
        pixel, sample = torch.nonzero(wanted, as_tuple=True)
        offset = (position + RAY_START_MM * (normal @ turn)).detach()
        rays = (directions[pixel, sample] @ turn).detach()
        hidden = scene.occluded(offset[pixel].cpu().numpy(), rays.cpu().numpy())
        result = torch.zeros(wanted.shape, dtype=torch.bool)
        result[pixel, sample] = torch.from_numpy(~hidden)
        return result

    @torch.no_grad()
    def visible_share(self, normal, towards, roughness, position, scene: RayScene, turn, generator) -> torch.Tensor:
        """V~ [P]: of directions sampled from D about the normal, those above the horizon that meet nothing.

        1 for a point that nothing covers at every roughness; 0 or 1 for a mirror; the open share of the sky when rough.
        """
        pixels, count = len(normal), self.sampling.lobe
        u = self._strata(pixels, count, generator)
        cosine = ((1.0 - u) / (1.0 + (roughness[:, None] ** 4 - 1.0) * u)).clamp(0.0, 1.0).sqrt()
        sine = (1.0 - cosine * cosine).clamp_min(0.0).sqrt()
        azimuth = 2.0 * np.pi * self._random((pixels, count), generator)
        half = torch.stack([sine * azimuth.cos(), sine * azimuth.sin(), cosine], dim=-1)
        half = torch.einsum("psi,pij->psj", half, tangent_frames(normal))
        o_dot_h = torch.einsum("psj,pj->ps", half, towards)
        incoming = 2.0 * o_dot_h[..., None] * half - towards[:, None]
        above = (torch.einsum("psj,pj->ps", incoming, normal) > 0.0) & (o_dot_h > 0.0)
        seen = self._open(position, normal, incoming, above, scene, turn)
        return seen.sum(1).to(self.dtype) / above.sum(1).clamp_min(1).to(self.dtype)


def _blocks(count: int) -> list[slice]:
    return [slice(start, min(start + _PIXELS_AT_ONCE, count)) for start in range(0, count, _PIXELS_AT_ONCE)]


def _cosine_directions(first: torch.Tensor, second: torch.Tensor) -> torch.Tensor:
    """[..., 3] about +z, density cos / pi (Malley)."""
    radius, azimuth = first.sqrt(), 2.0 * np.pi * second
    return torch.stack([radius * azimuth.cos(), radius * azimuth.sin(), (1.0 - first).clamp_min(0.0).sqrt()], dim=-1)
