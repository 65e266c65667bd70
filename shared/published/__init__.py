"""The published solver, the yardstick: gradient descent through a rasteriser, with the published numbers.

Read in this order: raster, light, shading, settings, shape, solver.
May import: compute, geometry, imaging, rendering, appearance.
"""
