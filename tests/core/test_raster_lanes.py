"""Vector operations inside numba kernels do what their scalar namesakes do."""

import numpy as np
import pytest

numba = pytest.importorskip("numba", reason="lanes live in numba kernels")

from r5dgs_core.raster import lanes  # noqa: E402


@numba.njit
def apply_exp2(values, result):
    for at in range(0, len(values), lanes.LANES):
        lanes.store(result, at, lanes.exp2(lanes.load(values, at)))


@numba.njit
def choose(a, b, c, result):
    x, y, z = lanes.load(a, 0), lanes.load(b, 0), lanes.load(c, 0)
    condition = (x >= y) & (z > lanes.splat(np.float32(0)))
    lanes.store(result, 0, lanes.select(condition, lanes.fma(x, y, z), lanes.smaller(x, y) - lanes.larger(y, z)))
    return lanes.any_of(condition), lanes.total(x), lanes.total(lanes.iota() / lanes.broadcast(a, 3))


def test_exp2_is_good_to_float32_rounding():
    values = np.linspace(-30, 30, 80_000, dtype=np.float32)
    result = np.empty_like(values)
    apply_exp2(values, result)
    exact = 2.0 ** values.astype(np.float64)
    assert np.abs(result / exact - 1).max() < 2e-7
    whole = np.arange(-24, 24, dtype=np.float32)
    result = np.empty_like(whole)
    apply_exp2(whole, result)
    np.testing.assert_array_equal(result, 2.0**whole)


def test_lanes_choose_and_sum_like_numpy():
    random = np.random.default_rng(0)
    seen = set()
    for shift in (-3.0, 0.0):
        a, b, c = (random.normal(size=8).astype(np.float32) for _ in range(3))
        a += np.float32(shift)
        result = np.empty(8, np.float32)
        any_holds, sum_a, sum_iota = choose(a, b, c, result)
        condition = (a >= b) & (c > 0)
        expected = np.where(condition, a.astype(np.float64) * b + c, np.minimum(a, b) - np.maximum(b, c))
        np.testing.assert_allclose(result, expected, rtol=1e-6, atol=1e-6)
        assert any_holds == condition.any()
        np.testing.assert_allclose([sum_a, sum_iota], [a.sum(dtype=np.float64), 28 / a[3]], rtol=1e-5)
        seen.add(bool(any_holds))
    assert seen == {True, False}
