import numpy as np
import pytest

from r5dgs_core.color import srgb


def test_known_values_of_the_standard():
    assert srgb.from_linear(np.array([0.0, 0.0031308, 0.21404114, 1.0])) == pytest.approx(
        [0, 0.04045, 0.5, 1], abs=1e-6
    )


def test_both_directions_are_inverse_also_above_one():
    values = np.linspace(0, 4, 1001)
    np.testing.assert_allclose(srgb.to_linear(srgb.from_linear(values)), values, atol=1e-7)
    np.testing.assert_allclose(srgb.from_linear(srgb.to_linear(values)), values, atol=1e-7)


def test_negative_values_are_black_and_float32_stays():
    for curve in (srgb.to_linear, srgb.from_linear):
        found = curve(np.array([-1.0, 0.5], np.float32))
        assert found[0] == 0
        assert found.dtype == np.float32
