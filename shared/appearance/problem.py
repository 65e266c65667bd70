"""Light, albedo, specular intensity and roughness from the samples of a whole clip: what is given and what is sought.

Model of point v, frame f, channel c:  a[v, c] E[v, f, c] + s S[v, f, c], with E the irradiance over pi (visibility and
all diffuse bounces) and S the specular lobe sum, both linear in the light (transport). Unknown: the light's parameters,
one specular intensity s, one roughness, the albedo of each point.

Method. Albedo is projected out (variable projection [Golub1973], with the approximation of the derivative of
[Kaufman1975]): for any light it is a weighted least-squares solution per point and channel, and only the residual that
no albedo can explain drives the light. The light takes Gauss-Newton steps (light_step), each solved by conjugate
gradients with products only: a step touches the clip some twenty times and costs about as much as rendering it that
often. Specular intensity and the logarithm of the roughness are unknowns of the same step, projected out likewise
(specular_fit). Weights are robust (Cauchy, by reweighting) and clipped or crushed samples only push when the model
violates what they say (sample_errors). Steps end when frames that were held out stop improving (fit).

The problem never changes, and a step makes a new state of an old one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TypeVar

import numpy as np
import torch

from shared.appearance.albedo_scale import BRIGHTEST, most_likely_irradiance
from shared.appearance.eye_whites import whites_statement
from shared.appearance.light import FrameLight, LightPriors
from shared.appearance.light_models import LightModel, make_light_model
from shared.appearance.light_tint import LightTint
from shared.appearance.measured_skin import SURFACE_INTENSITY, SURFACE_SPREAD
from shared.appearance.observations import Capture
from shared.appearance.sample_errors import SampleErrors
from shared.appearance.skin_prior import SkinPrior, SkinVariation
from shared.appearance.transport import LampTransfer, Lobes, Transport
from shared.compute.threads import share_out
from shared.rendering.lobes import SpecularTransfer
from shared.rendering.near_lamp import LampView
from shared.rendering.shading import Material
from shared.rendering.transfer import Transfer, nearest_points, node_radiosity

Value = TypeVar("Value")

_POINTS_PER_BLOCK = 512

LAST_SMOOTHNESS = 0.1
"""Share of the light's smoothness that the last steps keep (see fit.fit_sharper_light)."""
PATCH_MM = 50.0
"""Of skin whose errors of the model count as one: a cheek, half a forehead."""


@dataclass(frozen=True)
class AppearanceSettings:
    """light_model: see light_models; resolutions: cubemap edge per stage of the solve; independent: how many of the
    samples count as independent evidence against the priors; noise: absolute (linear) and relative standard deviation
    of a sample; white_sigma, tints: see albedo_scale.scale_prior; visibility: whether parts of the head cover each
    other; precision: most products of a step of the light, and by how much its residual must fall; coarse_points: see
    fit.fit_all_points, 0: all."""

    light_model: str = "cubemap"
    resolutions: tuple[int, ...] = (8, 16)
    steps: int = 20
    independent: float = 5000.0
    noise: tuple[float, float] = (0.006, 0.03)
    priors: LightPriors = field(default_factory=LightPriors)
    white_sigma: float = 0.15
    tints: tuple[LightTint | None, ...] = ()
    skin: SkinVariation | None = field(default_factory=SkinVariation)
    visibility: bool = True
    bounce: bool = True
    specular: bool = True
    roughness: float = 0.45
    fit_roughness: bool = True
    local_roughness: bool = True
    specular_prior: tuple[float, float] = (SURFACE_INTENSITY, SURFACE_SPREAD)
    precision: tuple[int, float] = (60, 0.0005)
    coarse_points: int = 1000

    def light_moves(self, moves: str) -> str:
        """What moves against the light, in a clip in which the head or the camera moves: a lamp at the camera goes
        with it, so that the head moves in any clip."""
        return "head" if self.light_model == "camera" else moves

    @property
    def at_last(self) -> AppearanceSettings:
        """Those of the last steps, once shape and poses stand."""
        return replace(self, priors=replace(self.priors, smooth=LAST_SMOOTHNESS * self.priors.smooth))

    @property
    def light_schedule(self) -> tuple[tuple[str, int], ...]:
        """(model, resolution) per stage; models with a few numbers start from a coarse cubemap."""
        if self.light_model == "cubemap":
            return tuple(("cubemap", resolution) for resolution in self.resolutions)
        return ("cubemap", self.resolutions[0]), (self.light_model, self.resolutions[-1])


@dataclass(frozen=True, eq=False)
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

    def radiance(self, irradiance: torch.Tensor, reflection: torch.Tensor) -> torch.Tensor:
        """The model [3, P, F] of irradiance and reflection [3, P, F]."""
        albedo = torch.from_numpy(np.ascontiguousarray(self.albedo.T, np.float32))[..., None]
        return albedo * irradiance + self.specular * reflection


def _sent_on(state: AppearanceState) -> np.ndarray:
    """[K, 3]: the share of the light that nodes send on."""
    return Material(state.node_albedo, state.specular, state.roughness).bounce_albedo()


class _Latest:
    """A function whose last value is kept: made anew only for another argument, the old value let go first, since a
    table of lobes is the greatest thing in memory."""

    def __init__(self) -> None:
        self._argument, self._value = None, None

    def __call__(self, argument: float, make: Callable[[float], Value]) -> Value:
        if self._argument != argument:
            self._value = None
            self._value, self._argument = make(argument), argument
        return self._value


@dataclass(frozen=True, eq=False)
class Bounces:
    """What bounces between surfaces go by, widened once for all steps: from node to node [K, K], from each direction to
    the nodes [K, J], from the nodes to the points [P, K]; float32."""

    among_nodes: np.ndarray
    to_nodes: np.ndarray
    to_points: np.ndarray

    @classmethod
    def of(cls, points: Transfer, nodes: Transfer) -> Bounces:
        """Those of the transfers of points and of nodes."""
        return cls(*(table.astype(np.float32) for table in (nodes.bounce, nodes.direct, points.bounce)))

    def take(self, index: slice | np.ndarray) -> Bounces:
        """Those to some of the points."""
        return replace(self, to_points=self.to_points[index])

    def with_direct(self, direct: np.ndarray, albedo: np.ndarray, to_nodes: np.ndarray | None = None) -> np.ndarray:
        """[3, P, J]: irradiance from each direction, direct [P, J] and by all diffuse bounces between nodes of an
        albedo [K, 3]: node_radiosity of all directions, channels and blocks of points shared out. to_nodes [K, J]: from
        other sources than the directions, which direct is of, too."""
        to_nodes = self.to_nodes if to_nodes is None else to_nodes
        among, identity = self.among_nodes, np.eye(len(self.among_nodes), dtype=np.float32)
        own = albedo.T.astype(np.float32)[..., None]
        radiosity = share_out(3, lambda c: np.linalg.solve(identity - own[c] * among, own[c] * to_nodes))
        total = np.empty((3, *direct.shape), np.float32)
        blocks = [(c, slice(first, first + _POINTS_PER_BLOCK))
                  for c in range(3) for first in range(0, len(direct), _POINTS_PER_BLOCK)]

        def add(k: int) -> None:
            c, part = blocks[k]
            np.add(self.to_points[part] @ radiosity[c], direct[part], out=total[c, part])

        share_out(len(blocks), add)
        return total


@dataclass(frozen=True, eq=False)
class AppearanceProblem:
    """What stays while states change: the capture, settings, the samples' errors as assumed, the points' lobes as a
    function of the roughness, the point that each node takes its albedo from [K], the prior on skin, or None, the
    irradiance from each direction, without bounces [P, J], and what bounces go by; whites: that of the whites of the
    eyes, None where nothing is said of them."""

    capture: Capture
    settings: AppearanceSettings
    errors: SampleErrors
    table: SpecularTransfer
    node_to_point: np.ndarray
    skin_prior: SkinPrior | None
    direct: torch.Tensor
    bounces: Bounces
    whites: AppearanceProblem | None = None
    _latest_lobes: _Latest = field(default_factory=_Latest, repr=False)
    _latest_frame_light: _Latest = field(default_factory=_Latest, repr=False)
    _latest_lamp: _Latest = field(default_factory=_Latest, repr=False)

    @classmethod
    def of(cls, capture: Capture, settings: AppearanceSettings) -> AppearanceProblem:
        """The capture's, under these settings."""
        lights, noise = capture.frames_of_lights, settings.noise
        skin_prior = None
        if settings.skin is not None and capture.skin.any():
            skin_prior = SkinPrior(capture.points.positions, capture.skin, settings.skin)
        whites = None
        if capture.whites is not None:
            whites = cls.of(capture.whites, replace(settings, specular=False, skin=None))
        return cls(
            capture=capture,
            settings=settings,
            errors=SampleErrors.of(capture.samples, capture.fitted, lights, noise, settings.independent),
            table=SpecularTransfer(capture.points.normals, capture.transfer.visibility(), capture.directions),
            node_to_point=nearest_points(capture.nodes.points, capture.points),
            skin_prior=skin_prior,
            direct=torch.from_numpy(capture.transfer.direct.astype(np.float32)),
            bounces=Bounces.of(capture.transfer, capture.node_transfer),
            whites=whites,
        )

    def take(self, index: slice | np.ndarray) -> AppearanceProblem:
        """That of some of the points, under the whole one's prior."""
        capture = self.capture.take(index)
        table = SpecularTransfer(capture.points.normals, capture.transfer.visibility(), capture.directions)
        return AppearanceProblem(capture, self.settings, self.errors.take(index), table, self.node_to_point,
                                 self.skin_prior, self.direct[index], self.bounces.take(index))

    @cached_property
    def patches(self) -> np.ndarray:
        """[P] int: the patch of skin that each point lies in, a cube of PATCH_MM."""
        cubes = np.floor(self.capture.points.positions / PATCH_MM).astype(int)
        return np.unique(cubes, axis=0, return_inverse=True)[1].ravel()

    # ------------------------------------------------------------------ states
    def uniform_start(self) -> AppearanceState:
        """Uniform lights of the level that the priors prefer for this radiance."""
        errors, settings = self.errors, self.settings
        weight = self.skin_weight.double()
        radiance, levels = self.skin_radiance()
        open_share = float((self.direct.sum(1) * weight[0].sum(1)).sum() / weight.sum())
        relative = np.log(levels) if settings.tints else None
        irradiance = np.exp(most_likely_irradiance(np.log(radiance), settings.white_sigma, relative, settings.tints))
        albedo = radiance / irradiance
        model, resolution = settings.light_schedule[0]
        log_light = np.repeat(np.log(irradiance / open_share * levels), 6 * resolution**2, axis=0)
        start = AppearanceState(
            params=log_light,
            light_model=make_light_model("cubemap", resolution, len(errors.light_frames)),
            specular=settings.specular_prior[0] if settings.specular else 0.0,
            roughness=settings.roughness,
            albedo=np.tile(albedo, (len(self.capture.points), 1)),
            node_albedo=np.tile(albedo, (len(self.capture.nodes.points), 1)),
        )
        return self.with_light_model(start, model, resolution)

    def start_from(self, state: AppearanceState) -> AppearanceState:
        """Light, specular intensity and roughness of a state of other points; the albedo is its typical one."""
        typical = np.median(state.albedo, axis=0)
        albedo, node_albedo = (np.tile(typical, (len(some), 1))
                               for some in (self.capture.points, self.capture.nodes.points))
        return replace(state, albedo=albedo, node_albedo=node_albedo)

    def with_light_model(
        self, state: AppearanceState, name: str, resolution: int, shares: tuple[float, ...] = ()
    ) -> AppearanceState:
        """The state in a light of another model (name) or resolution, as close to the present one as it can be;
        shares: see SampleErrors.light_shares."""
        model = make_light_model(name, resolution, len(self.errors.light_frames), shares)
        return replace(state, params=model.fit(state.light), light_model=model)

    # ------------------------------------------------------------------ operators
    def transport(self, state: AppearanceState) -> Transport:
        """How light reaches the points in a state."""
        lobes = self.lobes_at(state.roughness) if self.settings.specular else None
        return Transport(self.frame_light(state), self.direct, self.total_transfer(state), lobes,
                         self.lamp_transfer(state))

    def frame_light(self, state: AppearanceState) -> FrameLight:
        """The far light along the directions in each frame, of a light of the state's resolution."""
        capture = self.capture
        near = None if capture.lamp is None else capture.lamp.lamp.texels(state.light_model.resolution)
        return self._latest_frame_light(state.light_model.resolution, lambda resolution: FrameLight(
            resolution, capture.directions, capture.world_from_head, capture.light_index, near))

    def irradiance(self, state: AppearanceState) -> np.ndarray:
        """[3, P, F]: irradiance over pi under the state's light, as transport(state).forward has it, for once: the
        light's own bounces are summed in place of those from each direction."""
        capture, light = self.capture, state.light
        along = np.ascontiguousarray(np.moveaxis(self.frame_light(state).along(light), -1, 0))
        points, nodes = self.direct.numpy() @ along, self.bounces.to_nodes @ along
        if capture.lamp is not None:
            view, to_points, to_nodes = self._latest_lamp(state.light_model.resolution, self._lamp_rows)
            own = light[view.texels].astype(np.float32).T
            points += np.stack([to_points @ channel for channel in own])
            nodes += np.stack([to_nodes @ channel for channel in own])
        if not self.settings.bounce:
            return points
        radiosity = node_radiosity(capture.node_transfer, _sent_on(state), np.moveaxis(nodes, 0, -1))
        return points + self.bounces.to_points @ np.moveaxis(radiosity, -1, 0)

    def total_transfer(self, state: AppearanceState) -> torch.Tensor:
        """[3, P, J]: irradiance from each direction, with all diffuse bounces between surfaces of the state's albedo.
        """
        if not self.settings.bounce:
            return self.direct[None].expand(3, -1, -1)
        return torch.from_numpy(self.bounces.with_direct(self.direct.numpy(), _sent_on(state)))

    def lamp_transfer(self, state: AppearanceState) -> LampTransfer | None:
        """How a near lamp reaches the points in a state, with all diffuse bounces; None where none is near."""
        if self.capture.lamp is None:
            return None
        points = self.capture.points
        view, direct, to_nodes = self._latest_lamp(state.light_model.resolution, self._lamp_rows)
        if not self.settings.bounce:
            return LampTransfer(view, points, direct, np.broadcast_to(direct, (3, *direct.shape)))
        total = self.bounces.with_direct(direct.reshape(len(direct), -1), _sent_on(state),
                                         to_nodes.reshape(len(to_nodes), -1))
        return LampTransfer(view, points, direct, total.reshape(3, *direct.shape))

    def _lamp_rows(self, resolution: int) -> tuple[LampView, np.ndarray, np.ndarray]:
        """What is seen of the lamp, and its rows of the points [P, F, n] and of the nodes [K, F, n]."""
        capture = self.capture
        view = LampView(capture.lamp, resolution, capture.directions)
        nodes = view.irradiance_rows(capture.nodes.points, capture.node_transfer.visibility())
        return view, view.irradiance_rows(capture.points, self.table.visible), nodes

    def lobes_at(self, roughness: float) -> Lobes:
        """The points' lobes at a roughness."""
        return self._latest_lobes(roughness, self.lobes_of_each)

    def lobes_of_each(self, roughness: float | np.ndarray) -> Lobes:
        """The points' lobes, each of its own roughness [P]."""
        return Lobes.at(self.table, self.capture.samples.towards_camera, self.capture.transfer.blocked, roughness)

    # ------------------------------------------------------------------ means over the skin
    @property
    def skin_weight(self) -> torch.Tensor:
        """[1, P, F]: the samples' view weights, 0 beside the skin."""
        return self.errors.view_weight * torch.from_numpy(self.capture.skin.astype(np.float32))[None, :, None]

    def skin_radiance(self) -> tuple[np.ndarray, np.ndarray]:
        """[3]: the skin's mean radiance in all frames, and [L, 3]: that in the frames of each light relative to it."""
        errors, weight = self.errors, self.skin_weight.double()
        radiance = ((weight * errors.colours).sum((1, 2)) / weight.sum()).numpy()
        levels = [(weight * errors.colours)[..., own].sum((1, 2)).numpy() / weight[..., own].sum().item() / radiance
                  for own in errors.light_frames]
        return radiance, np.array(levels)

    def typical_albedo(self, state: AppearanceState) -> torch.Tensor:
        """[3, 1, 1]: the skin points' median albedo."""
        median = np.median(state.albedo[self.capture.skin], axis=0)
        return torch.from_numpy(median.astype(np.float32))[:, None, None]

    def mean_on_skin(
        self, albedo: torch.Tensor, irradiance: torch.Tensor, transport: Transport
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Log of the skin's mean albedo [3], log of its mean irradiance [3], and that mean's derivative by the
        texels' radiance relative to itself [K, 3], of albedo [3, P, 1] and irradiance [3, P, F]."""
        weight = self.skin_weight
        total = weight.sum()
        mean = (weight * irradiance).sum((1, 2)) / total
        log_albedo = torch.log((weight * albedo).sum((1, 2)) / total)
        gauge = transport.irradiance_adjoint((weight / total / mean[:, None, None]).expand_as(irradiance))
        return log_albedo.double().numpy(), torch.log(mean).double().numpy(), gauge

    def shine_on_skin(self, diffuse: torch.Tensor, highlights: torch.Tensor) -> np.ndarray:
        """[3]: the skin's mean radiance of highlights relative to its mean diffuse radiance, both [3, P, F]."""
        weight = self.skin_weight
        return ((weight * highlights).sum((1, 2)) / (weight * diffuse).sum((1, 2))).double().numpy()

    def brightest_skin(self, albedo: torch.Tensor) -> np.ndarray:
        """[3]: log of the skin points' albedo [3, P, 1] at the quantile BRIGHTEST."""
        return np.log(np.quantile(albedo[:, torch.from_numpy(self.capture.skin), 0].numpy(), BRIGHTEST, axis=1))

    def said_by_whites(self, state: AppearanceState) -> tuple[np.ndarray, np.ndarray] | None:
        """The log factor [3] on the state's light that the whites of the eyes ask for, and its covariance [3, 3]; None
        where the clip shows too little of them, or too much of that burnt out."""
        if self.whites is None:
            return None
        return whites_statement(self.whites.capture.samples, self.whites.irradiance(state))

    def relative_light(self, irradiance: torch.Tensor) -> np.ndarray:
        """[L, 3]: log of the skin's mean irradiance [3, P, F] in the frames of each light, relative to that in all
        frames."""
        weight = self.skin_weight
        mean = (weight * irradiance).sum((1, 2)) / weight.sum()
        own = [(weight * irradiance)[..., frames].sum((1, 2)) / weight[..., frames].sum()
               for frames in self.errors.light_frames]
        return torch.log(torch.stack(own) / mean).double().numpy()
