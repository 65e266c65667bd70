"""Light, albedo, specular intensity and roughness from the samples of a whole clip.

Model of point v, frame f, channel c:  a[v, c] E[v, f, c] + s S[v, f, c], with E the irradiance over pi (visibility and
all diffuse bounces) and S the specular lobe sum, both linear in the light. Unknown: the light's parameters, one
specular intensity s, one roughness, the albedo of each point.

Method. Albedo is projected out (variable projection [Golub1973], with the approximation of the derivative of
[Kaufman1975]): for any light it is a weighted least-squares solution per point and channel, and only the residual that
no albedo can explain drives the light. The light takes Gauss-Newton steps, each solved by conjugate gradients with
products only: a step touches the clip some twenty times and costs about as much as rendering it that often. Specular
intensity and the logarithm of the roughness are unknowns of the same step, projected out likewise. Weights are robust
(Cauchy, by reweighting) and clipped or crushed samples only push when the model violates what they say. Steps end when
frames that were held out stop improving.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, field, replace

import numpy as np
import torch

from shared.appearance.albedo_scale import Highlights, most_likely_irradiance
from shared.appearance.light import FrameLight, LightPriors
from shared.appearance.light_models import LightModel, make_light_model
from shared.appearance.observations import Capture
from shared.appearance.products import per_channel, per_channel_transposed, reflect
from shared.appearance.sample_errors import SampleErrors
from shared.appearance.skin_prior import SkinPrior, SkinVariation
from shared.rendering.lobes import SpecularTransfer
from shared.rendering.shading import Material
from shared.rendering.specular_transfer import specular_slopes, specular_tables
from shared.rendering.transfer import nearest_points

MINIMUM_ALBEDO, MAXIMUM_ALBEDO = 0.003, 1.0
ROUGHNESS_RANGE, ROUGHNESS_SPREAD = (0.1, 0.7), 0.35
"""Of skin; the spread is the standard deviation of the prior on its logarithm, about where the fit starts."""
LARGEST_ROUGHNESS_STEP = 0.08
"""Of a step, in the logarithm: lobes are linearised, and their peak goes with the inverse fourth power."""
ALBEDO_PULL = 25.0
"""Precision of the prior on a point's albedo: a standard deviation of 0.2."""


@dataclass(frozen=True)
class AppearanceSettings:
    """light_model: see light_models; resolutions: cubemap edge per stage of the solve; independent: how many of the
    samples count as independent evidence against the priors; noise: absolute and relative standard deviation of a
    sample; visibility: whether parts of the head cover each other; precision: most products of a step of the light, and
    by how much its residual must fall."""

    light_model: str = "cubemap"
    resolutions: tuple[int, ...] = (8, 16)
    steps: int = 20
    independent: float = 5000.0
    noise: tuple[float, float] = (0.006, 0.03)
    priors: LightPriors = field(default_factory=LightPriors)
    white_sigma: float = 0.15
    skin: SkinVariation | None = field(default_factory=SkinVariation)
    visibility: bool = True
    bounce: bool = True
    specular: bool = True
    roughness: float = 0.45
    fit_roughness: bool = True
    local_roughness: bool = True
    specular_prior: tuple[float, float] = (0.7, 0.25)
    precision: tuple[int, float] = (60, 0.0005)

    def light_moves(self, moves: str) -> str:
        """What moves against the light: a lamp at the camera goes with it, so that the head moves in any capture."""
        return "head" if self.light_model == "camera" else moves

    @property
    def light_schedule(self) -> tuple[tuple[str, int], ...]:
        """(model, resolution) per stage; models with a few numbers start from a coarse cubemap."""
        if self.light_model == "cubemap":
            return tuple(("cubemap", resolution) for resolution in self.resolutions)
        return ("cubemap", self.resolutions[0]), (self.light_model, self.resolutions[-1])


@dataclass
class AppearanceState:
    """The light's parameters [M, 3] and the model they belong to, specular intensity, roughness, albedo [P, 3],
    node_albedo [K, 3]. Of several lights all parameters and texels lie one below the other."""

    params: np.ndarray
    light_model: LightModel
    specular: float
    roughness: float
    albedo: np.ndarray
    node_albedo: np.ndarray

    @property
    def light(self) -> np.ndarray:
        """[6 n^2, 3] radiance."""
        return self.light_model.radiance(self.params)


class AppearanceSolver(SampleErrors):
    """Fits State to a Capture, by the errors of its samples. Tensors inside are channel first: [3, P, F]."""

    def __init__(self, capture: Capture, settings: AppearanceSettings):
        self.capture, self.settings = capture, settings
        frames, noise = capture.frames_of_lights, settings.noise
        super().__init__(capture.samples, capture.fitted, frames, noise, settings.independent)
        self.table = SpecularTransfer(capture.points.normals, capture.transfer.visibility(), capture.directions)
        self.node_to_point = nearest_points(capture.nodes.points, capture.points)
        self.skin_prior = None
        if settings.skin is not None and capture.skin.any():
            self.skin_prior = SkinPrior(capture.points.positions, capture.skin, settings.skin)
        self.direct = torch.from_numpy(capture.transfer.direct.astype(np.float32))
        self.trust_highlights, self.prior_shares = False, None
        self.lobes: torch.Tensor | None = None
        self.slopes: torch.Tensor | None = None
        self.state = self._start()
        self.set_light(settings.light_schedule[0])

    # ------------------------------------------------------------------ set-up
    @classmethod
    def at(cls, capture: Capture, settings: AppearanceSettings, state: AppearanceState) -> AppearanceSolver:
        """At a solved state of the capture, its transfer baked: to look at what the samples say there."""
        solver = cls(capture, settings)
        solver.set_state(replace(state))
        solver.bake()
        return solver

    def _start(self) -> AppearanceState:
        """Uniform lights of the level that the priors prefer for this radiance."""
        weight = (self.trust * self._skin()).double()
        radiance = ((weight * self.colours).sum((1, 2)) / weight.sum()).numpy()
        levels = [(weight * self.colours)[..., own].sum((1, 2)).numpy() / weight[..., own].sum().item() / radiance
                  for own in self.light_frames]
        open_share = float((self.direct.sum(1) * weight[0].sum(1)).sum() / weight.sum())
        irradiance = np.exp(most_likely_irradiance(np.log(radiance), self.settings.white_sigma))
        albedo = radiance / irradiance
        resolution = self.settings.light_schedule[0][1]
        log_light = np.repeat(np.log(irradiance / open_share * np.array(levels)), 6 * resolution**2, axis=0)
        points, nodes = len(self.capture.points), len(self.capture.nodes.points)
        specular = self.settings.specular_prior[0] if self.settings.specular else 0.0
        return AppearanceState(
            params=log_light,
            light_model=make_light_model("cubemap", resolution, len(self.light_frames)),
            specular=specular,
            roughness=self.settings.roughness,
            albedo=np.tile(albedo, (points, 1)),
            node_albedo=np.tile(albedo, (nodes, 1)),
        )

    def start_from(self, state: AppearanceState) -> None:
        """Light, specular intensity and roughness of a state of other points; the albedo is its typical one."""
        typical, own = np.median(state.albedo, axis=0), self.state
        albedo, node_albedo = (np.tile(typical, (len(some), 1)) for some in (own.albedo, own.node_albedo))
        self.state = replace(state, params=state.params.copy(), albedo=albedo, node_albedo=node_albedo)

    def _skin(self) -> torch.Tensor:
        return torch.from_numpy(self.capture.skin.astype(np.float32))[None, :, None]

    def set_light(self, stage: tuple[str, int]) -> None:
        """Goes on with a light of another model or resolution, as close to the present one as it can be."""
        model = make_light_model(*stage, len(self.light_frames))
        self.set_state(replace(self.state, params=model.fit(self.state.light), light_model=model))

    def set_state(self, state: AppearanceState) -> None:
        """Goes on from a state of these points as it is."""
        self.state, capture = state, self.capture
        if self.prior_shares:
            state.light_model.shares = self.prior_shares
        resolution = state.light_model.resolution
        self.frame_light = FrameLight(resolution, capture.directions, capture.world_from_head, capture.light_index)

    def subset(self, index: slice) -> AppearanceSolver:
        """A solver of some of the points that shares the rest, with a state of its own."""
        part = copy(self)
        part.capture = replace(
            self.capture,
            points=self.capture.points.take(index),
            samples=self.capture.samples.points(index),
            transfer=self.capture.transfer.take(index),
            skin=self.capture.skin[index],
        )
        part.state = replace(self.state, albedo=self.state.albedo[index])
        part.colours, part.saturation, part.trust, part.precision, part.baked = (
            x[:, index] for x in (self.colours, self.saturation, self.trust, self.precision, self.baked)
        )
        part.direct = self.direct[index]
        part.table = SpecularTransfer(part.capture.points.normals, part.capture.transfer.visibility(),
                                      self.capture.directions)
        return part

    def weigh(self, reliability: torch.Tensor) -> None:
        """As SampleErrors.weigh; the prior of a light steps back as its samples do."""
        super().weigh(reliability)
        used = self.trust.expand_as(reliability)
        self.prior_shares = [float((used * reliability)[..., own].sum() / used[..., own].sum())
                             for own in self.light_frames]
        self.state.light_model.shares = self.prior_shares

    # ------------------------------------------------------------------ forward model
    def bake(self) -> None:
        """Transfer with all diffuse bounces for the present albedo [3, P, J]."""
        self.baked = self.direct[None].expand(3, -1, -1)
        if self.settings.bounce:
            share = Material(self.state.node_albedo, self.state.specular, self.state.roughness).bounce_albedo()
            # node_radiosity @ direct, without the matrix in between
            form, node_direct, bounce = (table.astype(np.float32) for table in (
                self.capture.node_transfer.bounce, self.capture.node_transfer.direct, self.capture.transfer.bounce))
            albedo = share.T.astype(np.float32)[..., None]
            radiosity = np.linalg.solve(np.eye(len(form), dtype=np.float32) - albedo * form, albedo * node_direct)
            self.baked = self.direct + torch.from_numpy(bounce @ radiosity)

    def bake_lobes(self, roughness: float | np.ndarray | None = None) -> None:
        """The specular tables [F, P, J] for the present roughness, or for another one or each point's own [P]."""
        roughness = self.state.roughness if roughness is None else roughness
        self.lobes, blocked = specular_tables(self.table, self.capture.samples.towards_camera, roughness)
        self.blocked_share, self.slopes = self._of_blocked_light(blocked), None

    def bake_slopes(self) -> None:
        """Their derivatives by the logarithm of the roughness."""
        self.slopes, blocked = specular_slopes(self.table, self.capture.samples.towards_camera, self.state.roughness)
        self.blocked_slope = self._of_blocked_light(blocked)

    def _of_blocked_light(self, weight: np.ndarray) -> torch.Tensor:
        """Weights [P, F] on what blocks a lobe -> on the indirect irradiance, [1, P, F]."""
        return torch.from_numpy(weight / np.maximum(self.capture.transfer.blocked, 1e-3)[:, None])[None]

    def forward(self, light: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
        """Texels [K, 3] -> irradiance E and reflection S, both [3, P, F]."""
        along = torch.from_numpy(self.frame_light.along(light))
        irradiance = per_channel(self.baked, along.permute(2, 0, 1))
        if not self.settings.specular:
            return irradiance, torch.zeros_like(irradiance)
        return irradiance, reflect(self.lobes, along) + self.blocked_share * self._indirect(along, irradiance)

    def forward_slope(self, light: np.ndarray, irradiance: torch.Tensor) -> torch.Tensor:
        """Texels [K, 3] and their irradiance -> derivative of S by the logarithm of the roughness, [3, P, F]."""
        along = torch.from_numpy(self.frame_light.along(light))
        return reflect(self.slopes, along) + self.blocked_slope * self._indirect(along, irradiance)

    def _indirect(self, along: torch.Tensor, irradiance: torch.Tensor) -> torch.Tensor:
        return irradiance - per_channel(self.direct[None].expand(3, -1, -1), along.permute(2, 0, 1))

    def model(self, irradiance: torch.Tensor, reflection: torch.Tensor) -> torch.Tensor:
        """Radiance [3, P, F] for the present albedo and specular intensity."""
        albedo = torch.from_numpy(np.ascontiguousarray(self.state.albedo.T, np.float32))[..., None]
        return albedo * irradiance + self.state.specular * reflection

    def mean_on_skin(self, albedo, irradiance) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Log of the skin's mean albedo [3], log of its mean irradiance [3], and that mean's derivative by the
        texels' radiance relative to itself [K, 3]."""
        weight = self.trust * self._skin()
        total = weight.sum()
        mean = (weight * irradiance).sum((1, 2)) / total
        log_albedo = torch.log((weight * albedo).sum((1, 2)) / total)
        spread = per_channel_transposed(self.baked, (weight / total / mean[:, None, None]).expand_as(irradiance))
        gauge = self.frame_light.adjoint(spread.permute(1, 2, 0).contiguous().numpy())
        return log_albedo.double().numpy(), torch.log(mean).double().numpy(), gauge

    def relative_light(self, irradiance: torch.Tensor) -> np.ndarray:
        """[L, 3]: log of the skin's mean irradiance in the frames of each light, relative to that in all frames."""
        weight = self.trust * self._skin()
        mean = (weight * irradiance).sum((1, 2)) / weight.sum()
        own = [(weight * irradiance)[..., frames].sum((1, 2)) / weight[..., frames].sum()
               for frames in self.light_frames]
        return torch.log(torch.stack(own) / mean).double().numpy()

    # ------------------------------------------------------------------ unknowns that are projected out
    def best_albedo(self, irradiance, highlights, weight) -> torch.Tensor:
        """Albedo [3, P, 1] that fits best beside highlights [3, P, F], from the fitted frames.

        A weak pull to the skin's typical albedo decides where no sample says anything.
        """
        weight = weight * self.fitted
        moment = (weight * irradiance * (self.colours - highlights)).sum(2, keepdim=True)
        curvature = (weight * irradiance * irradiance).sum(2, keepdim=True)
        albedo = (moment + ALBEDO_PULL * self.typical_albedo) / (curvature + ALBEDO_PULL)
        return albedo.clamp(MINIMUM_ALBEDO, MAXIMUM_ALBEDO)

    def project_off_albedo(self, values, irradiance, weight) -> torch.Tensor:
        """values [3, P, F] minus the part along E that a change of albedo would absorb.

        Exactly orthogonal, without the pull on the albedo: highlights are some percent of the diffuse radiance, and
        the least remainder of that would pass for them.
        """
        along = (weight * irradiance * values).sum(2, keepdim=True)
        return values - irradiance * along / (weight * irradiance * irradiance).sum(2, keepdim=True).clamp_min(1e-6)

    @property
    def typical_albedo(self) -> torch.Tensor:
        """[3, 1, 1]: the skin points' median albedo."""
        median = np.median(self.state.albedo[self.capture.skin], axis=0)
        return torch.from_numpy(median.astype(np.float32))[:, None, None]

    def update_roughness(self, change: float) -> float:
        """Changes the log roughness, within its range and at most by what lobes may be linearised over, and bakes what
        follows from it -> by how much it was changed."""
        change, before = np.clip(change, -LARGEST_ROUGHNESS_STEP, LARGEST_ROUGHNESS_STEP), self.state.roughness
        self.state.roughness = float(np.clip(before * np.exp(change), *ROUGHNESS_RANGE))
        self.bake_lobes()
        return abs(float(np.log(self.state.roughness / before)))

    def highlights(self, irradiance, reflection, weight) -> Highlights:
        """What the samples say about the specular intensity, per channel, with albedo projected out."""
        weight = weight * self.fitted
        pure = self.project_off_albedo(reflection, irradiance, weight)
        moment, curvature = (weight * pure * self.colours).sum((1, 2)), (weight * pure * reflection).sum((1, 2))
        share = (weight * self.colours).sum((1, 2)) / (weight * reflection).sum((1, 2))
        intensity = (moment / curvature.clamp_min(1e-12)).double().numpy()
        return Highlights(intensity, curvature.double().numpy() * self.evidence(weight), share.double().numpy())
