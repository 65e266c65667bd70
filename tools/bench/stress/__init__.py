"""`python -m tools.bench.stress`: where Limn fails, and whether it says so.

Read in this order: scenes, camera, perturbations, subject, run, verdict, report, bench.
May import: shared, tools.cli, tools.synthesis, tools.scoring, tools.bench.runner, tools.bench.drawing.
"""
