"""From frames to poses and a head: dense tracks, bundle adjustment, uncertainty, the head model and its fit, gaze
and blinks.

Read in this order: tracked_clip, tracks, pnp, head_model, models, given_tracking, motion_prior, bundle_loops,
bundle, depth_noise, fit_head, first_poses, texture_tracks, texture_tracking, focal_search, pose_uncertainty,
fit_surface, expression, lids, closing_line, fit_eyeballs, fit_lids, track_head, track_quality, gaze, iris_rim,
iris_texture, lid_openings, head_scale, eyes.
May import: errors, contract, compute, geometry, io, capture.
"""
