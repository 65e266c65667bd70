"""Whether tests run in full (`make test-all`) or only the share that keeps `make test` short."""

import os

SLOW = os.environ.get("LIMN_SLOW_TESTS", "") not in ("", "0")
