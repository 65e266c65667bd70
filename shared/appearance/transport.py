"""From a light to what the points show: linear operators with their adjoints, for the bounces and lobes of one state.

Irradiance E = T l, with T the transfer with all diffuse bounces; reflection S = R l + b (E - D l): the lobes' open part
sees the light, their blocked part the mean indirect light of what stands before the point. l is the light along the
directions in each frame, itself linear in the texels (FrameLight). Tensors are channel first: [3, P, F]. Of a lamp that
stands near each point sees texels of its own (LampTransfer), beside those directions.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch

from shared.appearance.light import FrameLight
from shared.appearance.products import per_channel, per_channel_transposed, reflect, reflect_transposed
from shared.rendering.lobes import SpecularTransfer
from shared.rendering.near_lamp import LampView
from shared.rendering.specular_transfer import LOG_STEP, specular_slopes, specular_tables
from shared.rendering.transfer import Points


@dataclass(frozen=True, eq=False)
class Lobes:
    """The lobes of all points in all frames at a roughness, one or each point's own [P].

    table: of the points' normals and visibility; towards_camera [P, F, 3]; blocked [P]: the points' covered share of
    the hemisphere; weights bfloat16 [F, P, J] on the open directions; blocked_share [1, P, F]: weight on the indirect
    irradiance.
    """

    table: SpecularTransfer
    towards_camera: np.ndarray
    blocked: np.ndarray
    roughness: float | np.ndarray
    weights: torch.Tensor
    blocked_share: torch.Tensor

    @classmethod
    def at(
        cls, table: SpecularTransfer, towards_camera: np.ndarray, blocked: np.ndarray, roughness: float | np.ndarray
    ) -> Lobes:
        """Tabulates them; the arguments are those of the class."""
        weights, covered = specular_tables(table, towards_camera, roughness)
        return cls(table, towards_camera, blocked, roughness, weights, _of_indirect_light(covered, blocked))

    def slopes(self) -> LobeSlopes:
        """Their derivatives by the logarithm of the roughness; tabulates them."""
        weights, covered = specular_slopes(self.table, self.towards_camera, self.roughness)
        return LobeSlopes(weights, _of_indirect_light(covered, self.blocked))


@dataclass(frozen=True, eq=False)
class LobeSlopes:
    """Derivatives of weights bfloat16 [F, P, J] and blocked_share [1, P, F] of Lobes by the logarithm of the roughness.
    """

    weights: torch.Tensor
    blocked_share: torch.Tensor


@dataclass(frozen=True, eq=False)
class LampTransfer:
    """How n texels of a near lamp reach P points in F frames: direct [P, F, n] irradiance by each, and total
    [3, P, F, n] with all diffuse bounces. view: what the points see of it."""

    view: LampView
    points: Points
    direct: np.ndarray
    total: np.ndarray

    def irradiance(self, light: np.ndarray) -> torch.Tensor:
        """Radiance of all texels [K, 3] -> [3, P, F]."""
        return self._each_channel(self.total, light)

    def without_bounces(self, light: np.ndarray) -> torch.Tensor:
        """The same of what comes straight from the lamp; light [K, 3]."""
        return self._each_channel([self.direct] * 3, light)

    def reflection(self, rows: np.ndarray, light: np.ndarray) -> torch.Tensor:
        """[3, P, F] by lobes, rows [P, F, n] of them; light [K, 3]."""
        return self._each_channel([rows] * 3, light)

    def _each_channel(self, rows, light: np.ndarray) -> torch.Tensor:
        own = light[self.view.texels].astype(np.float32)
        return torch.from_numpy(np.stack([rows[c] @ own[:, c] for c in range(3)]))

    def add_adjoint(self, light: np.ndarray, rows, values: torch.Tensor) -> None:
        """Adds to light [K, 3] the transpose of irradiance or reflection, rows of each channel [P, F, n]: values
        [3, P, F]."""
        for c, own in enumerate(values.numpy()):
            light[self.view.texels, c] += np.ascontiguousarray(own).reshape(-1) @ rows[c].reshape(own.size, -1)

    def lobes(self, lobes: Lobes, log_change: float = 0.0) -> np.ndarray:
        """[P, F, n]: the lobes' reflection of each texel, at their roughness or at one whose logarithm is larger by
        log_change, a number."""
        table = lobes.table
        alpha2 = table.alpha2(lobes.roughness * np.exp(log_change))
        return self.view.lobe_rows(self.points, table.visible, lobes.towards_camera, alpha2)


@dataclass(frozen=True, eq=False)
class Transport:
    """frame_light: the light along the J directions in F frames; direct [P, J]: irradiance from each direction, and
    total [3, P, J]: with all diffuse bounces; lobes: None where nothing is specular; lamp: None where none is near."""

    frame_light: FrameLight
    direct: torch.Tensor
    total: torch.Tensor
    lobes: Lobes | None
    lamp: LampTransfer | None = None

    @cached_property
    def lamp_lobes(self) -> np.ndarray:
        """[P, F, n]: the lobes' reflection of the near lamp's texels."""
        return self.lamp.lobes(self.lobes)

    @cached_property
    def lamp_slopes(self) -> np.ndarray:
        """[P, F, n]: its derivative by the logarithm of the roughness."""
        narrower, wider = (self.lamp.lobes(self.lobes, side * LOG_STEP) for side in (-1.0, 1.0))
        return (wider - narrower) / np.float32(2.0 * LOG_STEP)

    def forward(self, light: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
        """light [K, 3], its texels -> irradiance over pi E and reflection at intensity 1 S, both [3, P, F]."""
        along = torch.from_numpy(self.frame_light.along(light))
        irradiance = per_channel(self.total, along.permute(2, 0, 1))
        if self.lamp is not None:
            irradiance += self.lamp.irradiance(light)
        if self.lobes is None:
            return irradiance, torch.zeros_like(irradiance)
        indirect = self._indirect(along, light, irradiance)
        reflection = reflect(self.lobes.weights, along) + self.lobes.blocked_share * indirect
        if self.lamp is not None:
            reflection += self.lamp.reflection(self.lamp_lobes, light)
        return irradiance, reflection

    def roughness_slope(self, slopes: LobeSlopes, light: np.ndarray, irradiance: torch.Tensor) -> torch.Tensor:
        """Derivative of S by the logarithm of the roughness, [3, P, F], by the slopes of its lobes, under a light
        [K, 3] of irradiance [3, P, F]."""
        along = torch.from_numpy(self.frame_light.along(light))
        slope = reflect(slopes.weights, along) + slopes.blocked_share * self._indirect(along, light, irradiance)
        return slope if self.lamp is None else slope + self.lamp.reflection(self.lamp_slopes, light)

    def _indirect(self, along: torch.Tensor, light: np.ndarray, irradiance: torch.Tensor) -> torch.Tensor:
        indirect = irradiance - per_channel(self.direct[None].expand(3, -1, -1), along.permute(2, 0, 1))
        return indirect if self.lamp is None else indirect - self.lamp.without_bounces(light)

    def render(self, light: np.ndarray, albedo: torch.Tensor, specular: float) -> torch.Tensor:
        """Radiance [3, P, F] of albedo [3, P, 1] under a light [K, 3], or a change of one; highlights of the open
        directions only."""
        along = torch.from_numpy(self.frame_light.along(light))
        result = albedo * per_channel(self.total, along.permute(2, 0, 1))
        if self.lobes is not None:
            result += specular * reflect(self.lobes.weights, along)
        if self.lamp is not None:
            result += albedo * self.lamp.irradiance(light)
            if self.lobes is not None:
                result += specular * self.lamp.reflection(self.lamp_lobes, light)
        return result

    def rows(self, frame: int, points: np.ndarray, albedo: torch.Tensor, specular: float, channel: int) -> np.ndarray:
        """[n, K] float32: derivative of render by the texels, of points [n] int in one frame and channel, of albedo
        [3, P, 1]."""
        chosen = torch.from_numpy(points)
        rows = albedo[channel, chosen] * self.total[channel, chosen]
        if self.lobes is not None:
            rows = rows + specular * self.lobes.weights[frame, chosen].float()
        result = np.ascontiguousarray((self.frame_light.of_frame(frame).T @ rows.numpy().T).T)
        if self.lamp is not None:
            near = albedo[channel, chosen].numpy() * self.lamp.total[channel][points, frame]
            if self.lobes is not None:
                near += specular * self.lamp_lobes[points, frame]
            result[:, self.lamp.view.texels] += near
        return result

    def render_adjoint(self, values: torch.Tensor, albedo: torch.Tensor, specular: float) -> np.ndarray:
        """Transpose of render: values [3, P, F], albedo [3, P, 1] -> [K, 3]."""
        light = self.frame_light.adjoint(self._along_adjoint(values, albedo, specular).contiguous().numpy())
        self._add_lamp_adjoint(light, values, albedo, specular)
        return light

    def render_adjoint_with_slopes(
        self, values: torch.Tensor, albedo: torch.Tensor, specular: float, slopes: LobeSlopes, amplitude: float
    ) -> np.ndarray:
        """The same for a rendering that has highlights of these slopes, too, times an amplitude. values [3, P, F];
        albedo [3, P, 1]."""
        along = self._along_adjoint(values, albedo, specular) + amplitude * reflect_transposed(slopes.weights, values)
        light = self.frame_light.adjoint(along.contiguous().numpy())
        self._add_lamp_adjoint(light, values, albedo, specular)
        if self.lamp is not None:
            self.lamp.add_adjoint(light, [self.lamp_slopes] * 3, amplitude * values)
        return light

    def _add_lamp_adjoint(self, light: np.ndarray, values: torch.Tensor, albedo: torch.Tensor, specular: float) -> None:
        if self.lamp is not None:
            self.lamp.add_adjoint(light, self.lamp.total, albedo * values)
            if self.lobes is not None:
                self.lamp.add_adjoint(light, [self.lamp_lobes] * 3, specular * values)

    def _along_adjoint(self, values: torch.Tensor, albedo: torch.Tensor, specular: float) -> torch.Tensor:
        along = per_channel_transposed(self.total, albedo * values).permute(1, 2, 0)
        if self.lobes is not None:
            along = along + specular * reflect_transposed(self.lobes.weights, values)
        return along

    def irradiance_adjoint(self, values: torch.Tensor) -> np.ndarray:
        """Transpose of the irradiance: values [3, P, F] -> [K, 3]."""
        spread = per_channel_transposed(self.total, values)
        light = self.frame_light.adjoint(spread.permute(1, 2, 0).contiguous().numpy())
        if self.lamp is not None:
            self.lamp.add_adjoint(light, self.lamp.total, values)
        return light


def _of_indirect_light(weight: np.ndarray, blocked: np.ndarray) -> torch.Tensor:
    """Weights [P, F] on what blocks a lobe -> on the indirect irradiance, [1, P, F]."""
    return torch.from_numpy(weight / np.maximum(blocked, 1e-3)[:, None])[None]
