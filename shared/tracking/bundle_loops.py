"""The sums of bundle adjustment over all observations, compiled: each is looked at once and leaves no array behind.

An observation has ten derivatives: by the camera's turn (0 to 2) and shift (3 to 5), by the logarithm of the focal
length (6) and by the point (7 to 9). first and last: the points that are looked at.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from shared.compute.compiled import compiled, compiled_part


class Observations(NamedTuple):
    """rotation [F, 3, 3] and shift [F, 3] of the poses, points [N, 3]; pixels [F, N, 2], their whitening [F, N, 2, 2]
    and seen [F, N] bool; focal [2] and centre [2] px of the lens; loss: scale of the Cauchy loss, whitened."""

    rotation: np.ndarray
    shift: np.ndarray
    points: np.ndarray
    pixels: np.ndarray
    whitening: np.ndarray
    seen: np.ndarray
    focal: np.ndarray
    centre: np.ndarray
    loss: float


@compiled_part
def observe(observations, f, n, rows):
    """Writes the derivatives and the residual of observation f, n, whitened, to rows [2, 11] -> its Cauchy weight."""
    turn, moved, point = observations.rotation[f], observations.shift[f], observations.points[n]
    whitening, focal, centre = observations.whitening[f, n], observations.focal, observations.centre
    ax = turn[0, 0] * point[0] + turn[0, 1] * point[1] + turn[0, 2] * point[2]
    ay = turn[1, 0] * point[0] + turn[1, 1] * point[1] + turn[1, 2] * point[2]
    az = turn[2, 0] * point[0] + turn[2, 1] * point[1] + turn[2, 2] * point[2]
    x, y, nearness = ax + moved[0], ay + moved[1], 1.0 / (az + moved[2])
    across, down = x * nearness, y * nearness
    error_x, error_y = across * focal[0] + centre[0], down * focal[1] + centre[1]
    error_x, error_y = error_x - observations.pixels[f, n, 0], error_y - observations.pixels[f, n, 1]
    squared = 0.0
    for i in range(2):
        by_x, by_y = whitening[i, 0] * focal[0] * nearness, whitening[i, 1] * focal[1] * nearness
        by_z = -(by_x * across + by_y * down)
        rows[i, 0], rows[i, 1], rows[i, 2] = ay * by_z - az * by_y, az * by_x - ax * by_z, ax * by_y - ay * by_x
        rows[i, 3], rows[i, 4], rows[i, 5] = by_x, by_y, by_z
        # a longer focal length moves a pixel as a point does that moves away from the axis
        rows[i, 6] = by_x * x + by_y * y
        for k in range(3):
            rows[i, 7 + k] = by_x * turn[0, k] + by_y * turn[1, k] + by_z * turn[2, k]
        rows[i, 10] = whitening[i, 0] * error_x + whitening[i, 1] * error_y
        squared += rows[i, 10] * rows[i, 10]
    return 1.0 / (1.0 + squared / (observations.loss * observations.loss))


@compiled
def add_normal_equations(observations, first, last, cameras, own):
    """Adds to cameras [F, 7, 8] the products among the derivatives by turn, shift and focal length (upper triangle)
    and minus those with the residual (last column); to own [N, 3, 5] those among the derivatives by the point, with
    that by the focal length, and minus those with the residual."""
    rows = np.empty((2, 11))
    for f in range(len(observations.seen)):
        for n in range(first, last):
            if not observations.seen[f, n]:
                continue
            weight = observe(observations, f, n, rows)
            for i in range(2):
                for a in range(7):
                    share = weight * rows[i, a]
                    for b in range(a, 7):
                        cameras[f, a, b] += share * rows[i, b]
                    cameras[f, a, 7] -= share * rows[i, 10]
                for a in range(3):
                    share = weight * rows[i, 7 + a]
                    for b in range(3):
                        own[n, a, b] += share * rows[i, 7 + b]
                    own[n, a, 3] += share * rows[i, 6]
                    own[n, a, 4] -= share * rows[i, 10]


@compiled
def couple(observations, first, last, half, coupling):
    """Writes to coupling [6 F or more, 3 N] the products of the derivatives by turn and shift with those by the points,
    times half [N, 3, 3] from the right."""
    rows, turned = np.empty((2, 11)), np.empty((2, 3))
    for f in range(len(observations.seen)):
        for n in range(first, last):
            if not observations.seen[f, n]:
                for a in range(6):
                    for c in range(3):
                        coupling[6 * f + a, 3 * n + c] = 0.0
                continue
            weight = observe(observations, f, n, rows)
            for i in range(2):
                for c in range(3):
                    turned[i, c] = weight * (
                        rows[i, 7] * half[n, 0, c] + rows[i, 8] * half[n, 1, c] + rows[i, 9] * half[n, 2, c]
                    )
            for a in range(6):
                for c in range(3):
                    coupling[6 * f + a, 3 * n + c] = rows[0, a] * turned[0, c] + rows[1, a] * turned[1, c]


@compiled
def cauchy_cost(observations, first, last):
    """Sum of the observations' Cauchy costs."""
    focal, centre, squared_loss = observations.focal, observations.centre, observations.loss * observations.loss
    total = 0.0
    for f in range(len(observations.seen)):
        turn, moved = observations.rotation[f], observations.shift[f]
        for n in range(first, last):
            if observations.seen[f, n]:
                x, y, z = moved[0], moved[1], moved[2]
                for k in range(3):
                    place = observations.points[n, k]
                    x, y, z = x + turn[0, k] * place, y + turn[1, k] * place, z + turn[2, k] * place
                error_x = x / z * focal[0] + centre[0] - observations.pixels[f, n, 0]
                error_y = y / z * focal[1] + centre[1] - observations.pixels[f, n, 1]
                squared = 0.0
                for i in range(2):
                    whitening = observations.whitening[f, n, i]
                    residual = whitening[0] * error_x + whitening[1] * error_y
                    squared += residual * residual
                total += np.log1p(squared / squared_loss)
    return squared_loss * total
