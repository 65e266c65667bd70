"""The lobes of a whole clip, and their derivative by roughness, as tables for the solver, which multiplies the same
ones with many lights.

Kept as bfloat16 [F, P, J] (2 bytes per entry): rounding errors are independent between directions and average out in
the sum.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

from shared.compute.compiled import compiled
from shared.compute.threads import share_out
from shared.rendering.lobes import SpecularTransfer, blocks_of, cover_lobe, weigh_directions

LOG_STEP = 0.05
"""Of log roughness, to either side of a derivative."""


def specular_tables(
    table: SpecularTransfer, towards: np.ndarray, roughness: float | np.ndarray
) -> tuple[torch.Tensor, np.ndarray]:
    """The lobes of all points in F views: open weights bfloat16 [F, P, J] and blocked weight float32 [P, F].

    towards [P, F, 3].
    """
    def tabulate(view: np.ndarray, bits: np.ndarray, blocked: np.ndarray) -> None:
        alpha2 = table.alpha2(roughness)
        _tabulate_lobes(table.normals, view, alpha2, table.rows, table.visible, bits, blocked)

    def split(part: slice, view: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return table.split_sum(part, view, roughness)

    return _of_all_views(table, towards, tabulate if table.resolves(roughness) else None, split)


def specular_slopes(table: SpecularTransfer, towards: np.ndarray, roughness: float) -> tuple[torch.Tensor, np.ndarray]:
    """Derivatives of specular_tables by the logarithm of the roughness, as central differences; shapes as there.
    towards [P, F, 3] unit."""
    ends = [roughness * float(np.exp(side * LOG_STEP)) for side in (-1.0, 1.0)]

    def tabulate(view: np.ndarray, bits: np.ndarray, blocked: np.ndarray) -> None:
        narrower, wider = (table.alpha2(end) for end in ends)
        _tabulate_slopes(table.normals, view, narrower, wider, table.rows, table.visible, bits, blocked)

    def split(part: slice, view: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        narrower, wider = (table.split_sum(part, view, end) for end in ends)
        return tuple((w - n) / np.float32(2.0 * LOG_STEP) for n, w in zip(narrower, wider, strict=True))

    return _of_all_views(table, towards, tabulate if table.resolves(roughness) else None, split)


def _of_all_views(
    table: SpecularTransfer, towards: np.ndarray, tabulate: Callable | None, split: Callable
) -> tuple[torch.Tensor, np.ndarray]:
    """tabulate: fills one view's table where the directions resolve the lobes; split: weights of a part of the points
    on all directions and on the open ones, where they do not."""
    points, frames = towards.shape[:2]
    bits = np.empty((frames, points, len(table.directions)), np.int16)
    weights = torch.from_numpy(bits).view(torch.bfloat16)
    blocked = np.zeros((frames, points), np.float32)

    def fill(f: int) -> None:
        view = np.ascontiguousarray(towards[:, f], np.float32)
        if tabulate is not None:
            tabulate(view, bits[f], blocked[f])
            return
        for part in blocks_of(table):
            every, seen = split(part, view[part])
            weights[f, part] = torch.from_numpy(seen)
            blocked[f, part] = every.sum(1) - seen.sum(1)

    share_out(frames, fill)
    return weights, np.ascontiguousarray(blocked.T)


@compiled
def _tabulate_lobes(normals, towards, alpha2, directions, visible, bits, blocked):
    """The open weights as bfloat16 bits [P, J], rounded to the nearest even; blocked [P]: the weight of the others."""
    count = directions.shape[1]
    weights = np.empty(count, np.float32)
    words = weights.view(np.int32)
    for p in range(len(normals)):
        weigh_directions(normals[p], towards[p], alpha2[p], directions, weights)
        blocked[p] = cover_lobe(weights, visible[p])
        for j in range(count):
            bits[p, j] = (words[j] + 0x7FFF + ((words[j] >> 16) & 1)) >> 16


@compiled
def _tabulate_slopes(normals, towards, alpha2_narrower, alpha2_wider, directions, visible, bits, blocked):
    """Likewise of the difference of two lobes over twice LOG_STEP."""
    count = directions.shape[1]
    weights, others = np.empty(count, np.float32), np.empty(count, np.float32)
    words = weights.view(np.int32)
    per_log = np.float32(0.5 / LOG_STEP)
    for p in range(len(normals)):
        weigh_directions(normals[p], towards[p], alpha2_wider[p], directions, weights)
        weigh_directions(normals[p], towards[p], alpha2_narrower[p], directions, others)
        for j in range(count):
            weights[j] = (weights[j] - others[j]) * per_log
        blocked[p] = cover_lobe(weights, visible[p])
        for j in range(count):
            bits[p, j] = (words[j] + 0x7FFF + ((words[j] >> 16) & 1)) >> 16
