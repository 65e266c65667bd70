"""Builds the head model of shared.head_model from MakeHuman's CC0 data, once, at set-up."""

VERSION = 2
"""Changes whenever the built model changes: set-up then builds it anew."""
