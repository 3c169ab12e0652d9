"""The median over time of the pixels that count."""

import numpy as np
import pytest

from r5dgs_core.data import temporal_median


@pytest.mark.parametrize("count", [1, 2, 5, 8])
def test_the_median_over_time_is_that_of_the_free_pixels_for_any_number_of_bands(monkeypatch, count):
    rng = np.random.default_rng(count)
    images = rng.integers(0, 256, (count, 11, 7, 3)).astype(np.uint8)
    free = rng.random((count, 11, 7)) < 0.6
    found = temporal_median.median(list(images), free)
    for y, x in np.ndindex(11, 7):
        seen = images[free[:, y, x], y, x]
        expected = np.median(seen, axis=0) / 255 if len(seen) else np.zeros(3)
        np.testing.assert_allclose(found[y, x], expected, atol=1e-7)
    monkeypatch.setattr(temporal_median, "VALUES", 1)
    assert (temporal_median.median(list(images), free) == found).all()
