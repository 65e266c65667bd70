"""Robust statistics: what outliers do not move."""

ROBUST_SCALE = 1.4826
"""Standard deviation over median absolute deviation of normally distributed values (1 / 0.6745)."""
