"""`python -m tools.relight`: a result, or any mesh, under other lights.

Read in this order: options, inputs, video, command.
May import: shared.
"""
