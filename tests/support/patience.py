"""Waiting for what another thread or process does, and not for ever."""

import time

PATIENCE_S = 120.0  # the rasterizer may have to be compiled


def wait_until(condition):
    """Return when a condition holds; a test in which that never comes fails instead of hanging."""
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline, f"it did not come within {PATIENCE_S:g} s"
        time.sleep(0.001)
