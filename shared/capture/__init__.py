"""From a clip to frames: survey, framing, frame quality, faces and landmarks, irises, background motion, the colour
chart and a grey place.

Read in this order: landmarks, iris, framing, face_tracker, frame_quality, background_motion, clip_survey, crop_pixels,
cameras, sample_clip, chart, chart_finder, chart_watch, grey_watch.
May import: errors, contract, compute, geometry, imaging, io.
"""
