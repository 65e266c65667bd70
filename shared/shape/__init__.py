"""The mesh refined under a light that is known, from shading, parallax and the occluding contour.

Read in this order: samples, equations, step, face_edge, occluding_contour, silhouette, gauss_newton, refine.
May import: compute, geometry, imaging, tracking, rendering, appearance.
"""
