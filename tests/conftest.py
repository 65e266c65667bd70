"""Threads are fixed so that sums run in one order; the tests' own shapes can be imported."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
