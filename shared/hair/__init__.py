"""Hair that stands off the head as a surface of its own: which pixels show it, where it ends, what of it is there.

Read in this order: hair_pixels, shell_grid, hull, coverage, streaks, joined, hair_files.
May import: compute, geometry, imaging, io.
"""
