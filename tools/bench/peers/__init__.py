"""Programs that are not ours, on the same subjects: Mitsuba 3 and Blender.

Read in this order: mitsuba, inverse, blender_probe, blender.
May import: shared, tools.scoring.
"""
