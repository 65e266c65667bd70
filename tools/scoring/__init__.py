"""Scores of a result against a subject's truth.

Read in this order: align, buffers, measures, rotations, gaze, lid_margins, labels, hair_outline, texel_albedo, table,
score, shadows, appearance_errors, held_out.
May import: shared.
"""
