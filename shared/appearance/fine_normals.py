"""Relief finer than the mesh, per texel, as a tangent-space normal map.

With light, reflectance and mesh given, a texel's residual changes by the turn (k1, k2) of its normal towards the two
directions of the texture, as in shared/shape/equations.py; its albedo is eliminated per channel. What a vertex's
neighbourhood shares in a frame is laid to light, pose and mesh: only finer relief counts. Equations are pooled over
what the pictures resolve, so that no texel claims more, and the turn has a prior of none. Held-out frames say how wide
the prior is and what share of the relief is true.

Reference: [Horn1975] (shape from shading).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter

from shared.appearance.texture import CORRELATED_FRAMES, Noise, TexelMaterial, robust_weight
from shared.compute.compiled import compiled
from shared.compute.read_ahead import work_ahead
from shared.compute.run_context import SILENT, RunContext
from shared.compute.threads import share_out
from shared.geometry.mesh import normalised, uv_tangents, vertex_adjacency
from shared.imaging.frame_index import spread_frames
from shared.imaging.image_sampling import SurfaceViewer
from shared.imaging.texels import FrameView, TexelSurface
from shared.imaging.views import Views
from shared.rendering.irradiance_errors import irradiance_vectors
from shared.rendering.normal_derivatives import Reflections
from shared.rendering.shading import VertexShading

FRAMES = 32
_TOGETHER = 8
RESOLVED_PX, WIDTH_OF_DEVIATION = 2.0, 2.355
"""Lenses and codecs resolve no single pixel. A Gaussian's width at half height is 2.355 standard deviations."""
LEAST_POOL = 0.5
PRIORS = (0.05, 0.1, 0.2, 0.4)
"""Standard deviations in radians of what the mesh leaves out of the skin's normals; held-out frames choose."""
LARGEST_TURN = 1.0
"""Tangent of the largest angle between the map's normal and the mesh's."""


@dataclass(frozen=True)
class ReliefEquations:
    """Per texel, albedo projected out: hessian [T, 3] (k1 k1, k1 k2, k2 k2) and gradient [T, 2] of the cost of a
    turn."""

    hessian: np.ndarray
    gradient: np.ndarray

    def confirmed(self, turn: np.ndarray, patch: np.ndarray) -> tuple[float, float]:
        """What share of the turns [T, 2] of all texels, 0 to 1, lowers the cost, and by how much.

        patch [T] int: texels whose errors go together. What they say of the slope scatters; of it one standard
        deviation is taken off, so that relief which noise alone would confirm as often as not is none. turn [T, 2]
        radians.
        """
        (a11, a12, a22), (k1, k2) = self.hessian.T.astype(np.float64), turn.T.astype(np.float64)
        curvature = float((a11 * k1**2 + 2.0 * a12 * k1 * k2 + a22 * k2**2).sum())
        slopes = np.bincount(patch, (self.gradient * turn).sum(1, dtype=np.float64))
        descent = max(-float(slopes.sum()) - float(np.linalg.norm(slopes)), 0.0)
        share = min(descent / max(curvature, 1e-9), 1.0)
        return share, share * (descent - 0.5 * share * curvature)


@dataclass(frozen=True)
class LinearSamples:
    """Samples of one frame at the texels rows [n]: E, residuals, the model's scale and the weights [n, 3], derivatives
    of the residuals by the turn [n, 3, 2]."""

    rows: np.ndarray
    irradiance: np.ndarray
    error: np.ndarray
    scale: np.ndarray
    derivative: np.ndarray
    weight: np.ndarray


class ReliefSums:
    """Sums over frames of weighted products of E, the derivatives d1, d2 by the turn, and the residual r, for T texels.

    per_channel [T, 12]: EE, E d1, E d2, E r, three channels each; together [T, 5]: d1 d1, d1 d2, d2 d2, d1 r, d2 r.
    """

    def __init__(self, texels: int):
        self.per_channel, self.together = np.zeros((texels, 12), np.float32), np.zeros((texels, 5), np.float32)

    def add(self, samples: LinearSamples, residual: np.ndarray) -> None:
        """Samples with the residual [n, 3] to explain, linear."""
        _add_products(
            samples.rows, samples.irradiance, samples.derivative, residual, samples.weight, self.per_channel,
            self.together
        )

    def equations(self) -> ReliefEquations:
        """With the albedo projected out."""
        ee, e1, e2, er = (self.per_channel[:, 3 * k : 3 * k + 3] for k in range(4))
        ee = np.maximum(ee, 1e-6)
        products = [(left * right / ee).sum(1) for left, right in ((e1, e1), (e1, e2), (e2, e2), (e1, er), (e2, er))]
        left = self.together - np.stack(products, axis=1)
        return ReliefEquations(left[:, :3], left[:, 3:])


class NormalPass:
    """Per-texel normals under a fixed light, reflectance and mesh. material: the texels', from the texture pass."""

    def __init__(
        self,
        surface: TexelSurface,
        viewer: SurfaceViewer,
        shading: VertexShading,
        views: Views,
        material: TexelMaterial,
        context: RunContext = SILENT,
        noise: Noise | None = None,
    ):
        self.surface, self.viewer, self.shading, self.views = surface, viewer, shading, views
        self.material, self.progress, self.noise = material, context.progress, noise or Noise()
        self.reflections = Reflections(shading, np.arange(len(shading.points)))
        normals = normalised(surface.interpolate(viewer.normals))
        self.tangents = uv_tangents(surface.mesh, normals, surface.face, surface.bary)
        self.corner = surface.mesh.faces[surface.face, surface.bary.argmax(1)]
        adjacency = vertex_adjacency(surface.mesh.faces, len(surface.mesh.vertices))
        self.around = adjacency + 1.0 * (adjacency @ adjacency > 0)

    def run(self, pool: float) -> tuple[np.ndarray, dict]:
        """Turns [T, 2], tangents of angles towards growing u and v, and a record. pool: standard width over which
        texels count together, in texels."""
        fitted, held_out = (np.nonzero(chosen)[0] for chosen in (self.views.fitted, ~self.views.fitted))
        equations = self.pooled(self.accumulate(fitted[spread_frames(len(fitted), FRAMES)]), pool)
        unseen = self.accumulate(held_out[spread_frames(len(held_out), FRAMES // 4)])
        turns = [most_likely_turns(equations, prior) for prior in PRIORS]
        shares, gains = zip(*(unseen.confirmed(turn, self.corner) for turn in turns), strict=True)
        best = int(np.argmax(gains))
        turn = turns[best] * np.float32(shares[best])
        angle = np.degrees(np.arctan(np.linalg.norm(turn[self.material.information > 1.0], axis=1)))
        typical, large = np.percentile(angle, [50, 95]) if len(angle) else (0.0, 0.0)
        record = {"prior_radians": PRIORS[best], "confirmed_share": shares[best], "pooled_texels": pool}
        return turn, record | {"median_deg": float(typical), "p95_deg": float(large)}

    def accumulate(self, frames: np.ndarray) -> ReliefEquations:
        """The equations of some frames [n] int, numbers of views."""
        sums = ReliefSums(len(self.surface))
        slopes = self.slopes(self.progress(frames, "fine normals"), frames)
        for view in work_ahead(lambda shown: self.view(shown[0], slope=shown[1]), slopes):
            self._add(view, sums)
        return sums.equations()

    def slopes(self, shown: Iterable[int], frames: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
        """Each of the frames [n], which shown gives one by one, with what view takes. The derivative of E is W, see
        irradiance_vectors; that of some frames is one product."""
        shading = self.shading
        for k, f in enumerate(shown):
            if k % _TOGETHER == 0:
                together = frames[k : k + _TOGETHER]
                light = shading.far_along[:, together].reshape(len(shading.directions), -1)
                vectors = irradiance_vectors(shading.transfer, light, shading.directions)
                near = shading.lamp_vectors(np.arange(len(vectors)), together)
                if np.ndim(near):
                    vectors += near.transpose(0, 3, 1, 2).reshape(vectors.shape)
            first = 3 * (k % _TOGETHER)
            yield f, vectors[..., first : first + 3].transpose(0, 2, 1)

    def view(self, f: int, slope: np.ndarray) -> FrameView:
        """One frame with E, S [3] and their derivatives by the normal [3, 3] of each vertex, 24 values; slope [P, 3
        channels, 3]: that of E at the shading's points."""
        views, shading = self.views, self.shading
        pose, picture, lens = views.camera_from_head[f], views.picture(f), views.intrinsics[f]
        view = self.viewer.view(pose, lens, picture.inside.shape[::-1])
        reflection, reflection_slope = self.reflections.at(f, shading.points.normals)
        columns = [reflection, slope.reshape(-1, 9), reflection_slope.reshape(-1, 9)]
        of_points = np.concatenate(columns, axis=1, dtype=np.float32, casting="same_kind")
        values = np.concatenate([shading.irradiance(f), of_points[shading.stand_in]], axis=1)
        return self.surface.frame_view(view, picture, lens, values)

    def _add(self, view: FrameView, sums: ReliefSums) -> None:
        blocks = view.blocks()
        linear = share_out(len(blocks), lambda k: self._linearised(view, blocks[k]))
        common = self._common(linear)

        def add(k: int) -> None:
            coarse = linear[k].scale * self.surface.interpolate(common, linear[k].rows)
            sums.add(linear[k], linear[k].error - coarse)

        share_out(len(blocks), add)

    def _linearised(self, view: FrameView, rows: np.ndarray) -> LinearSamples:
        samples, found = self.surface.samples(view, rows)
        material, derivative = self.material, np.empty((len(rows), 3, 2), np.float32)
        model = material.radiance(rows, found[:, :3], found[:, 3:6])
        _differentiate(rows, found, material.albedo, material.specular, self.tangents, derivative)
        robust = robust_weight(model, samples, self.noise, material.information)
        weight = samples.weight[:, None] * self.noise.precision(samples.colours) * robust
        scale = np.maximum(model, np.float32(1e-3))
        return LinearSamples(rows, found[:, :3], model - samples.colours, scale, derivative, weight)

    def _common(self, parts: list[LinearSamples]) -> np.ndarray:
        """[V, 3]: the residual that the neighbourhood of a vertex shares in a frame, relative to the model."""
        total, sums = np.zeros((2, len(self.surface.mesh.vertices), 3))
        for part in parts:
            _add_to_corners(self.corner[part.rows], part.weight, part.scale, part.error, total, sums)
        return (self.around @ sums) / np.maximum(self.around @ total, 1e-9)

    def pooled(self, equations: ReliefEquations, pool: float) -> ReliefEquations:
        """Each texel's equations with its neighbours', as a Gaussian of standard width pool weighs them, and errors of
        neighbouring frames taken together."""

        def blurred(values: np.ndarray) -> np.ndarray:
            image = self.surface.to_image(values / np.float32(CORRELATED_FRAMES))
            return gaussian_filter(image, pool, mode="constant").ravel()[self.surface.pixel]

        parts = (equations.hessian, equations.gradient)
        return ReliefEquations(*(np.stack([blurred(column) for column in part.T], axis=1) for part in parts))


def most_likely_turns(equations: ReliefEquations, prior: float) -> np.ndarray:
    """[T, 2] float32 under a standard deviation of prior radians."""
    (a11, a12, a22), (b1, b2) = equations.hessian.T, equations.gradient.T
    p11, p22 = a11 + prior**-2, a22 + prior**-2
    determinant = p11 * p22 - a12 * a12
    turn = np.stack([a12 * b2 - p22 * b1, a12 * b1 - p11 * b2], axis=1) / determinant[:, None]
    length = np.linalg.norm(turn, axis=1, keepdims=True)
    turn *= np.minimum(1.0, LARGEST_TURN / np.maximum(length, 1e-9))
    return turn.astype(np.float32)


@compiled
def _differentiate(rows, values, albedo, specular, tangents, derivative):
    """values [n, 24]: E, S, and by the normal dE, dS -> derivative of the model by the turn [n, 3, 2]."""
    for i in range(len(rows)):
        row = rows[i]
        for c in range(3):
            a, s = albedo[row, c], specular[row]
            derivative[i, c, 0] = derivative[i, c, 1] = 0.0
            for x in range(3):
                slope = a * values[i, 6 + 3 * c + x] + s * values[i, 15 + 3 * c + x]
                derivative[i, c, 0] += slope * tangents[row, 0, x]
                derivative[i, c, 1] += slope * tangents[row, 1, x]


@compiled
def _add_to_corners(corner, weight, scale, error, total, sums):
    for i in range(len(corner)):
        for c in range(3):
            weighted = weight[i, c] * scale[i, c]
            total[corner[i], c] += weighted * scale[i, c]
            sums[corner[i], c] += weighted * error[i, c]


@compiled
def _add_products(rows, irradiance, derivative, error, weight, per_channel, together):
    for i in range(len(rows)):
        row = rows[i]
        for c in range(3):
            e, w, r = irradiance[i, c], weight[i, c], error[i, c]
            d1, d2 = derivative[i, c]
            per_channel[row, c] += w * e * e
            per_channel[row, 3 + c] += w * e * d1
            per_channel[row, 6 + c] += w * e * d2
            per_channel[row, 9 + c] += w * e * r
            together[row, 0] += w * d1 * d1
            together[row, 1] += w * d1 * d2
            together[row, 2] += w * d2 * d2
            together[row, 3] += w * d1 * r
            together[row, 4] += w * d2 * r


def resolved_texels(surface: TexelSurface, views: Views) -> float:
    """Standard width in texels of what the pictures resolve of the texture where it is largest in them."""
    return max(RESOLVED_PX / WIDTH_OF_DEVIATION / (views.px_per_mm * surface.typical_texel_mm()), LEAST_POOL)


def normal_image(surface: TexelSurface, turn: np.ndarray | None) -> np.ndarray:
    """[S, S, 3] float32 tangent-space normals * 0.5 + 0.5, y up, flat where there is no surface. turn [T, 2]; None:
    flat everywhere."""
    image = np.tile(np.array([0.5, 0.5, 1.0], np.float32), (surface.size, surface.size, 1))
    if turn is not None:
        normal = normalised(np.concatenate([turn, np.ones((len(turn), 1), turn.dtype)], axis=1))
        image.reshape(-1, 3)[surface.pixel] = 0.5 * normal + 0.5
    return image
