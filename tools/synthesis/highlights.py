"""The GGX lobe of shading points, integrated in two parts that add up to the whole.

Visible-normal samples see the smooth light and, where they are blocked, the diffuse radiosity of what they hit; light
samples see the lamps. Neither part has a narrow peak that the other's samples would miss. Wet surfaces are smoother
than lamps are small: there visible-normal samples see the lamps as well.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from shared.rendering import brdf
from tools.synthesis.light import EnvironmentLight, LampSphere
from tools.synthesis.sampling import shifted_hammersley, tangent_frame, visible_ggx_normal
from tools.synthesis.surface import ShadingPoints, SyntheticSurface, nearest_texel

SAMPLE_SETS = 64


@dataclass(frozen=True)
class LobeSamples:
    """Random sets that points pick from: lobe [sets, K, 2] in the unit square; lamp directions in head space and
    weights [sets, K, 3]; lamps_at: where near lamps stand in head space, None: they are far."""

    lobe: np.ndarray
    lamp_directions: np.ndarray
    lamp_weights: np.ndarray
    lamps_at: LampSphere | None = None

    @staticmethod
    def draw(light: EnvironmentLight, world_from_head: np.ndarray, lobe_count: int, lamp_count: int,
             rng: np.random.Generator, lamps_at: LampSphere | None = None) -> LobeSamples:
        """Well spread samples for one shot."""
        lobe = shifted_hammersley(lobe_count, SAMPLE_SETS, rng).astype(np.float32)
        lamps = shifted_hammersley(lamp_count, SAMPLE_SETS, rng)
        world, weights = light.sample_lamps(lamps.reshape(-1, 2))
        shape = (SAMPLE_SETS, lamp_count, 3)
        directions = (world @ world_from_head).reshape(shape).astype(np.float32)
        return LobeSamples(lobe, directions, weights.reshape(shape).astype(np.float32), lamps_at)

    def of_lamps(self, points: np.ndarray, choice: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Directions and weights [N, K, 3] at points [N, 3], of the set of each, choice [N]."""
        directions, weights = self.lamp_directions[choice], self.lamp_weights[choice]
        if self.lamps_at is None:
            return directions, weights
        directions, gain = self.lamps_at.seen_from(points, directions)
        return directions, weights * gain[..., None]

    def part(self, index: int, count: int) -> LobeSamples:
        """Every count-th sample from `index` on: one stratum of each set."""
        every = slice(index, None, count)
        return LobeSamples(self.lobe[:, every], self.lamp_directions[:, every], self.lamp_weights[:, every],
                           self.lamps_at)


def specular_radiance(surface: SyntheticSurface, light: EnvironmentLight, irradiance: np.ndarray,
                      world_from_head: np.ndarray,
                      points: ShadingPoints, outgoing: np.ndarray, roughness: np.ndarray, samples: LobeSamples,
                      choice: np.ndarray) -> np.ndarray:
    """[N, 3] radiance that the lobe at specular_intensity 1 sends towards `outgoing` [N, 3].

    irradiance [size, size, 3] of the shot lights what the lobe sees of the head itself; choice [N]: set of each point.
    """
    def smooth_radiance(_: np.ndarray, towards: np.ndarray) -> np.ndarray:
        return light.smooth_radiance(towards @ world_from_head.T.astype(np.float32))

    smooth = _sampled_lobe(surface, smooth_radiance, irradiance, points, outgoing, roughness, samples.lobe[choice])
    lamps = _lamp_part(surface, points, outgoing, roughness, *samples.of_lamps(points.position, choice))
    return smooth + lamps


def mirrored_radiance(surface: SyntheticSurface, light: EnvironmentLight, irradiance: np.ndarray,
                      world_from_head: np.ndarray, points: ShadingPoints, outgoing: np.ndarray, roughness: np.ndarray,
                      samples: LobeSamples, choice: np.ndarray) -> np.ndarray:
    """As specular_radiance, of surfaces that are nearly mirrors: roughness 0.1 or less."""
    def radiance(origins: np.ndarray, towards: np.ndarray) -> np.ndarray:
        met = towards if samples.lamps_at is None else samples.lamps_at.met_by(origins, towards).astype(np.float32)
        turn = world_from_head.T.astype(np.float32)
        return light.smooth_radiance(towards @ turn) + light.lamp_radiance(met @ turn)

    return _sampled_lobe(surface, radiance, irradiance, points, outgoing, roughness, samples.lobe[choice])


def _sampled_lobe(surface: SyntheticSurface, radiance: Callable[[np.ndarray, np.ndarray], np.ndarray],
                  irradiance: np.ndarray, points: ShadingPoints, outgoing: np.ndarray, roughness: np.ndarray,
                  squares: np.ndarray) -> np.ndarray:
    """Visible-normal sampling: each sample's weight is F G1(i), the rest of the lobe cancels against its density.

    radiance: of the light, from origins [N, 3] mm along directions [N, 3] in head space."""
    directions, weight = sample_lobe(points.normal, outgoing, roughness, squares)
    row, column = np.nonzero((weight > 0) & (np.einsum("nkc,nc->nk", directions, points.geometric_normal) > 0))
    towards = directions[row, column]
    index, uv, free = surface.hits(points.origins[row], towards)
    incident = np.zeros_like(towards)
    incident[free] = radiance(points.origins[row[free]], towards[free])
    incident[index] = _radiosity(surface, irradiance, uv)
    total = np.zeros(directions.shape, np.float32)
    total[row, column] = incident * weight[row, column, None]
    return total.mean(1)


def sample_lobe(normal: np.ndarray, outgoing: np.ndarray, roughness: np.ndarray,
                squares: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Incoming directions [N, K, 3] for points [N, K, 2] of the unit square and weights f cos_i / density [N, K].

    normal, outgoing [N, 3]; roughness [N]; specular intensity 1. Weight 0 marks directions below the horizon.
    """
    first, second = tangent_frame(normal)
    frame = np.stack([first, second, normal], 1)
    local = np.einsum("nij,nj->ni", frame, outgoing)
    local[:, 2] = np.maximum(local[:, 2], brdf.MINIMUM_COSINE)
    local = np.broadcast_to(local[:, None], (*squares.shape[:2], 3))
    alpha = np.broadcast_to((roughness * roughness)[:, None], squares.shape[:2])
    half = visible_ggx_normal(local, alpha, squares)
    o_dot_h = (local * half).sum(-1)
    incoming = 2.0 * o_dot_h[..., None] * half - local
    cosine = incoming[..., 2]
    masking = brdf.smith_masking(np.maximum(cosine, brdf.MINIMUM_COSINE), roughness[:, None])
    weight = np.where(cosine > 0, brdf.schlick_fresnel(np.clip(o_dot_h, 0.0, 1.0)) * masking, 0.0)
    return np.einsum("nkj,nji->nki", incoming, frame), weight.astype(np.float32)


def _lamp_part(surface: SyntheticSurface, points: ShadingPoints, outgoing: np.ndarray, roughness: np.ndarray,
               directions: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Light sampling: the lobe's value towards each lamp sample [N, K, 3], times its weight."""
    cosine_out = (points.normal * outgoing).sum(1)[:, None]
    cosine_in = np.einsum("nkc,nc->nk", directions, points.normal)
    between = np.einsum("nkc,nc->nk", directions, outgoing)
    lobe = brdf.specular_cosine(cosine_out, cosine_in, between, roughness[:, None])
    above = np.einsum("nkc,nc->nk", directions, points.geometric_normal) > 0
    row, column = np.nonzero((lobe > 1e-6) & above & (weights.sum(-1) > 0))
    blocked = surface.scene.occluded(points.origins[row], directions[row, column])
    lobe = np.where(above, lobe, 0.0)
    lobe[row[blocked], column[blocked]] = 0.0
    return np.einsum("nk,nkc->nc", lobe, weights) / directions.shape[1]


def _radiosity(surface: SyntheticSurface, irradiance: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """[N, 2] -> [N, 3] radiance that the surface itself sends out diffusely."""
    size = irradiance.shape[0]
    return surface.albedo(uv) * irradiance.reshape(-1, 3)[nearest_texel(uv, size)] / np.float32(np.pi)
