"""A short capture for the tests of `r5dgs prepare`."""

import pytest

from tests.support import recordings


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """Three short videos of the tiny scene through distorted lenses, with their calibration."""
    return recordings.record_tiny(tmp_path_factory.mktemp("capture") / "videos")
