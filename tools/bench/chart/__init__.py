"""`python -m tools.bench.chart`: speed against accuracy on a subject whose truth is known.

Read in this order: cases, runs, scores, rows, tradeoff, bench.
May import: shared, tools.synthesis, tools.scoring, tools.demo, tools.relight, tools.bench.runner, tools.bench.drawing.
"""
