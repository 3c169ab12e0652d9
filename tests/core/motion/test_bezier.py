"""Cutting a Bezier segment changes nothing of the curve."""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from r5dgs_core.motion import bezier

values = st.floats(-5, 5)


def on(segment, u):
    weights = np.array([(1 - u) ** 3, 3 * u * (1 - u) ** 2, 3 * u * u * (1 - u), u**3])
    return weights @ segment


def value_at(segment, time):
    low, high = 0.0, 1.0
    for _ in range(80):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if on(segment, middle)[0] < time else (low, middle)
    return on(segment, 0.5 * (low + high))[1]


@given(
    ends=st.tuples(values, values),
    handles=st.tuples(st.floats(0, 2.0), values, st.floats(0, 2.0), values),
    cut=st.floats(0.05, 0.95),
    at=st.floats(0.01, 0.99),
)
@example(ends=(0.0, 1.0), handles=(1.9, 3.0, 1.9, -2.0), cut=0.505, at=0.3)
@example(ends=(0.0, 1.0), handles=(1.9, 3.0, 1.9, -2.0), cut=0.495, at=0.7)
@example(ends=(0.0, 1.0), handles=(1.7, 3.0, 2.0, -2.0), cut=0.6, at=0.45)
def test_the_parts_are_the_curve(ends, handles, cut, at):
    a, va, b, vb = handles
    segment = np.array([[0.0, ends[0]], [a, va], [2.0 - b, vb], [2.0, ends[1]]])
    whole = bezier.clamp_handles(segment)
    before, after = bezier.split(segment, 2 * cut)
    parts = np.concatenate([before, after])
    assert 2 <= len(parts) <= 3
    np.testing.assert_array_equal(parts[:-1, 3], parts[1:, 0])
    np.testing.assert_allclose([parts[0, 0], parts[-1, 3]], [whole[0], whole[3]])
    np.testing.assert_allclose(after[0, 0, 0], 2 * cut, atol=1e-12)
    for part in parts:  # to rounding, nothing is left that Blender would shorten
        np.testing.assert_allclose(bezier.clamp_handles(part), part, atol=1e-9)
    time = 2 * cut * at if at < 0.5 else 2 * cut + (2 - 2 * cut) * at
    u = np.linspace(0, 1, 101)
    rate = np.stack([(1 - u) ** 2, 2 * u * (1 - u), u**2], axis=-1) @ np.diff(whole[:, 0])
    if rate.min() > 1e-2:  # a curve that stands still in time has no one value there
        part = parts[min(int(np.searchsorted(parts[:, 3, 0], time)), len(parts) - 1)]
        assert value_at(bezier.clamp_handles(part), time) == pytest.approx(value_at(whole, time), abs=1e-9)


def test_handles_that_reach_past_the_other_key_are_shortened_and_those_that_overlap_are_not():
    past = np.array([[0.0, 0.0], [3.0, 3.0], [-1.0, 1.0], [2.0, 2.0]])
    np.testing.assert_allclose(bezier.clamp_handles(past), [[0, 0], [2, 2], [0, 4 / 3], [2, 2]])
    overlapping = np.array([[0.0, 0.0], [1.5, 3.0], [0.5, 1.0], [2.0, 2.0]])
    np.testing.assert_array_equal(bezier.clamp_handles(overlapping), overlapping)


@pytest.mark.parametrize("time", [0.0, 2.0, -1.0, 3.0])
def test_a_cut_outside_is_refused(time):
    with pytest.raises(ValueError, match="between"):
        bezier.split(np.array([[0.0, 0], [0.5, 0], [1.5, 0], [2.0, 0]]), time)


def test_values_and_slopes_are_those_of_the_segments():
    segments = np.array([
        [[0.0, 1.0], [0.5, 2.0], [1.2, -1.0], [2.0, 0.0]],
        [[2.0, 0.0], [4.0, 0.0], [2.0, 3.0], [5.0, 1.0]],
    ])  # fmt: skip
    times = np.array([0.3, 1.0, 1.9, 2.5, 4.6])
    values, slopes = bezier.evaluate(segments, times)
    expected = [value_at(bezier.clamp_handles(segments[0 if t < 2 else 1]), t) for t in times]
    np.testing.assert_allclose(values, expected, atol=1e-9)
    ahead, _ = bezier.evaluate(segments, times + 1e-5)
    behind, _ = bezier.evaluate(segments, times - 1e-5)
    np.testing.assert_allclose(slopes, (ahead - behind) / 2e-5, rtol=1e-4)
    np.testing.assert_allclose(bezier.evaluate(segments, np.array([0.0, 2.0, 5.0]))[0], [1.0, 0.0, 1.0], atol=1e-12)
