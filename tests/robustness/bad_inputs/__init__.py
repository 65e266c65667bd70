"""A corpus of bad and odd inputs, made by script: each a subject (or a pipeline) and what has to come of it.

    python tests/robustness/bad_inputs/measure.py [NAME ...]     runs each to the end: exit code, message, seconds,
    memory
"""

from bad_inputs.cases import CASES, Case

__all__ = ["CASES", "Case"]
