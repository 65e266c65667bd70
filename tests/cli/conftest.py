"""The toy pipeline, for all tests of the command line."""

import pytest
from toy_runs import copy_pipeline


@pytest.fixture
def pipeline(tmp_path):
    """A copy that the test may change: its pipeline.yaml."""
    return copy_pipeline(tmp_path / "toy")
