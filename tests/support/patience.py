"""Waiting for another thread or process, with a time limit."""

import time

PATIENCE_S = 120.0  # the rasterizer may have to be compiled


def wait_until(condition):
    """Return when a condition holds. If it never does, the test fails instead of hanging."""
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline, f"it did not come within {PATIENCE_S:g} s"
        time.sleep(0.001)
