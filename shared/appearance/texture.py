"""Albedo and specular intensity per texel, from all frames, in closed form.

Frames stream through: each adds its share to every texel's normal equations, so memory depends on the map's size
alone (100 bytes per texel). With the light, the roughness and the geometry given, a texel's radiance is linear in its
albedo a [3] and its specular intensity s:  I = a E + s S. A second pass over the frames weighs each sample by how well
the first pass's result explains it (Cauchy), which leaves out hair, blinks and what slid by.

The intensity of a single texel is poorly determined, but it varies slowly over skin: its equations (albedo
eliminated) are summed over a neighbourhood on the map before they are solved. How wide is chosen on held-out frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter

from shared.appearance.projection import SPECULAR_RANGE
from shared.compute.compiled import compiled, compiled_part
from shared.imaging.image_sampling import BALL_MM, is_inactive
from shared.imaging.texels import TexelSamples, TexelSurface

CORRELATED_FRAMES = 6.0
"""Errors of neighbouring frames are alike: so many frames count as one independent observation."""

PRIOR_SPREAD = 0.3
"""Standard deviation of a texel's log albedo if all one knew were the person's mean."""
DEGREES, DRAWING_STEPS = 9.0, 4
"""Degrees of freedom of a texel's log albedo about its surroundings: most follow them, a mole, a hair or the edge of
a beard leaves them by far. So many steps find how far."""

IRRADIANCE_ERROR = 0.03
"""Error of the modelled irradiance, relative to the face's mean: bounces, visibility and shape are so good at best.
In a cavity that gets a tenth of the light it leaves the albedo open by a third."""

NORMAL_ERROR = 0.05
"""Error of a normal in radians: what a refined mesh still lacks. Where light grazes the skin it passes for albedo."""

HIGHLIGHT_ERROR = 0.1
"""Error of a modelled highlight, relative to itself."""

LEAST_MATTE_SHARE = 0.05
"""Of what a texel sends out, where its modelled highlights leave less or nothing."""

DEVIATIONS_ABOVE, LEAST_UNCLIPPED = 2.0, 0.5
"""So many deviations of the modelled light may an albedo lie above what its samples would have without any highlight,
of a texel of whose samples that share is not clipped."""

LEAST_BORDER_MM = 0.5
"""Error of where the head's outline lies, however well its surface is known."""
BEHIND_OVER_SKIN = 0.5
"""Typical difference in log radiance between what lies behind the head and the skin before it, by whose square texels
near the border are drawn to their surroundings. How far they may be believed counts 1, for any background."""

ERROR_OVER_SCATTER = 5.0
"""Variance of a texel's log albedo over the relative variance of what single frames say of it: what is wrong in some
frames (a normal, the place of a shadow) mostly is wrong the same way in the others. Measured under hard lamps: 9 where
frames contradict each other by 7 %, 6 by 15 %, 4 by 40 %."""
PULL_OVER_SCATTER = 1.0
"""The same by which bare skin follows its surroundings. Less: of real skin that moves, frames contradict each other
about what is there, a fold or a mole, and their mean is a better guess of it than the skin around (0.6 dB of real
held-out frames, for 0.15 dB of albedo under a hard lamp)."""

LEAST_ALBEDO = 0.002
LEAST_KNOWN = 0.1
"""Information on a texel's log albedo from which on it is rather known than not."""

PRODUCTS = 7
"""That the normal equations sum up per channel."""

POOL = 1.0
"""Texels of a neighbourhood that count as independent for the specular intensity: errors of shape and light are as
wide as the neighbourhood itself."""


@dataclass(frozen=True)
class Noise:
    """Standard deviation of a sample: absolute + relative * radiance."""

    absolute: float = 0.006
    relative: float = 0.03

    def precision(self, colours: np.ndarray) -> np.ndarray:
        """Inverse variance of colours [n, 3], linear, in their shape."""
        return 1.0 / np.square(self.absolute + self.relative * colours)


@dataclass(frozen=True)
class TexelMaterial:
    """albedo [T, 3] and specular [T] of the texels, information [T]: precision of the log albedo by
    the samples, in the channel that they determine least; unmodelled [T]: variance of it by what the model does not
    have, of which the samples say nothing; None: by nothing."""

    albedo: np.ndarray
    specular: np.ndarray
    information: np.ndarray
    unmodelled: np.ndarray | None = None

    def radiance(self, rows: np.ndarray, irradiance: np.ndarray, reflection: np.ndarray) -> np.ndarray:
        """a E + s S of the texels rows [n]; irradiance E [n, 3], reflection S [n, 3] -> [n, 3] float32."""
        sent = np.empty(irradiance.shape, np.float32)
        _radiance(self.albedo, self.specular, rows, irradiance, reflection, sent)
        return sent


@compiled
def _radiance(albedo, specular, rows, irradiance, reflection, sent):
    for i in range(len(rows)):
        for c in range(3):
            sent[i, c] = albedo[rows[i], c] * irradiance[i, c] + specular[rows[i]] * reflection[i, c]


def known_share(information: np.ndarray) -> np.ndarray:
    """[T] in 0 .. 1: how far texels are known, by their information on the log albedo [T]."""
    return information / (information + LEAST_KNOWN)


class NormalEquations:
    """Sums over frames per texel and channel of weighted products of E, S and the colour I.

    sums [T, 21]: EE, ES, EI, SS and SI side by side, then EE of the samples that are neither clipped nor crushed, and
    the variance that borders of shadows give a sample, three channels each, so that a frame is added in one go;
    clipped_ee [T, 3]: EE of clipped samples, their bounds active or not.
    """

    def __init__(self, texels: int, noise: Noise):
        self.noise, self.sums = noise, np.zeros((texels, 3 * PRODUCTS), np.float32)
        self.clipped_ee = np.zeros((texels, 3), np.float32)
        columns = (self.sums[:, 3 * k : 3 * k + 3] for k in range(PRODUCTS))
        self.ee, self.es, self.ei, self.ss, self.si, self.measured_ee, self.shadow = columns

    def add(
        self,
        samples: TexelSamples,
        irradiance: np.ndarray,
        reflection: np.ndarray,
        robust: np.ndarray,
        shadow: np.ndarray | None = None,
    ) -> None:
        """irradiance, reflection, robust, shadow [n, 3] at samples.rows; robust: extra weight per channel; shadow:
        standard deviation of the modelled radiance, since borders of shadows may lie elsewhere; None: of none."""
        shadow = np.zeros_like(irradiance) if shadow is None else shadow
        absolute, relative = np.float32(self.noise.absolute), np.float32(self.noise.relative)
        _add_samples(
            samples.rows, samples.weight, samples.colours, samples.saturation, irradiance, reflection, robust, shadow,
            absolute, relative, self.sums, self.clipped_ee,
        )

    def solve_albedo(self, specular: np.ndarray, fallback: np.ndarray, pull: float | np.ndarray) -> np.ndarray:
        """Albedo [T, 3] for given specular [T]; fallback [T, 3] acts with precision pull, a number or [T, 3]."""
        moment = self.ei - specular[:, None] * self.es
        return np.clip((moment + pull * fallback) / (self.ee + pull), LEAST_ALBEDO, 1.0).astype(np.float32)

    def drawn_albedo(
        self, specular: np.ndarray, around: np.ndarray, pull: float, variance: np.ndarray
    ) -> np.ndarray:
        """Albedo [T, 3] for given specular [T], between what the samples say and the albedo around [T, 3].

        The samples say its logarithm with variance [T, 3], however many they are; about the logarithm around them it
        has Student's t distribution in the three channels together. Its mode is that of a normal prior of variance
        PRIOR_SPREAD^2 + |x|^2 / (DEGREES + 3) for a texel that is off by x [3] ([Lange1989], section 2). pull:
        precision of the albedo around beside the samples', so that texels without any have it.
        """
        albedo = self.solve_albedo(specular, around, pull)
        numbers = np.array([PRIOR_SPREAD**2, DEGREES], np.float32)
        _draw(albedo, np.maximum(around, LEAST_ALBEDO).astype(np.float32), variance.astype(np.float32), numbers)
        return albedo

    def brightest_albedo(self, variance: np.ndarray) -> np.ndarray:
        """[T, 3]: an albedo may not send out more than its samples show, highlights or not; variance [T, 3]: of the
        logarithm of the modelled irradiance; infinite where the samples are mostly clipped or none. A black beard under
        the highlights of skin has an albedo that they leave open, but not that of the skin around it."""
        told = (self.ee > 1e-6) & (self._spared() > LEAST_UNCLIPPED)
        matt = self.ei / np.maximum(self.ee, 1e-6)
        above = np.minimum(DEVIATIONS_ABOVE * np.sqrt(variance), 10.0)  # e^10 bounds nothing, and overflows nothing
        return np.where(told, matt * np.exp(above), np.inf)

    def specular_equations(self) -> tuple[np.ndarray, np.ndarray]:
        """Curvature and moment [T] of each texel's intensity with its albedo projected out, summed over channels."""
        ratio = self.es / np.maximum(self.ee, 1e-6)
        return np.maximum((self.ss - ratio * self.es).sum(1), 0.0), (self.si - ratio * self.ei).sum(1)

    def information(self, typical_albedo: np.ndarray, systematic: np.ndarray) -> np.ndarray:
        """[T, 3] precision of the log albedo per channel, with correlated frames taken together.

        A clipped sample only says "at least so much": it moves the albedo but measures nothing, and what is not
        clipped of a texel that mostly is are its darkest samples, which say too little. Where little light arrives a
        small error makes a large albedo: typical_albedo [3] bounds what counts; systematic [T, 3]: variance that all
        frames share.
        """
        albedo = self._bounded_albedo(typical_albedo)
        measured = np.square(self._spared()) * self.measured_ee
        return 1.0 / (systematic + CORRELATED_FRAMES / np.maximum(measured * albedo**2, 1e-9))

    def shadow_variance(self, typical_albedo: np.ndarray) -> np.ndarray:
        """[T, 3] of the log albedo, since borders of shadows may lie elsewhere: in all frames the same mesh casts
        them. typical_albedo [3]: what the samples' variance was reckoned with."""
        return self.shadow / np.maximum(self.ee * np.square(typical_albedo), 1e-9)

    def highlight_variance(self, specular: float | np.ndarray) -> np.ndarray:
        """[T, 3] of the log albedo, since highlights of intensity `specular`, one or [T], are wrong by HIGHLIGHT_ERROR
        of themselves: little where they are a small share of what a texel sends out, all of it in hair that the model
        gives a skin's specular intensity."""
        share = self.highlight_share(specular)
        return np.square(HIGHLIGHT_ERROR * share / np.maximum(1.0 - share, LEAST_MATTE_SHARE))

    def highlight_share(self, specular: float | np.ndarray) -> np.ndarray:
        """[T, 3]: of what a texel sends out, by highlights of intensity `specular`, one or [T]."""
        return np.reshape(specular, (-1, 1)) * self.es / np.maximum(self.ei, 1e-9)

    def _spared(self) -> np.ndarray:
        """[T, 3]: share of the samples that is not clipped, by EE."""
        return self.measured_ee / np.maximum(self.measured_ee + self.clipped_ee, 1e-9)

    def _bounded_albedo(self, typical_albedo: np.ndarray) -> np.ndarray:
        return np.minimum(self.ei / np.maximum(self.ee, 1e-6), typical_albedo)

    def scale(self, factor: float) -> None:
        """All weights times factor."""
        if factor != 1.0:
            self.sums *= factor
            self.clipped_ee *= factor

    def independent_share(self, typical_albedo: np.ndarray, systematic: np.ndarray) -> np.ndarray:
        """[T, 3]: how much of their weight errors that all frames share leave to the equations, among those of other
        lights. typical_albedo [3]; systematic [T, 3]: variance of the log albedo that all frames share."""
        precision = self.ee * np.square(self._bounded_albedo(typical_albedo)) / CORRELATED_FRAMES
        return 1.0 / (1.0 + precision * systematic)


@dataclass(frozen=True)
class Evidence:
    """What the frames of all lights say: equations, information [T, 3] on the log albedo, and variances of it [T, 3]
    that frames share, however many there are: one for each way to draw texels to their surroundings, and that of the
    modelled irradiance."""

    equations: NormalEquations
    information: np.ndarray
    drawing: tuple[np.ndarray, ...]
    irradiance: np.ndarray


def weigh_lights(
    parts: Sequence[NormalEquations],
    systematic: Sequence[np.ndarray],
    typical_albedo: np.ndarray,
    irradiance: Sequence[np.ndarray] | None = None,
    drawing: Sequence[Sequence[np.ndarray]] | None = None,
) -> Evidence:
    """The equations of each light with the variance [T, 3] that its frames share -> of all lights together.

    For each light: irradiance: the part of that variance [T, 3] which is the modelled irradiance's; drawing: for each
    way, the variance [T, 3] that draws texels to their surroundings. None: all of it, in one way.

    Where one light grazes or hardly reaches a texel another one decides: two lights' errors have nothing in common.
    """
    irradiance = systematic if irradiance is None else irradiance
    drawing = [(error,) for error in systematic] if drawing is None else drawing
    variances = [(*ways, error) for ways, error in zip(drawing, irradiance, strict=True)]
    information = sum(own.information(typical_albedo, error) for own, error in zip(parts, systematic, strict=True))
    if len(parts) == 1:
        *ways, lit = variances[0]
        return Evidence(parts[0], information, tuple(ways), lit)
    whole = NormalEquations(len(information), parts[0].noise)
    left = [np.zeros_like(information) for _ in variances[0]]
    for own, error, shared in zip(parts, systematic, variances, strict=True):
        share = own.independent_share(typical_albedo, error)
        whole.sums += own.sums * np.tile(share, PRODUCTS)
        whole.clipped_ee += own.clipped_ee * share
        for sums, variance in zip(left, shared, strict=True):
            sums += np.square(own.ee * share) * variance
    *ways, lit = (sums / np.maximum(np.square(whole.ee), 1e-12) for sums in left)
    return Evidence(whole, information, tuple(ways), lit)


class BorderSums:
    """How near its border the head shows each of T texels, over the frames: sums [2, T] of samples and weights.
    error_mm: how far the surface may be off."""

    def __init__(self, texels: int, error_mm: float):
        self.sums, self.error = np.zeros((2, texels), np.float32), max(error_mm, LEAST_BORDER_MM) / (0.5 * BALL_MM)

    def add(self, samples: TexelSamples) -> None:
        """One frame; weights are squared cosines of the view, less near the mask's border."""
        self.sums[0, samples.rows] += 1.0
        self.sums[1, samples.rows] += samples.weight

    def variance(self) -> np.ndarray:
        """[T] of the log albedo. At a view cosine c the border is BALL_MM c^2 / 2 away: the outline's error over that
        is the share of a sample that shows what lies behind, its mean over the frames weighted as the albedo is."""
        count, weight = self.sums
        return np.square(self.error * count / np.maximum(weight, 1e-3))


class ScatterSums:
    """By how much frames contradict each other about each of T texels. sums [T, 12]: of e^2, e m and m^2 by the
    precision of the samples, three channels each, and of their weights, with m the modelled diffuse radiance and e the
    model's error. Robust weights would leave out the very samples that count here, and bounds contradict nothing."""

    def __init__(self, texels: int, noise: Noise):
        self.noise, self.sums = noise, np.zeros((texels, 12), np.float32)

    def add(self, samples: TexelSamples, model: np.ndarray, matt: np.ndarray, shadow: np.ndarray) -> None:
        """One frame: model [n, 3] radiance, matt [n, 3] its diffuse part, shadow [n, 3] its standard deviation since
        borders of shadows may lie elsewhere."""
        numbers = np.array([self.noise.absolute, self.noise.relative], np.float32)
        _add_errors(samples.rows, samples.weight, samples.colours, samples.saturation, model, matt, shadow, numbers,
                    self.sums)

    def variance(self) -> np.ndarray:
        """[T, 3]: relative variance of what single frames say of the albedo: of errors beyond a common factor, which is
        the albedo's, and beyond the samples' noise."""
        squared, along, power, weight = (self.sums[:, 3 * k : 3 * k + 3] for k in range(4))
        power = np.maximum(power, 1e-6)
        return np.maximum(squared - along**2 / power - weight, 0.0) / power


@compiled
def _draw(albedo, around, variance, numbers):
    spread, degrees = numbers
    left = np.empty(3, np.float32)
    for i in range(len(albedo)):
        squared = np.float32(0.0)
        for _ in range(DRAWING_STEPS + 1):
            prior = spread + squared / (degrees + np.float32(3.0))
            squared = np.float32(0.0)
            for c in range(3):
                left[c] = prior / (prior + variance[i, c]) * np.log(albedo[i, c] / around[i, c])
                squared += left[c] * left[c]
        for c in range(3):
            albedo[i, c] = min(around[i, c] * np.exp(left[c]), np.float32(1.0))


@compiled
def _add_errors(rows, weight, colours, saturation, model, matt, shadow, numbers, sums):
    absolute, relative = numbers
    for i in range(len(rows)):
        row = rows[i]
        for c in range(3):
            if saturation[i, c] != 0:
                continue
            sigma, border = absolute + relative * colours[i, c], shadow[i, c]
            precision = weight[i] / (sigma * sigma + border * border)
            error, diffuse = model[i, c] - colours[i, c], matt[i, c]
            sums[row, c] += precision * error * error
            sums[row, 3 + c] += precision * error * diffuse
            sums[row, 6 + c] += precision * diffuse * diffuse
            sums[row, 9 + c] += weight[i]


@compiled
def _add_samples(
    rows, weight, colours, saturation, irradiance, reflection, robust, shadow, absolute, relative, sums, clipped_ee
):
    for i in range(len(rows)):
        row = rows[i]
        for c in range(3):
            colour, e, s = colours[i, c], irradiance[i, c], reflection[i, c]
            sigma, border = absolute + relative * colour, shadow[i, c]
            precision = weight[i] / (sigma * sigma + border * border)
            weighted = precision * robust[i, c]
            sums[row, c] += weighted * e * e
            sums[row, 3 + c] += weighted * e * s
            sums[row, 6 + c] += weighted * e * colour
            sums[row, 9 + c] += weighted * s * s
            sums[row, 12 + c] += weighted * s * colour
            sums[row, 18 + c] += weighted * border * border
            if saturation[i, c] == 0:
                sums[row, 15 + c] += weighted * e * e
            elif saturation[i, c] > 0:
                clipped_ee[row, c] += precision * e * e


def robust_weight(
    model: np.ndarray,
    samples: TexelSamples,
    noise: Noise,
    information: np.ndarray,
    shadow: np.ndarray | None = None,
    scale: float = 2.5,
) -> np.ndarray:
    """Cauchy weight [n, 3] of each sample given the model [n, 3]; 0 where a clipped or crushed sample's bound is
    inactive.

    A frame shows a texel in all channels or in none, so the channel that fits worst decides, and of clipped or crushed
    ones those that are neither: where a neck whose red burns out is hidden by a collar in some frames, red would know
    the collar alone, and green and blue the neck.

    information [T]: precision of the model's log albedo; what it leaves open does not lower a sample's weight; shadow
    [n, 3]: standard deviation of the model since borders of shadows may lie elsewhere; None: of none. scale: of the
    Cauchy loss, in standard deviations.
    """
    shadow, weight = np.zeros_like(model) if shadow is None else shadow, np.empty_like(model)
    numbers = np.array([noise.absolute, noise.relative, PRIOR_SPREAD**-2, scale**-2], np.float32)
    _weigh_samples(model, samples.colours, samples.saturation, samples.rows, information, shadow, numbers, weight)
    return weight


_is_inactive = compiled_part(is_inactive)


@compiled
def _weigh_samples(model, colours, saturation, rows, information, shadow, numbers, weight):
    absolute, relative, prior, tightness = numbers
    for i in range(len(model)):
        openness, least, measured = np.float32(1.0) / (information[rows[i]] + prior), np.float32(1.0), False
        for c in range(3):
            error, sigma = model[i, c] - colours[i, c], absolute + relative * colours[i, c]
            variance = sigma * sigma + model[i, c] * model[i, c] * openness + shadow[i, c] * shadow[i, c]
            weight[i, c] = variance / (variance + tightness * error * error)
            if saturation[i, c] == 0:
                least, measured = min(least, weight[i, c]), True
        for c in range(3):
            if _is_inactive(saturation[i, c], model[i, c] - colours[i, c]):
                weight[i, c] = 0.0
            elif measured:
                weight[i, c] = least


def pooled_specular(
    surface: TexelSurface, equations: NormalEquations, width: float, mean: float, sigma: float
) -> np.ndarray:
    """Intensity [T]: the equations summed over a Gaussian of width texels, with a normal prior.

    Infinite width: one value everywhere, the prior's mean. mean, sigma: of the prior.
    """
    if not np.isfinite(width):
        return np.full(len(surface), mean, np.float32)
    curvature, moment = equations.specular_equations()
    spread = [_blurred(surface.to_image(x / CORRELATED_FRAMES), width) for x in (curvature, moment)]
    curvature, moment = (image.ravel()[surface.pixel] for image in spread)
    value = (POOL * moment + mean / sigma**2) / (POOL * curvature + 1.0 / sigma**2)
    return np.clip(value, *SPECULAR_RANGE).astype(np.float32)


def _blurred(image: np.ndarray, width: float) -> np.ndarray:
    """A Gaussian of width texels over the image [S, S]. Wide ones pass over means of blocks, a fourth as wide at most,
    which widens them by less than 1 %."""
    block = 1
    while 8 * block <= width and image.shape[0] % (2 * block) == 0:
        block *= 2
    size = image.shape[0] // block
    means = image.reshape(size, block, size, block).mean((1, 3))
    return cv2.resize(gaussian_filter(means, width / block), image.shape, interpolation=cv2.INTER_LINEAR)
