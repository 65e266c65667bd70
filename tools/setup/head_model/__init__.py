"""Builds the head model of shared.tracking.head_model from MakeHuman's CC0 data, once, at set-up.

Read in this order: makehuman, topology, shapes, embedding, segments, relaxation, layout, build.
May import: shared.
"""

VERSION = 3
"""Changes whenever the built model changes: set-up then builds it anew."""
