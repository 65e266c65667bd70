"""Products of transfer and lobe tables with lights, and of their transposes with samples: where the fit's time goes.

Lobes lie as bfloat16, which few processors multiply; each weight is widened in the cache instead (nine times as fast as
the library's product where the processor cannot). Products of floats are numpy's, whose library adds in one order
without being slowed down for it. Threads share frames or channels, so that results do not depend on their number.
"""

from __future__ import annotations

import numpy as np
import torch

from shared.compute.compiled import compiled
from shared.compute.threads import share_out


def per_channel(table: torch.Tensor, light: torch.Tensor) -> torch.Tensor:
    """[3, P, J] times [3, J, F] -> [3, P, F]."""
    return _multiply(table.numpy(), light.numpy())


def per_channel_transposed(table: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
    """[3, P, J], transposed, times [3, P, F] -> [3, J, F]."""
    return _multiply(table.numpy().transpose(0, 2, 1), values.numpy())


def _multiply(left: np.ndarray, right: np.ndarray) -> torch.Tensor:
    """[N, R, K] times [N, K, F]: half of a channel at a time, which shares out evenly among two and three threads."""
    rows = left.shape[1]
    halves = [(c, part) for c in range(len(left)) for part in (slice(0, rows // 2), slice(rows // 2, rows))]
    result = np.empty((len(left), rows, right.shape[2]), np.float32)

    def multiply(k: int) -> None:
        c, part = halves[k]
        np.matmul(left[c, part], right[c], out=result[c, part])

    share_out(len(halves), multiply)
    return torch.from_numpy(result)


def reflect(lobes: torch.Tensor, along: torch.Tensor) -> torch.Tensor:
    """Lobes bfloat16 [F, P, J], light along the directions [J, F, 3] -> radiance [3, P, F]."""
    bits, light = lobes.view(torch.int16).numpy(), np.ascontiguousarray(along.numpy().transpose(1, 2, 0))
    result = np.empty((light.shape[1], bits.shape[1], len(bits)), np.float32)
    share_out(len(bits), lambda f: _reflect(bits[f], light[f], result[:, :, f]))
    return torch.from_numpy(result)


def reflect_transposed(lobes: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
    """Lobes [F, P, J], transposed, times values [3, P, F] -> [J, F, 3]."""
    bits, samples = lobes.view(torch.int16).numpy(), np.ascontiguousarray(values.numpy().transpose(2, 1, 0))
    result = np.zeros((len(bits), samples.shape[2], bits.shape[2]), np.float32)
    share_out(len(bits), lambda f: _collect(bits[f], samples[f], result[f]))
    return torch.from_numpy(result.transpose(2, 0, 1))


@compiled
def _reflect(bits, light, result):
    """One frame's lobes, bits [P, J] of bfloat16, times light [3, J] -> result [3, P]."""
    words = np.empty(bits.shape[1], np.int32)
    weights = words.view(np.float32)
    for p in range(len(bits)):
        for j in range(len(words)):
            words[j] = np.int32(bits[p, j]) << 16
        red = green = blue = np.float32(0.0)
        for j in range(len(words)):
            red += weights[j] * light[0, j]
            green += weights[j] * light[1, j]
            blue += weights[j] * light[2, j]
        result[0, p], result[1, p], result[2, p] = red, green, blue


@compiled
def _collect(bits, values, result):
    """The transpose: values [P, 3] -> added to result [3, J]."""
    words = np.empty(bits.shape[1], np.int32)
    weights = words.view(np.float32)
    for p in range(len(bits)):
        red, green, blue = values[p, 0], values[p, 1], values[p, 2]
        if red == 0.0 and green == 0.0 and blue == 0.0:
            continue
        for j in range(len(words)):
            words[j] = np.int32(bits[p, j]) << 16
        for j in range(len(words)):
            result[0, j] += weights[j] * red
            result[1, j] += weights[j] * green
            result[2, j] += weights[j] * blue
