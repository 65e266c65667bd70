"""Measurements for developers, each a command of its own: python -m tools.bench.<name> --help.

Read in this order: svg_file, appearance, shape, model_selection, published, degrade, tracking, colour_chart, statue,
shading.
May import: shared, stages, tools.synthesis, tools.scoring, tools.bench.peers, tools.bench.chart.
"""
