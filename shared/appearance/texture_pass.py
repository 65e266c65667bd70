"""The frames through the texture's normal equations: some for a first look, all to fit, held-out ones to choose."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from typing import TypeVar

import numpy as np

from shared.appearance.eye_albedo import round_albedo
from shared.appearance.texture import (
    BEHIND_OVER_SKIN,
    ERROR_OVER_SCATTER,
    IRRADIANCE_ERROR,
    LEAST_ALBEDO,
    NORMAL_ERROR,
    PRIOR_SPREAD,
    PULL_OVER_SCATTER,
    BorderSums,
    Evidence,
    Noise,
    NormalEquations,
    ScatterSums,
    TexelMaterial,
    known_share,
    pooled_specular,
    robust_weight,
    weigh_lights,
)
from shared.compute.read_ahead import work_ahead
from shared.compute.run_context import SILENT, RunContext
from shared.compute.threads import share_out
from shared.geometry.eyeballs import IRIS_MM
from shared.geometry.mesh import Mesh, diffused_over
from shared.geometry.transforms import camera_centres
from shared.imaging.frame_index import spread_frames
from shared.imaging.image_sampling import SurfaceViewer, is_inactive
from shared.imaging.texels import FrameView, SmoothFields, TexelSamples, TexelSurface
from shared.imaging.turning_eyes import EyeTexels
from shared.imaging.views import Views
from shared.rendering.eye_shine import EYE_INTENSITY, EyeShine
from shared.rendering.shading import VertexShading

Result = TypeVar("Result")

_ALBEDO_PULL = 10.0
NEIGHBOUR_STEP, SURROUNDINGS_SPREAD = 0.05, 3.0
"""Standard deviations of the log albedo: from one vertex to the next, and from the person's typical skin."""
CONTRADICTED, LEAST_GAIN = ("as the skin around", "as their mean"), 0.98
"""What bare texels that frames contradict each other about look like, and all whose modelled highlights explain most of
what they send out. Under a hard lamp the model is wrong there in all frames alike, and the skin around is the better
guess; where poses are off, skin moves, or a beard is black, their mean is. Held-out frames share the lamp's errors, and
fit the mean a little better there, too (0.7 %; re-renders + 0.5 dB, albedo - 0.4 dB, relit - 0.3 dB): they have to say
so by a fiftieth."""
REFLECTION = slice(7, 10)
"""Columns of S in the table of a frame's view."""
LIKELY_BRIGHTER = 1.5 * PRIOR_SPREAD
"""By how much a texel's log albedo may lie above its surroundings' before it has to be known to better than 1: an edge
where the mesh is wrong catches a lamp that it should not see. On fair skin that is a white spot, on the darkest one of
20 times the skin's albedo."""
HIDING_SPREAD, LEAST_SEEN = 1.0, 0.001
"""Typical difference in log albedo between skin and what hangs before it, and the least that is believed of the
probability that nothing does."""
SEAM_STEPS = 8
"""Edges over which what no frame shows turns from what it lies beside to what its surroundings suggest."""
BORDER_MM = 6.0
"""Over which it turns from hair to skin."""
HELD_AT_SEAM = 100.0
"""How much more vertices that frames show count there than one edge between two."""
FIRST_PASS_FRAMES = 32
"""Enough to tell what a texel looks like, so that every frame's samples can be weighed by it."""


@dataclass(frozen=True)
class LitSamples:
    """Samples of a frame with E, S and the standard deviation of a typical albedo's radiance by the borders of shadows
    [n, 3] at them."""

    samples: TexelSamples
    irradiance: np.ndarray
    reflection: np.ndarray
    shadow: np.ndarray

    def model(self, material: TexelMaterial) -> np.ndarray:
        """The radiance [n, 3] that the material gives them."""
        return material.radiance(self.samples.rows, self.irradiance, self.reflection)


class TexturePass:
    """Per-texel albedo and specular intensity under a fixed light, roughness and geometry.

    specular: the clip's one intensity, the prior's mean; typical_albedo [3]; sigma: how far a texel may leave it;
    light_weights: how much samples of each light count, by how well the model follows it; empty: all alike;
    region [V] bool: the part of the head that hair may cover, of which skin says nothing, nor it of skin;
    bare [V] bool: bare skin, None: all; of brows, lips or clothes the skin around says nothing, however much frames
    contradict each other there;
    hidden [V]: probability that frames show what hangs before a place, and so say nothing of it; None: nowhere;
    matt [V]: share of what has no highlights of the surface's lobe; None: none has;
    shaded [V]: standard deviation of the log irradiance by shadows that the shading lacks; None: it lacks none;
    eyes: texels that turn with the views' gaze, and of which skin says nothing; None: none do.
    """

    def __init__(
        self,
        surface: TexelSurface,
        viewer: SurfaceViewer,
        shading: VertexShading,
        views: Views,
        specular: float,
        typical_albedo: np.ndarray,
        sigma: float = 0.25,
        noise: Noise | None = None,
        light_weights: Sequence[float] = (),
        region: np.ndarray | None = None,
        bare: np.ndarray | None = None,
        hidden: np.ndarray | None = None,
        matt: np.ndarray | None = None,
        shaded: np.ndarray | None = None,
        context: RunContext = SILENT,
        eyes: EyeTexels | None = None,
    ):
        self.surface, self.viewer, self.shading, self.views, self.eyes = surface, viewer, shading, views, eyes
        self.typical_albedo = typical_albedo
        lights = views.frames_of_lights
        self.light_weights = tuple(light_weights) or (1.0,) * len(lights)
        self.systematic = [
            tuple(error / weight for error in self._systematic(own))
            for own, weight in zip(lights, self.light_weights, strict=True)
        ]
        self.sigma, self.noise, self.progress = sigma, noise or Noise(), context.progress
        self.shines = np.ones(len(surface), np.float32) if matt is None else self._at_texels(1.0 - matt)
        self.seen = None if hidden is None else self._at_texels(1.0 - hidden)
        self.specular, self.lobe = self._with_eyes(specular * self.shines), specular
        self.shaded = 0.0 if shaded is None else self._at_texels(shaded)
        self.region = region
        self.bare = 1.0 if bare is None else surface.interpolate(bare[:, None].astype(np.float32))
        self.hidden_variance = 0.0
        if self.seen is not None:
            seen = np.maximum(self.seen[:, None], LEAST_SEEN)
            self.hidden_variance = np.square(HIDING_SPREAD * (1.0 - seen) / seen)

    def _systematic(self, frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """[T, 3] twice: variance of the log albedo that all frames of one light share, by the irradiance and by the
        normal."""
        surface, shading = self.surface, self.shading
        mean = np.maximum(surface.interpolate(shading.mean_irradiance(frames)), 1e-6)
        turned = NORMAL_ERROR * surface.interpolate(shading.mean_slope(frames)) / mean
        return np.square(IRRADIANCE_ERROR * np.median(mean, axis=0) / mean), np.square(turned)

    def run(self, widths: tuple[float, ...]) -> tuple[TexelMaterial, dict]:
        """Both passes -> the material, and a record of what the held-out frames said to each pooling width."""
        fitted = np.nonzero(self.views.fitted)[0]
        some = fitted[spread_frames(len(fitted), FIRST_PASS_FRAMES, self.views.light_index[fitted])]
        fields = SmoothFields(self.surface.mesh, NEIGHBOUR_STEP, SURROUNDINGS_SPREAD, self.region)
        first, _ = self._close(self._accumulate(None, some, "texture, first pass"), [self.specular], fields)[0]
        evidence = self._accumulate(first, fitted, "texture, second pass")
        pooled = [
            pooled_specular(self.surface, evidence.equations, width, mean=self.specular, sigma=self.sigma)
            for width in widths
        ]
        pooled = [self._with_eyes(self.specular + self.shines * (intensity - self.specular)) for intensity in pooled]
        candidates, around = zip(*self._close(evidence, pooled, fields), strict=True)
        told = evidence.information.max(1)
        # What grows there shines along its strands, as bright as skin does or not at all: the model has none of it.
        strands = (1.0 - self.shines) * evidence.equations.highlight_share(self.lobe).max(1)
        del evidence, fields  # a hundred bytes per texel that the frames to come need
        errors = np.reshape(self.held_out_errors(candidates), (len(CONTRADICTED), len(widths)))
        way = int(errors[1].min() < LEAST_GAIN * errors[0].min())
        best = int(np.argmin(errors[way]))
        names = ["one value" if not np.isfinite(width) else f"{width:g} texels" for width in widths]
        record = {
            "held_out": dict(zip(names, errors[way].tolist(), strict=True)),
            "chosen": names[best],
            "contradicted": {"held_out": dict(zip(CONTRADICTED, errors.min(1).tolist(), strict=True)),
                             "chosen": CONTRADICTED[way]},
        }
        chosen = way * len(widths) + best
        material = self._without_seams(candidates[chosen], around[chosen], told)
        return replace(material, unmodelled=np.square(strands) + np.square(self.shaded)), record

    def _accumulate(self, material: TexelMaterial | None, frames: np.ndarray, label: str) -> Evidence:
        parts = [NormalEquations(len(self.surface), self.noise) for _ in self.systematic]
        borders = [BorderSums(len(self.surface), self.viewer.error_mm) for _ in self.systematic]
        scatters = [ScatterSums(len(self.surface), self.noise) for _ in self.systematic]
        ahead = work_ahead(self.view, self.progress(frames, label))
        for f, view in zip(frames, ahead, strict=True):
            part, border, scatter = (sums[self.views.light_index[f]] for sums in (parts, borders, scatters))
            self._share_out(view, partial(self._add, material, part, border, scatter))
        for part, weight in zip(parts, self.light_weights, strict=True):
            part.scale(weight)
        systematic, irradiance, drawing = [], [], []
        for (level, turned), border, part, scatter in zip(self.systematic, borders, parts, scatters, strict=True):
            behind, shadow = border.variance()[:, None], part.shadow_variance(self.typical_albedo)
            highlight, scattered = part.highlight_variance(self.specular), scatter.variance()
            hidden = self.hidden_variance
            lit, pull = level + turned + behind + shadow + hidden, PULL_OVER_SCATTER * self.bare * scattered
            systematic.append(lit + highlight + ERROR_OVER_SCATTER * scattered)
            irradiance.append(lit + pull)
            # The level is wrong alike all over a cavity: the skin around knows its albedo no better.
            mean = turned + BEHIND_OVER_SKIN**2 * behind + shadow + hidden
            drawing.append((mean + highlight + pull, mean))
        return weigh_lights(parts, systematic, self.typical_albedo, irradiance, drawing)

    def view(self, f: int) -> FrameView:
        """One frame with the values that LitSamples takes."""
        views, shading = self.views, self.shading
        pose, picture, lens = views.camera_from_head[f], views.picture(f), views.intrinsics[f]
        view = self.viewer.view(pose, lens, picture.inside.shape[::-1])
        shadow = shading.shadow_uncertainty(f) * self.typical_albedo.astype(np.float32)
        values = np.concatenate([shading.irradiance(f), shading.reflection(f), shadow], axis=1)
        frame = self.surface.frame_view(view, picture, lens, values)
        if self.eyes is None:
            return frame
        frame = self.eyes.turned(frame, view, views.gaze[f], None if views.lids_px is None else views.lids_px[f])
        moved, camera = frame.moved, camera_centres(pose[None])[0]
        shine = EyeShine(self.viewer, shading, self.eyes.eyes)
        moved.values[:, REFLECTION] = shine.reflection(f, views.gaze[f], camera, moved.face, moved.bary)
        return frame

    def _share_out(self, view: FrameView, work: Callable[[LitSamples], Result]) -> list[Result]:
        """work(samples) for each block of the frame's texels, on several threads -> the results in order."""
        blocks = view.blocks()

        def of_block(k: int) -> Result:
            samples, found = self.surface.samples(view, blocks[k])
            return work(LitSamples(samples, found[:, :3], found[:, 3:6], found[:, 6:]))

        return share_out(len(blocks), of_block)

    def _add(
        self, material: TexelMaterial | None, part: NormalEquations, border: BorderSums, scatter: ScatterSums,
        lit: LitSamples,
    ) -> None:
        """A block's samples to its light's sums; without a material every sample that is not at a limit counts, and
        nothing is known of how frames scatter."""
        samples = lit.samples
        if material is None:
            robust = (samples.saturation == 0).astype(np.float32)
        else:
            model = lit.model(material)
            robust = robust_weight(model, samples, self.noise, material.information, lit.shadow)
            scatter.add(samples, model, material.albedo[samples.rows] * lit.irradiance, lit.shadow)
        part.add(samples, lit.irradiance, lit.reflection, robust, lit.shadow)
        border.add(samples)

    def _close(
        self, evidence: Evidence, intensities: list[np.ndarray], fields: SmoothFields
    ) -> list[tuple[TexelMaterial, np.ndarray]]:
        """Albedo for each way to draw texels and, inside it, each of some given intensities [T], with the log albedo
        around [V, 3] that it was drawn to."""
        equations, information = evidence.equations, evidence.information
        rough = [equations.solve_albedo(specular, 0.0, 1e-6) for specular in intensities]
        around = self._surroundings(rough, information, fields).astype(np.float32)
        brightest = np.maximum(equations.brightest_albedo(evidence.irradiance), LEAST_ALBEDO)
        ways = list(product(evidence.drawing, range(len(intensities))))

        def drawn(n: int) -> tuple[TexelMaterial, np.ndarray]:
            drawing, k = ways[n]
            albedo = self._drawn(evidence, drawing, intensities[k], rough[k], around[..., k])
            albedo = np.minimum(albedo, brightest).astype(np.float32)
            return TexelMaterial(albedo, intensities[k], information.min(1)), around[..., k]

        return share_out(len(ways), drawn)

    def _drawn(
        self, evidence: Evidence, drawing: np.ndarray, specular: np.ndarray, rough: np.ndarray, around: np.ndarray
    ) -> np.ndarray:
        """[T, 3] albedo of texels of some specular intensity [T], as their samples alone have it [T, 3] and as far as
        the variance of these [T, 3] lets them be drawn to the log albedo around [V, 3]; channels left open by the
        samples follow the others and the neighbourhood.

        A channel whose samples have the share q of its albedo leaves 1 - q to a fallback. The texel's brightness b
        beside its neighbourhood, by all channels, is believed by their share q': the fallback has b (q' - q) / (1 - q)
        of it, so that channels that know alike get what their own samples say once, and one that is clipped gets q' b.
        What lies beyond LIKELY_BRIGHTER than the surroundings counts by how well it is known.
        """
        equations, information = evidence.equations, evidence.information
        pull = _ALBEDO_PULL + equations.ee * (drawing / PRIOR_SPREAD**2)
        own = equations.ee / (equations.ee + pull)
        certain = own * information / (1.0 + information)
        total = np.maximum(certain.sum(1, keepdims=True), 1e-9)
        believed = (certain * own).sum(1, keepdims=True) / total
        left = np.clip(believed - own, 0.0, 1.0) / np.maximum(1.0 - own, 1e-3)
        smooth = np.exp(self.surface.interpolate(around))
        if self.eyes is not None:
            smooth[self.eyes.rows] = self._round_eyes(rough, information)
        brighter = (certain * np.log(np.maximum(rough, 1e-3) / smooth)).sum(1, keepdims=True) / total
        albedo = equations.drawn_albedo(specular, smooth * np.exp(brighter * left), _ALBEDO_PULL, drawing)
        beyond = np.maximum(np.log(albedo / smooth) - LIKELY_BRIGHTER, 0.0)
        if self.eyes is not None:
            beyond[self.eyes.rows] = 0.0
        return albedo * np.exp(-beyond / (1.0 + np.square(information)))

    def _without_seams(self, material: TexelMaterial, around: np.ndarray, told: np.ndarray) -> TexelMaterial:
        """The material with what no frame shows going on from what lies beside it, where the log albedo around it [V,
        3] is another: by the membrane that the differences on both sides of the seam span, which sinks to nothing.
        told [T]: information on the log albedo, of the channel that is known best."""
        known = known_share(told)
        if self.eyes is not None:
            known[self.eyes.rows] = 0.0
        apart = np.log(np.maximum(material.albedo, LEAST_ALBEDO)) - self.surface.interpolate(around)
        means, weight = self.surface.to_vertices(apart, np.repeat(known[:, None], 3, axis=1))
        membrane = SmoothFields(self.surface.mesh, 1.0, SEAM_STEPS, self.region)
        step = membrane.through(means, HELD_AT_SEAM * weight, np.zeros(3))
        if self.region is not None:
            step = _across_border(around + step, self.region, self.surface.mesh) - around
        step = self.surface.interpolate(step)
        filled = np.clip(material.albedo * np.exp((1.0 - known[:, None]) * step), LEAST_ALBEDO, 1.0)
        if self.eyes is not None:
            filled[self.eyes.rows] = material.albedo[self.eyes.rows]
        return replace(material, albedo=filled.astype(np.float32))

    def _with_eyes(self, intensity: np.ndarray) -> np.ndarray:
        """Specular intensity [T] with the eyeballs' own."""
        if self.eyes is not None:
            intensity = intensity.copy()
            intensity[self.eyes.rows] = EYE_INTENSITY
        return intensity

    def _at_texels(self, values: np.ndarray) -> np.ndarray:
        """Vertex values [V] at the texels [T]."""
        return self.surface.interpolate(values[:, None])[:, 0]

    def _round_eyes(self, rough: np.ndarray, information: np.ndarray) -> np.ndarray:
        """[E, 3] albedo of the eyeballs' texels as those at the same angle have it, of a result [T, 3]."""
        eyes = self.eyes
        angle = np.arccos(np.clip(eyes.directions[:, 2], -1.0, 1.0))
        iris = np.arcsin(IRIS_MM / np.mean([ball.radius for ball in eyes.eyes.balls]))
        known = np.log(np.maximum(rough[eyes.rows], 1e-3))
        return np.exp(round_albedo(angle, float(iris), known, information[eyes.rows]))

    def _surroundings(self, rough: list[np.ndarray], information: np.ndarray, fields: SmoothFields) -> np.ndarray:
        """[V, 3, K] log albedo as smooth fields, of K results [T, 3]: texels that the clip tells little of follow
        those that it knows.

        Brightness and colour are smooth each for itself, both relative to the person's typical skin: a channel that is
        clipped everywhere takes its brightness from the others that are not, its tint from where all are known.
        """
        typical = np.log(np.maximum(self.typical_albedo, 1e-3)).astype(np.float32)
        precision = np.minimum(information, NEIGHBOUR_STEP**-2)
        total = np.maximum(precision.sum(1, keepdims=True), 1e-12)
        share = precision / total
        known = np.concatenate([total, precision * (1.0 - share)], axis=1)
        means = []
        for albedo in rough:
            relative = np.log(np.maximum(albedo, 1e-3)) - typical
            level = (share * relative).sum(1, keepdims=True)
            means.append(self.surface.to_vertices(np.concatenate([level, relative - level], axis=1), known)[0])
        field = self._field(np.stack(means, axis=-1), known, fields)
        return typical[:, None] + field[:, :1] + field[:, 1:]

    def _field(self, means: np.ndarray, precision: np.ndarray, fields: SmoothFields) -> np.ndarray:
        """Vertex values [V, C, K], means of texels of some precision [T, C] -> the smooth fields [V, C, K] through
        them; far from any 0, the typical skin, and in the other region what is known of that in the mean: hair is
        continued as hair."""
        share, _ = self.surface.to_vertices(precision, np.ones_like(precision))
        # What leaves a texel as open as the prior does is mostly a model's error that its neighbours share.
        known = share**2 / (share + PRIOR_SPREAD**-2)
        usual = np.zeros_like(means)
        if self.region is not None:
            own = known[self.region, :, None]
            total = own.sum(0)
            usual[self.region] = (own * means[self.region]).sum(0) / np.where(total > 0.0, total, 1.0)
        return usual + fields.through(means - usual, known, np.zeros(precision.shape[1]))

    def held_out_errors(self, candidates: list[TexelMaterial]) -> list[float]:
        """Root mean square residual of each candidate on the held-out frames (linear, censored, weighted), where
        nothing hangs before the head."""
        sums = np.zeros(1 + len(candidates))
        frames = self.progress(np.nonzero(~self.views.fitted)[0], "texture, held-out frames")
        for view in work_ahead(self.view, frames):
            sums += sum(self._share_out(view, lambda lit: _squared_errors(candidates, lit, self.seen)))
        return [float(value) for value in np.sqrt(sums[1:] / max(3.0 * sums[0], 1e-9))]


def _across_border(field: np.ndarray, region: np.ndarray, mesh: Mesh) -> np.ndarray:
    """A field [V, C] that ends at the border of a region [V] bool, turning over from one side's values to the
    other's."""
    spread = diffused_over(mesh, np.concatenate([region[:, None], field], axis=1), BORDER_MM)
    share, smooth = spread[:, :1], spread[:, 1:]
    return field + 4.0 * share * (1.0 - share) * (smooth - field)


def _squared_errors(candidates: list[TexelMaterial], lit: LitSamples, seen: np.ndarray | None) -> np.ndarray:
    """The samples' total weight and each candidate's sum of squared residuals; seen [T]: how much texels count, None:
    all alike."""
    samples = lit.samples
    weight = samples.weight if seen is None else samples.weight * seen[samples.rows]
    sums = [weight.sum()]
    for material in candidates:
        error = lit.model(material) - samples.colours
        error[is_inactive(samples.saturation, error)] = 0.0
        sums.append((weight[:, None] * np.minimum(error**2, 0.01)).sum())
    return np.array(sums, float)
