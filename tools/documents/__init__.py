"""Keeps the README's tables and the documents' pictures in step with the code and its results.

Read in this order: readme, picture, eyes.
May import: shared, tools.bench, tools.bench.chart.
"""
