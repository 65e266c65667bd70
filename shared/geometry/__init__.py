"""Rigid motions and cameras, triangle meshes, their checks and their reduction, rays, the atlas of a mesh's UVs.

Read in this order: transforms, mesh, quads, blend_shapes, surface, eyeballs, parts, embree, raycast, mouth, rim,
reduction, atlas, intersections, mesh_checks.
May import: compute.
"""
