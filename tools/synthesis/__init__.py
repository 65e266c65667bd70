"""Synthetic subjects whose truth is known, rendered by a path of their own.

Read in this order: bust, head, lips, eyes, surface, skin, iris, gaze, makeup, wear, hair, light, sampling,
irradiance, highlights, eye_light, camera, chart, render, output, scan, subject.
May import: shared.
"""
