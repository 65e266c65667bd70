"""Synthetic subjects whose truth is known, rendered by a path of their own.

Read in this order: noise, bust, head, surface, skin, makeup, wear, light, sampling, irradiance, highlights, camera,
chart, render, output, scan, subject.
May import: shared.
"""
