"""The head model that `make setup` builds, for all tests of tracking."""

import pytest

from shared.tracking.models import load_head_model


@pytest.fixture(scope="session")
def model():
    return load_head_model()
