"""Keeps the README's tables and picture in step with the code and its results.

Read in this order: readme, picture.
May import: shared, tools.bench.chart.
"""
