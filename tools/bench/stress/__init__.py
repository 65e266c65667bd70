"""`python -m tools.bench.stress`: where Limn fails, and whether it says so.

Read in this order: scenes, camera, perturbations, subject, run, verdict, chart, table, command.
May import: shared, tools.cli, tools.synthesis, tools.scoring.
"""
