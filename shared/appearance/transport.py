"""From a light to what the points show: linear operators with their adjoints, for the bounces and lobes of one state.

Irradiance E = T l, with T the transfer with all diffuse bounces; reflection S = R l + b (E - D l): the lobes' open part
sees the light, their blocked part the mean indirect light of what stands before the point. l is the light along the
directions in each frame, itself linear in the texels (FrameLight). Tensors are channel first: [3, P, F].
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from shared.appearance.light import FrameLight
from shared.appearance.products import per_channel, per_channel_transposed, reflect, reflect_transposed
from shared.rendering.lobes import SpecularTransfer
from shared.rendering.specular_transfer import specular_slopes, specular_tables


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
class Transport:
    """frame_light: the light along the J directions in F frames; direct [P, J]: irradiance from each direction, and
    total [3, P, J]: with all diffuse bounces; lobes: None where nothing is specular."""

    frame_light: FrameLight
    direct: torch.Tensor
    total: torch.Tensor
    lobes: Lobes | None

    def forward(self, light: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
        """light [K, 3], its texels -> irradiance over pi E and reflection at intensity 1 S, both [3, P, F]."""
        along = torch.from_numpy(self.frame_light.along(light))
        irradiance = per_channel(self.total, along.permute(2, 0, 1))
        if self.lobes is None:
            return irradiance, torch.zeros_like(irradiance)
        indirect = self._indirect(along, irradiance)
        return irradiance, reflect(self.lobes.weights, along) + self.lobes.blocked_share * indirect

    def roughness_slope(self, slopes: LobeSlopes, light: np.ndarray, irradiance: torch.Tensor) -> torch.Tensor:
        """Derivative of S by the logarithm of the roughness, [3, P, F], by the slopes of its lobes, under a light
        [K, 3] of irradiance [3, P, F]."""
        along = torch.from_numpy(self.frame_light.along(light))
        return reflect(slopes.weights, along) + slopes.blocked_share * self._indirect(along, irradiance)

    def _indirect(self, along: torch.Tensor, irradiance: torch.Tensor) -> torch.Tensor:
        return irradiance - per_channel(self.direct[None].expand(3, -1, -1), along.permute(2, 0, 1))

    def render(self, light: np.ndarray, albedo: torch.Tensor, specular: float) -> torch.Tensor:
        """Radiance [3, P, F] of albedo [3, P, 1] under a light [K, 3], or a change of one; highlights of the open
        directions only."""
        along = torch.from_numpy(self.frame_light.along(light))
        result = albedo * per_channel(self.total, along.permute(2, 0, 1))
        if self.lobes is not None:
            result += specular * reflect(self.lobes.weights, along)
        return result

    def rows(self, frame: int, points: np.ndarray, albedo: torch.Tensor, specular: float, channel: int) -> np.ndarray:
        """[n, K] float32: derivative of render by the texels, of points [n] int in one frame and channel, of albedo
        [3, P, 1]."""
        chosen = torch.from_numpy(points)
        rows = albedo[channel, chosen] * self.total[channel, chosen]
        if self.lobes is not None:
            rows = rows + specular * self.lobes.weights[frame, chosen].float()
        return np.ascontiguousarray((self.frame_light.of_frame(frame).T @ rows.numpy().T).T)

    def render_adjoint(self, values: torch.Tensor, albedo: torch.Tensor, specular: float) -> np.ndarray:
        """Transpose of render: values [3, P, F], albedo [3, P, 1] -> [K, 3]."""
        return self.frame_light.adjoint(self._along_adjoint(values, albedo, specular).contiguous().numpy())

    def render_adjoint_with_slopes(
        self, values: torch.Tensor, albedo: torch.Tensor, specular: float, slopes: LobeSlopes, amplitude: float
    ) -> np.ndarray:
        """The same for a rendering that has highlights of these slopes, too, times an amplitude. values [3, P, F];
        albedo [3, P, 1]."""
        along = self._along_adjoint(values, albedo, specular) + amplitude * reflect_transposed(slopes.weights, values)
        return self.frame_light.adjoint(along.contiguous().numpy())

    def _along_adjoint(self, values: torch.Tensor, albedo: torch.Tensor, specular: float) -> torch.Tensor:
        along = per_channel_transposed(self.total, albedo * values).permute(1, 2, 0)
        if self.lobes is not None:
            along = along + specular * reflect_transposed(self.lobes.weights, values)
        return along

    def irradiance_adjoint(self, values: torch.Tensor) -> np.ndarray:
        """Transpose of the irradiance: values [3, P, F] -> [K, 3]."""
        spread = per_channel_transposed(self.total, values)
        return self.frame_light.adjoint(spread.permute(1, 2, 0).contiguous().numpy())


def _of_indirect_light(weight: np.ndarray, blocked: np.ndarray) -> torch.Tensor:
    """Weights [P, F] on what blocks a lobe -> on the indirect irradiance, [1, P, F]."""
    return torch.from_numpy(weight / np.maximum(blocked, 1e-3)[:, None])[None]
