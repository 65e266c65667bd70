"""Weights of the Cauchy loss."""

import numpy as np
from scipy.optimize import minimize_scalar

from shared.compute.robust import cauchy_weight

LOCATIONS = np.array([0.9, 1.0, 1.1, 1.2, 40.0])
OWN = np.array([1.0, 2.0, 0.5, 0.0, 3.0])
SCALE = 0.3


def test_reweighted_means_reach_the_minimum_of_the_loss():
    """The mean weighted so, again and again, is where sum own log(1 + (error / scale)^2) is least: beside the outlier,
    and not moved by what counts nothing."""
    mean = 1.0
    for _ in range(200):
        weight = cauchy_weight(LOCATIONS - mean, SCALE, OWN)
        mean = (weight * LOCATIONS).sum() / weight.sum()
    least = minimize_scalar(lambda x: (OWN * np.log1p(((LOCATIONS - x) / SCALE) ** 2)).sum(), bounds=(0.5, 1.5),
                            method="bounded", options={"xatol": 1e-10})
    assert abs(mean - least.x) < 1e-6 and 0.9 < mean < 1.1


def test_scale_and_weight_may_be_numbers_or_arrays():
    error = np.array([[0.0, 1.0], [-2.0, np.inf]])
    assert cauchy_weight(error, np.array([1.0, 2.0])).tolist() == [[1.0, 0.8], [0.2, 0.0]]
    assert cauchy_weight(error, 1.0, np.array([[True], [False]])).tolist() == [[1.0, 0.5], [0.0, 0.0]]
    assert cauchy_weight(np.ones(1, np.float32), 1.0, np.ones(1, np.float32)).dtype == np.float32
