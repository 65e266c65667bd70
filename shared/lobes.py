"""Specular reflection as lobe sums on the direction set: exact for wide lobes, up to the grid of directions.

    S[v, f] = sum_j V[v, j] f_GGX(n_v, o_vf, w_j) cos_i dw L_f[j]

at specular_intensity 1, with the same visibility and light as the diffuse transfer. The set resolves lobes that are
wider than its spacing (sqrt(4 pi / J)): with 768 directions roughness 0.25 and up; skin lies above. Narrower lobes
(wet lips, oil, eyes) get their weights from the split sum. Where the head itself blocks the lobe, the blocked weight
is returned too, so that the caller can fill in light that bounced.

The tables for the solver are kept as bfloat16 [F, P, J] (2 bytes per entry): rounding errors are independent between
directions and average out in the sum.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from copy import copy

import numpy as np
import torch

from shared.brdf import F0, MINIMUM_COSINE
from shared.split_sum import SplitSum, narrowest_roughness

_VALUES_PER_BLOCK = 32768
"""Small enough for the cache; larger blocks are bound by memory."""


class LobeTable:
    """What the lobes of P points share over all views: cosines with J directions and visibility.

    normals [P, 3], visible [P, J] bool (as Transfer.visibility), directions [J, 3] uniform over the sphere.
    """

    def __init__(self, normals: np.ndarray, visible: np.ndarray, directions: np.ndarray):
        self.normals = torch.from_numpy(np.ascontiguousarray(normals, np.float32))
        self.directions = torch.from_numpy(np.ascontiguousarray(directions.T, np.float32))
        self.visible = torch.from_numpy(np.ascontiguousarray(visible))
        self.solid_angle = 4.0 * np.pi / len(directions)
        self.narrowest = narrowest_roughness(len(directions))
        self._split_sum: SplitSum | None = None

    def take(self, index: np.ndarray) -> LobeTable:
        """The table of the points at index."""
        part = copy(self)
        part.normals, part.visible = self.normals[index], self.visible[index]
        return part

    def __len__(self) -> int:
        return len(self.normals)

    def kernel(
        self, part: slice, towards: torch.Tensor, roughness: float | np.ndarray
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Lobe weights of some points from one view each: all directions [p, J], and the open share [p, J].

        towards [p, 3] unit vectors to the camera; roughness: one, or each point's [P], then not below `narrowest`. The
        first includes directions that the head blocks. The same function as brdf.specular_cosine times the solid
        angle, with what does not change factored out; for lobes that slip between the directions the split sum.
        """
        if np.ndim(roughness):
            alpha2 = torch.from_numpy(np.asarray(roughness[part], np.float32))[:, None] ** 4
        elif roughness < self.narrowest:
            if self._split_sum is None:
                self._split_sum = SplitSum(self.directions.numpy().T.astype(np.float64))
            return self._split_sum.kernel(self.normals[part], towards, float(roughness), self.visible[part])
        else:
            alpha2 = float(roughness) ** 4
        normals = self.normals[part]
        n_dot_i = normals @ self.directions
        n_dot_o = (normals * towards).sum(1, keepdim=True).clamp_min(MINIMUM_COSINE)
        length2 = (towards @ self.directions).add_(1.0).mul_(2.0).clamp_min_(1e-6)
        base = (n_dot_i + n_dot_o).square_().div_(length2).clamp_max_(1.0).mul_(alpha2 - 1.0).add_(1.0).square_()
        away = length2.sqrt_().mul_(-0.5).add_(1.0).clamp_min_(0.0)
        fresnel = away.square().square_().mul_(away).mul_(1.0 - F0).add_(F0)
        cos_i = n_dot_i.clamp_min(0.0)
        masking = (cos_i.square().mul_(1.0 - alpha2).add_(alpha2)).sqrt_().add_(cos_i)
        lobe = fresnel.mul_(cos_i).div_(masking).div_(base)
        root = (alpha2 + (1.0 - alpha2) * n_dot_o.square()).sqrt() + n_dot_o
        # D's alpha^2 / pi, both masking terms' factor 2 and the denominator's 4 cos_o against G1(o)'s cos_o.
        lobe.mul_(alpha2 / np.pi * self.solid_angle / root)
        return lobe, lobe * self.visible[part]


@contextmanager
def _one_core() -> Iterator[None]:
    """Torch on one core: on blocks this small, waking another costs more than it gains (measured: 2.3 times)."""
    count = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(count)


def _blocks(table: LobeTable) -> list[slice]:
    step = max(1, _VALUES_PER_BLOCK // table.directions.shape[1])
    return [slice(start, min(start + step, len(table))) for start in range(0, len(table), step)]


@_one_core()
def specular_reflection(
    table: LobeTable,
    towards: np.ndarray,
    roughness: float | np.ndarray,
    light: np.ndarray,
    blocked_light: np.ndarray | None = None,
) -> np.ndarray:
    """Specular radiance of P points from one camera at specular_intensity 1.

    towards [P, 3]; roughness: one, or each point's [P]; light [J, C] along the directions; blocked_light [P, C]: mean
    radiance of what the head itself puts in the way (0 when None) -> [P, C] float32.
    """
    light_t = torch.from_numpy(np.ascontiguousarray(light, np.float32))
    towards_t = torch.from_numpy(np.ascontiguousarray(towards, np.float32))
    result = np.zeros((len(table), light.shape[1]), np.float32)
    for part in _blocks(table):
        every, open_share = table.kernel(part, towards_t[part], roughness)
        result[part] = (open_share @ light_t).numpy()
        if blocked_light is not None:
            result[part] += (every.sum(1) - open_share.sum(1)).numpy()[:, None] * blocked_light[part]
    return result


@_one_core()
def specular_tables(
    table: LobeTable, towards: np.ndarray, roughness: float | np.ndarray, progress=iter
) -> tuple[torch.Tensor, np.ndarray]:
    """The lobes of all points in F views: open weights bfloat16 [F, P, J] and blocked weight float32 [P, F].

    towards [P, F, 3]. With light [F, J, C] the reflection is torch.bmm(table, light).
    """
    points, frames = towards.shape[:2]
    kernels = torch.empty((frames, points, table.directions.shape[1]), dtype=torch.bfloat16)
    blocked = np.zeros((points, frames), np.float32)
    towards_t = torch.from_numpy(np.ascontiguousarray(towards.transpose(1, 0, 2), np.float32))
    for f in progress(range(frames)):
        for part in _blocks(table):
            every, open_share = table.kernel(part, towards_t[f, part], roughness)
            kernels[f, part] = open_share
            blocked[part, f] = (every.sum(1) - open_share.sum(1)).numpy()
    return kernels, blocked
