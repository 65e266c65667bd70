"""Inverse rendering of a whole clip, or of several: what is given, how it is solved, what it returns.

Read in this order: frame_choice, problem, texture_match, clip_inputs, pose_rounds, joint_clips, lit_surface,
lamp_distance, exposure, shaping, model_selection, material_map, hair_surface, result, solve_texels, published_clip,
solve, parameters.
May import: errors, contract, compute, geometry, imaging, io, capture, hair, tracking, rendering, appearance, shape,
selection, published.
"""
