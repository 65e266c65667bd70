"""The reference solver's light: a cubemap with mips, GGX-prefiltered, sampled by its brightness. All in torch.

Light is a tensor [6 n^2, 3], texels as in shared.rendering.envmap. Look-ups are bilinear over faces with a border of
one texel: they cross edges without a seam, and are differentiable by the light and by the direction.

References: [Karis2013] (prefiltering with n = o = r); [Munkberg2022] (mips as prefiltered light, roughness 0.08 to 0.5
over all levels but the last, which stands for 1).
"""

from __future__ import annotations

import warnings
from functools import lru_cache

import numpy as np
import scipy.sparse as sparse
import torch

from shared.rendering.brdf import MINIMUM_COSINE, microfacet_integrals
from shared.rendering.envmap import cube_directions, cube_resolution, cube_solid_angles, cube_texel, padded_cube_index
from shared.rendering.split_sum import frames_about, mirrored_about_axis

LEAST_ROUGHNESS, ROUGH_LEVEL = 0.08, 0.5
FLOOR = 0.05
"""Of the mean brightness, in every direction that light is sampled from: dark texels are looked at, too."""
_IRRADIANCE_EDGE = 16
_ROWS_AT_ONCE = 30_000
# Of each face (+x -x +y -y +z -z): which component points right and down in it, and its sign (see
# shared.rendering.envmap).
_RIGHT, _RIGHT_SIGN = (2, 2, 0, 0, 0, 0), (-1.0, 1.0, 1.0, 1.0, 1.0, -1.0)
_DOWN, _DOWN_SIGN = (1, 1, 2, 2, 1, 1), (-1.0, -1.0, 1.0, -1.0, -1.0, -1.0)


def face_coordinates(directions: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """[M, 3] -> face [M], and its coordinates right and down in [-1, 1] [M]."""
    size, axis = directions.abs().max(1)
    negative = torch.gather(directions, 1, axis[:, None])[:, 0] < 0
    face = 2 * axis + negative

    def component(index: tuple, sign: tuple) -> torch.Tensor:
        chosen = torch.tensor(index)[face]
        signs = torch.tensor(sign, dtype=directions.dtype)[face]
        return torch.gather(directions, 1, chosen[:, None])[:, 0] * signs / size

    return face, component(_RIGHT, _RIGHT_SIGN), component(_DOWN, _DOWN_SIGN)


class CubeSampler:
    """Bilinear look-ups in cubemaps of one resolution."""

    def __init__(self, resolution: int):
        self.resolution = resolution
        self._padded = torch.from_numpy(padded_cube_index(resolution))

    def taps(self, directions: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """[M, 3] unit directions -> texels [M, 4] and weights [M, 4]."""
        n = self.resolution
        face, right, down = face_coordinates(directions)
        column, row = (0.5 * n * (value + 1.0) - 0.5 for value in (right, down))
        left, top = (value.detach().floor().clamp(-1, n - 1) for value in (column, row))
        across, below = column - left, row - top
        corner = (face * (n + 2) + top.long() + 1) * (n + 2) + left.long() + 1
        index = torch.stack([corner, corner + 1, corner + n + 2, corner + n + 3], dim=1)
        weight = [(1 - across) * (1 - below), across * (1 - below), (1 - across) * below, across * below]
        return self._padded[index], torch.stack(weight, dim=1)

    def __call__(self, light: torch.Tensor, directions: torch.Tensor) -> torch.Tensor:
        """[6 n^2, C], [M, 3] -> [M, C]; differentiable by both."""
        index, weight = self.taps(directions)
        return (light[index] * weight[..., None]).sum(1)

    def fixed(self, light: torch.Tensor, directions: torch.Tensor) -> torch.Tensor:
        """The same, for very many directions that carry no gradient of their own. light [6 n^2, C]; directions [M,
        3]."""
        with torch.no_grad():
            index, weight = self.taps(directions)
        return _FixedLookup.apply(light, index, weight)


class _FixedLookup(torch.autograd.Function):
    """sum_k weight[m, k] light[index[m, k]]; backwards by histograms, many times faster than scattered adds."""

    @staticmethod
    def forward(ctx, light, index, weight):
        ctx.save_for_backward(index, weight)
        ctx.count = len(light)
        result = light[index[:, 0]] * weight[:, :1]
        for k in range(1, index.shape[1]):
            result += light[index[:, k]] * weight[:, k : k + 1]
        return result

    @staticmethod
    def backward(ctx, gradient):
        index, weight = ctx.saved_tensors
        flat = index.reshape(-1)
        parts = [
            torch.bincount(flat, (weight * gradient[:, c : c + 1]).reshape(-1), minlength=ctx.count)
            for c in range(gradient.shape[1])
        ]
        return torch.stack(parts, dim=1).to(gradient.dtype), None, None


class _Product(torch.autograd.Function):
    """A constant sparse matrix times x [N, C]."""

    @staticmethod
    def forward(ctx, x, matrix, transposed):
        ctx.transposed = transposed
        return matrix @ x

    @staticmethod
    def backward(ctx, gradient):
        return ctx.transposed @ gradient.contiguous(), None, None


class SparseOperator:
    """A scipy matrix as a differentiable torch operator."""

    def __init__(self, matrix: sparse.spmatrix, dtype: torch.dtype = torch.float32):
        self._matrix, self._transposed = (_torch_csr(m.tocsr(), dtype) for m in (matrix, matrix.T))

    def __call__(self, x: torch.Tensor) -> torch.Tensor:
        """The matrix [M, N] times x [N, C] -> [M, C]."""
        return _Product.apply(x, self._matrix, self._transposed)


def _torch_csr(matrix: sparse.csr_matrix, dtype) -> torch.Tensor:
    rows, columns = (torch.from_numpy(part.astype(np.int64)) for part in (matrix.indptr, matrix.indices))
    values = torch.from_numpy(matrix.data).to(dtype)
    warnings.filterwarnings("ignore", "Sparse CSR tensor support is in beta", UserWarning)
    return torch.sparse_csr_tensor(rows, columns, values, matrix.shape, check_invariants=False)


def lobe_filter(resolution: int, roughness: float) -> sparse.csr_matrix:
    """[6 n^2, 6 n^2] rows of sum 1: light seen through the lobe of a roughness along its axis, n = o = r."""
    local, cosine = mirrored_about_axis(roughness)
    return _kernel_filter(resolution, resolution, local, cosine)


def cosine_filter(resolution: int, source: int) -> sparse.csr_matrix:
    """[6 n^2, 6 m^2]: irradiance over pi on surfaces that face each texel, from a light of another resolution."""
    cosine = (
        np.maximum(cube_directions(resolution) @ cube_directions(source).T, 0.0) * cube_solid_angles(source) / np.pi
    )
    return sparse.csr_matrix(cosine / cosine.sum(1, keepdims=True))


def _kernel_filter(resolution: int, source: int, local: np.ndarray, weight: np.ndarray) -> sparse.csr_matrix:
    axes, blocks = cube_directions(resolution), []
    share = np.tile(weight / weight.sum(), _ROWS_AT_ONCE)
    for start in range(0, len(axes), _ROWS_AT_ONCE):
        world = np.einsum("kj,pji->pki", local, frames_about(axes[start : start + _ROWS_AT_ONCE]))
        columns = cube_texel(world.reshape(-1, 3), source)
        rows = np.repeat(np.arange(len(world)), len(local))
        shape = (len(world), 6 * source**2)
        blocks.append(sparse.coo_matrix((share[: len(rows)], (rows, columns)), shape=shape).tocsr().astype(np.float32))
    return sparse.vstack(blocks, format="csr")


class PrefilteredLight:
    """Mips of a cubemap, each filtered for its roughness."""

    def __init__(self, resolution: int, smallest: int = 8, dtype=torch.float32):
        count = max(1, int(np.log2(resolution / smallest)) + 1)
        self.edges = [resolution >> k for k in range(count)]
        steps = np.linspace(LEAST_ROUGHNESS, ROUGH_LEVEL, max(count - 1, 2))[: count - 1]
        self.roughness = [*map(float, steps), 1.0]
        self._samplers = [CubeSampler(edge) for edge in self.edges]
        self._filters = [
            SparseOperator(lobe_filter(*level), dtype) for level in zip(self.edges, self.roughness, strict=True)
        ]
        self._cosine_edge = min(self.edges, key=lambda edge: abs(edge - _IRRADIANCE_EDGE))
        self._cosine_sampler = CubeSampler(_IRRADIANCE_EDGE)
        self._cosine = SparseOperator(cosine_filter(_IRRADIANCE_EDGE, self._cosine_edge), dtype)

    def mips(self, light: torch.Tensor) -> list[torch.Tensor]:
        """[6 n^2, 3] -> unfiltered levels, each the mean of two by two texels of the one before."""
        levels = [light]
        for edge in self.edges[1:]:
            levels.append(levels[-1].reshape(6, edge, 2, edge, 2, -1).mean((2, 4)).reshape(6 * edge**2, -1))
        return levels

    def irradiance(self, levels: list[torch.Tensor], normals: torch.Tensor) -> torch.Tensor:
        """Over pi, nothing in the way: [P, 3]."""
        source = levels[self.edges.index(self._cosine_edge)]
        return self._cosine_sampler(self._cosine(source), normals)

    def reflection(self, levels: list[torch.Tensor], directions: torch.Tensor, roughness: torch.Tensor) -> torch.Tensor:
        """Prefiltered radiance [P, 3] along reflected directions [P, 3] at roughness [P], between levels linear."""
        level = self._level(roughness)
        total = 0.0
        for k, (sampler, filtered) in enumerate(zip(self._samplers, self._filters, strict=True)):
            share = (1.0 - (level - k).abs()).clamp_min(0.0)
            if bool((share > 0).any()):
                total = total + share[:, None] * sampler(filtered(levels[k]), directions)
        return total

    def _level(self, roughness: torch.Tensor) -> torch.Tensor:
        """[P] place between the levels, linear in the roughness from each to the next."""
        level = torch.zeros_like(roughness)
        for low, high in zip(self.roughness[:-1], self.roughness[1:], strict=True):
            level = level + ((roughness - low) / (high - low)).clamp(0.0, 1.0)
        return level


class LightSampling:
    """Directions in proportion to the light's brightness, uniform within a texel, and the density of any direction.
    light [6 n^2, 3]."""

    def __init__(self, light: torch.Tensor):
        self.resolution = cube_resolution(light)
        brightness = light.detach().mean(1).double()
        brightness = brightness + FLOOR * brightness.mean().clamp_min(1e-9)
        solid = torch.from_numpy(cube_solid_angles(self.resolution))
        weight = brightness * solid
        self._share = weight / weight.sum()
        self._sums = torch.cumsum(self._share, 0)

    def sample(self, random: torch.Tensor) -> torch.Tensor:
        """[M, 3] numbers in 0 .. 1 -> [M, 3] unit directions."""
        n, dtype = self.resolution, random.dtype
        texel = torch.searchsorted(self._sums, random[:, 0].double().contiguous()).clamp_max(6 * n * n - 1)
        face, rest = texel // (n * n), texel % (n * n)
        right = 2.0 * ((rest % n) + random[:, 1]) / n - 1.0
        down = 2.0 * (torch.div(rest, n, rounding_mode="floor") + random[:, 2]) / n - 1.0
        result = torch.empty((len(random), 3), dtype=dtype)
        signs = torch.tensor([1.0, -1.0], dtype=dtype)
        result.scatter_(1, torch.div(face, 2, rounding_mode="floor")[:, None], signs[face % 2][:, None])
        for index, sign, value in ((_RIGHT, _RIGHT_SIGN, right), (_DOWN, _DOWN_SIGN, down)):
            where = torch.tensor(index)[face]
            signed = torch.tensor(sign, dtype=dtype)[face] * value.to(dtype)
            result.scatter_(1, where[:, None], signed[:, None])
        return torch.nn.functional.normalize(result, dim=1)

    def density(self, directions: torch.Tensor) -> torch.Tensor:
        """[M, 3] unit -> [M] per steradian: a texel's share, spread evenly over its square of the face."""
        n = self.resolution
        face, right, down = face_coordinates(directions)
        column, row = (((value + 1.0) * 0.5 * n).long().clamp(0, n - 1) for value in (right, down))
        share = self._share[(face * n + row) * n + column].to(directions.dtype)
        return share * (n * n / 4.0) * (1.0 + right * right + down * down) ** 1.5


@lru_cache(maxsize=1)
def energy_table() -> np.ndarray:
    """[2, 48, 64]: the split sum's A and B on a grid of cell centres over roughness and n.o in 0 .. 1."""
    cosine = (np.arange(64) + 0.5) / 64
    rough = np.maximum((np.arange(48) + 0.5) / 48, 0.02)
    return np.stack([microfacet_integrals(cosine, r)[1:] for r in rough], axis=1)


def split_sum_energy(cosine: torch.Tensor, roughness: torch.Tensor, f0: float) -> torch.Tensor:
    """F0 A + B [P], bilinear in the table, differentiable by both arguments [P]. cosine [P] of the angle to the
    normal; roughness [P]."""
    table = torch.from_numpy(energy_table()).to(cosine.dtype)[None]
    place = torch.stack([2.0 * cosine.clamp(MINIMUM_COSINE, 1.0) - 1.0, 2.0 * roughness - 1.0], dim=-1)[None, None]
    scale, bias = torch.nn.functional.grid_sample(table, place, padding_mode="border", align_corners=False)[0, :, 0]
    return f0 * scale + bias
