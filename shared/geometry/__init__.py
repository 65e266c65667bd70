"""Rigid motions and cameras, triangle meshes and their checks, rays, the atlas of a mesh's UVs.

Read in this order: transforms, mesh, blend_shapes, surface, eyeballs, parts, embree, raycast, atlas, intersections,
mesh_checks.
May import: compute.
"""
