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
    condition = (x >= y) & ~(lanes.splat(np.float32(0)) >= z) | (y > lanes.broadcast(a, 3))
    lanes.store(result, 0, lanes.select(condition, lanes.fma(x, y, z), lanes.smaller(x, y) - lanes.larger(y, z)))
    bits = lanes.bits_of(condition)
    lanes.store(result, lanes.LANES, lanes.select(lanes.mask_of(bits), -x, y / x))
    return lanes.any_of(condition), lanes.unlikely(lanes.any_of(condition)), bits


@numba.njit
def add_up(values, result):
    zero = lanes.splat(np.float32(0))
    a, b, c, d = lanes.load(values, 0), lanes.load(values, 16), lanes.load(values, 32), lanes.load(values, 48)
    vectors = (a, b, c, d, a + b, a - b, a * b, zero, c + d, c - d, c * d, b + c, b - c, b * c, a + d, a - d)
    lanes.store(result, 0, lanes.totals(vectors))


@numba.njit
def copy_blocks(image, other, result, other_result, width):
    lanes.store_rows(result, 5, width, lanes.load_rows(image, 5, width))
    three = lanes.load_rows_of_three(other, 6, 3 * width)
    lanes.store_rows_of_three(other_result, 6, 3 * width, three[0], three[1] + three[1], three[2])


@numba.njit
def find_lowest_bit(bits):
    return lanes.lowest_bit(bits)


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


def test_lanes_choose_like_numpy():
    random = np.random.default_rng(0)
    seen = set()
    for shift in (-30.0, 0.0):
        a, b, c = (random.normal(size=lanes.LANES).astype(np.float32) for _ in range(3))
        b[b > a[3] + shift] = a[3] + shift
        a[4:] += np.float32(shift)
        result = np.empty(2 * lanes.LANES, np.float32)
        any_holds, same, bits = choose(a, b, c, result)
        condition = (a >= b) & (c > 0) | (b > a[3])
        expected = np.where(condition, a.astype(np.float64) * b + c, np.minimum(a, b) - np.maximum(b, c))
        np.testing.assert_allclose(result[: lanes.LANES], expected, rtol=1e-6, atol=1e-6)
        np.testing.assert_array_equal(result[lanes.LANES :], np.where(condition, -a, b / a))
        assert any_holds == same == condition.any()
        assert bits == (condition * 2 ** np.arange(lanes.LANES)).sum()
        seen.add(bits)
    assert len(seen) == 2


def test_totals_are_the_sums_of_each_vector():
    values = np.random.default_rng(1).normal(size=64).astype(np.float32)
    result = np.empty(lanes.LANES, np.float32)
    add_up(values, result)
    a, b, c, d = values.astype(np.float64).reshape(4, 16)
    vectors = (a, b, c, d, a + b, a - b, a * b, 0 * a, c + d, c - d, c * d, b + c, b - c, b * c, a + d, a - d)
    np.testing.assert_allclose(result, [vector.sum() for vector in vectors], rtol=1e-5, atol=1e-5)


def test_blocks_of_an_image_come_back_where_they_were():
    random, width = np.random.default_rng(2), 11
    image, other = (random.normal(size=(6, width, k)).astype(np.float32) for k in (1, 3))
    result, other_result = np.zeros_like(image), np.zeros_like(other)
    copy_blocks(image.ravel(), other.ravel(), result.ravel(), other_result.ravel(), width)
    expected, other_expected = np.zeros_like(image), np.zeros_like(other)
    expected[0:4, 5:9] = image[0:4, 5:9]
    other_expected[0:4, 2:6] = other[0:4, 2:6] * np.array([1, 2, 1], np.float32)
    np.testing.assert_array_equal(result, expected)
    np.testing.assert_array_equal(other_result, other_expected)


@pytest.mark.parametrize("bit", [0, 5, 31, 63])
def test_the_lowest_bit_is_found(bit):
    assert find_lowest_bit(np.uint64(1 << bit)) == bit
    assert find_lowest_bit(np.uint64((1 << bit) | (1 << 63))) == bit
