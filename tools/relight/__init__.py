"""`python -m tools.relight`: a result, or any mesh, under other lights. `limn turntable`: a result to show to others.

Read in this order: options, inputs, video, command, map_sheet, turntable.
May import: shared.
"""
