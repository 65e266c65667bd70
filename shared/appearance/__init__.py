"""Light, albedo, specular intensity and roughness of a fixed surface, first at points, then per texel.

Read in this order: measured_skin, light_tint, albedo_scale, chart_scale, eye_whites, observations, light, light_models,
sample_errors, skin_prior, products, transport, problem, projection, preconditioner, light_step, texture, light_weights,
local_roughness, fit, diagnostics, eye_albedo, catchlights, texture_pass, grain, fine_normals, confidence, maps,
material_features, material_mixture.
May import: compute, geometry, imaging, capture, rendering.
"""
