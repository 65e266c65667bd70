"""Facial actions of a solved head, carried over from the head model, as blend shapes.

Read in this order: names, transfer, eyelids, folds, lips, facial.
May import: compute, geometry, tracking.
"""
