"""The lobes of a whole clip as tables for the solver, which multiplies the same ones with many lights.

Kept as bfloat16 [F, P, J] (2 bytes per entry): rounding errors are independent between directions and average out in
the sum.
"""

from __future__ import annotations

import numpy as np
import torch

from shared.compiled import compiled
from shared.lobes import LobeTable, blocks_of, cover_lobe, weigh_directions


def specular_tables(
    table: LobeTable, towards: np.ndarray, roughness: float | np.ndarray
) -> tuple[torch.Tensor, np.ndarray]:
    """The lobes of all points in F views: open weights bfloat16 [F, P, J] and blocked weight float32 [P, F].

    towards [P, F, 3]. With light [F, J, C] the reflection is torch.bmm(table, light).
    """
    points, frames = towards.shape[:2]
    bits = np.empty((frames, points, table.directions.shape[1]), np.int16)
    weights = torch.from_numpy(bits).view(torch.bfloat16)
    blocked = np.zeros((frames, points), np.float32)
    for f in range(frames):
        view = np.ascontiguousarray(towards[:, f], np.float32)
        if table.resolves(roughness):
            where = table.normals, view, table.alpha2(roughness), table.directions, table.visible
            _tabulate_lobes(*where, bits[f], blocked[f])
            continue
        for part in blocks_of(table):
            every, seen = table.split_sum(part, view[part], roughness)
            weights[f, part] = torch.from_numpy(seen)
            blocked[f, part] = every.sum(1) - seen.sum(1)
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
