"""Vector operations inside numba kernels agree with the scalar functions of the same name."""

import numba
import numpy as np
import pytest

from r5dgs_core.raster.cpu.simd import float32x16, float64x8, vectors


@numba.njit
def apply_exp2(values, result):
    for at in range(0, len(values), float32x16.LANES):
        float32x16.store(result, at, float32x16.exp2(float32x16.load(values, at)))


@numba.njit
def apply_reciprocal(values, result):
    for at in range(0, len(values), float32x16.LANES):
        float32x16.store(result, at, float32x16.reciprocal(float32x16.load(values, at)))


def test_reciprocal_is_good_to_float32_rounding():
    values = np.concatenate([np.linspace(0.009, 1.0, 80_000), np.geomspace(1e-30, 1e30, 1600)]).astype(np.float32)
    result = np.empty_like(values)
    apply_reciprocal(values, result)
    assert np.abs(result * values.astype(np.float64) - 1).max() < 2e-7


@numba.njit
def choose(a, b, c, result):
    x, y, z = float32x16.load(a, 0), float32x16.load(b, 0), float32x16.load(c, 0)
    condition = (x >= y) & ~(float32x16.splat(np.float32(0)) >= z) | (y > float32x16.broadcast(a, 3))
    float32x16.store(
        result, 0, vectors.select(condition, vectors.fma(x, y, z), vectors.smaller(x, y) - vectors.larger(y, z))
    )
    bits = vectors.bits_of(condition)
    float32x16.store(result, float32x16.LANES, vectors.select(float32x16.mask_of(bits), -x, y / x))
    return vectors.any_of(condition), vectors.unlikely(vectors.any_of(condition)), bits


@numba.njit
def add_up(values, result):
    zero = float32x16.splat(np.float32(0))
    a, b, c, d = (
        float32x16.load(values, 0),
        float32x16.load(values, 16),
        float32x16.load(values, 32),
        float32x16.load(values, 48),
    )
    vectors = (a, b, c, d, a + b, a - b, a * b, zero, c + d, c - d, c * d, b + c, b - c, b * c, a + d, a - d)
    float32x16.store(result, 0, float32x16.totals(vectors))


@numba.njit
def copy_blocks(image, other, result, other_result, width):
    float32x16.store_rows(result, 5, width, float32x16.load_rows(image, 5, width))
    three = float32x16.load_rows_of_three(other, 6, 3 * width)
    float32x16.store_rows_of_three(other_result, 6, 3 * width, three[0], three[1] + three[1], three[2])


@numba.njit
def find_lowest_bit(bits):
    return vectors.lowest_bit(bits)


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


def test_lanes_select_like_numpy():
    random = np.random.default_rng(0)
    seen = set()
    for shift in (-30.0, 0.0):
        a, b, c = (random.normal(size=float32x16.LANES).astype(np.float32) for _ in range(3))
        b[b > a[3] + shift] = a[3] + shift
        a[4:] += np.float32(shift)
        result = np.empty(2 * float32x16.LANES, np.float32)
        any_holds, same, bits = choose(a, b, c, result)
        condition = (a >= b) & (c > 0) | (b > a[3])
        expected = np.where(condition, a.astype(np.float64) * b + c, np.minimum(a, b) - np.maximum(b, c))
        np.testing.assert_allclose(result[: float32x16.LANES], expected, rtol=1e-6, atol=1e-6)
        np.testing.assert_array_equal(result[float32x16.LANES :], np.where(condition, -a, b / a))
        assert any_holds == same == condition.any()
        assert bits == (condition * 2 ** np.arange(float32x16.LANES)).sum()
        seen.add(bits)
    assert len(seen) == 2


def test_totals_are_the_sums_of_each_vector():
    values = np.random.default_rng(1).normal(size=64).astype(np.float32)
    result = np.empty(float32x16.LANES, np.float32)
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


@numba.njit
def work_on_doubles(table, bases, result, rows, wide):
    a, b = float64x8.column(table, 2, 8, 3, 1), float64x8.column(table, 2, 8, 3, 2)
    root, third = float64x8.sqrt(a), float64x8.floor(a * float64x8.spread(3.0))
    columns = (a, b, root, third, float64x8.log2(a), vectors.select(a > b, a, b), float64x8.entry(bases, 1), -a)
    float64x8.store_table(rows, 1, columns)
    float64x8.set_column(result, 0, 2, 1, root)
    low, high = float64x8.widen(float32x16.load(table, 0))
    float64x8.store_doubles(wide, 0, low)
    float64x8.store_doubles(wide, 8, high)


def test_doubles_read_and_write_columns_and_tables():
    table = np.random.default_rng(3).uniform(1e-3, 40, size=(9, 3)).astype(np.float32)
    result, rows, wide = np.zeros((8, 2), np.float32), np.zeros((9, 8)), np.zeros(16)
    work_on_doubles(table.ravel(), np.array([1.5, 2.5]), result.ravel(), rows.ravel(), wide)
    taken = np.minimum(np.arange(2, 10), 8)  # the table ends one row early
    a, b = table[taken, 1].astype(np.float64), table[taken, 2].astype(np.float64)
    expected = [a, b, np.sqrt(a), np.floor(3 * a), np.log2(a), np.maximum(a, b), np.full(8, 2.5), -a]
    np.testing.assert_allclose(rows[1:], np.stack(expected, 1), rtol=1e-15, atol=1e-15)
    assert not rows[0].any() and not result[:, 0].any()
    np.testing.assert_array_equal(result[:, 1], np.sqrt(a).astype(np.float32))
    np.testing.assert_array_equal(wide, table.ravel()[:16])


@numba.njit
def logarithms(values, result):
    for at in range(0, len(values), float64x8.DOUBLES):
        vector = float64x8.column(values, at, len(values) - 1, 1, 0)
        float64x8.store_doubles(result, at, float64x8.log2(vector))


def test_log2_is_good_to_float64_rounding():
    values = np.concatenate([np.geomspace(1e-300, 1e300, 8000), np.linspace(0.5, 2, 8000), [1.0, 2.0, 0.5, 1024.0] * 2])
    result = np.empty_like(values)
    logarithms(values, result)
    np.testing.assert_allclose(result, np.log2(values), rtol=4e-16, atol=4e-16)
    np.testing.assert_array_equal(result[-4:], [0, 1, -1, 10])
