"""Light on a surface: BRDF and its lobes, environment maps, visibility and bounces, shading, pictures of it.

Read in this order: brdf, envmap, direction_set, split_sum, lobes, specular_transfer, studio_lights, transfer,
near_lamp, precomputed_transfer, irradiance_errors, shading, eye_shine, normal_derivatives, render, compositing,
view_set, views.
May import: compute, geometry, imaging.
"""
