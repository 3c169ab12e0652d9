"""Inverses of view transforms restore displayable colours and approximate the others."""

import numpy as np
import pytest

from r5dgs_core.color import view_inverse


def film(colors):
    """A curve for each channel: logarithmic, with a toe and a shoulder, clipped at both ends."""
    stops = np.log2(np.maximum(colors, 1e-6) / 0.18)
    return np.clip(0.5 - 0.5 * np.cos(np.pi * np.clip((stops + 10) / 16.6, 0, 1)), 0, 1)


def soft(colors):
    """View transform whose white is eight times brighter than that of the others."""
    return film(colors / 8)


MIX = np.array([[0.86, 0.09, 0.05], [0.06, 0.88, 0.06], [0.04, 0.12, 0.84]])


def mixed(colors):
    """Channels that are mixed before the curve, so that saturated colours need negative light."""
    return film(np.maximum(colors @ MIX.T, 0))


def gamma(colors):
    return np.clip(colors, 0, 1) ** (1 / 2.2)


def seen(n=3000, spread=0.7, seed=1):
    """Typical scene-linear colours. [N, 3]"""
    random = np.random.default_rng(seed)
    return 2.0 ** random.uniform(-5, 2, (n, 1)) * 2.0 ** random.uniform(-spread, spread, (n, 3))


def steps(a, b):
    return 255 * np.abs(np.asarray(a, np.float64) - b).max(axis=-1)


@pytest.fixture(scope="module")
def of():
    made = {}

    def get(forward):
        if forward not in made:
            made[forward] = view_inverse.invert(forward)
        return made[forward]

    return get


@pytest.mark.parametrize("forward", [film, mixed, gamma])
def test_inverting_a_view_restores_displayed_colours(of, forward):
    wanted = forward(seen())
    off = steps(forward(of(forward).scene_linear(wanted)), wanted)
    assert off.mean() < 0.3 and np.percentile(off, 95) < 1


@pytest.mark.parametrize("forward", [film, gamma])
def test_views_of_single_channels_reach_every_colour(of, forward):
    wanted = np.random.default_rng(2).random((3000, 3))
    off = steps(forward(of(forward).scene_linear(wanted)), wanted)
    assert np.percentile(off, 95) < 0.5


@pytest.mark.parametrize("forward", [film, mixed, gamma, soft])
def test_white_is_reached_at_any_brightness_of_the_view(of, forward):
    white = np.array([[1.0, 1.0, 1.0], [0.99, 0.99, 0.99]])
    assert steps(forward(of(forward).scene_linear(white)), white).max() < 1


def test_inverting_restores_scene_linear_colours_of_an_invertible_view(of):
    light = seen()
    found = of(film).scene_linear(film(light))
    np.testing.assert_allclose(found, light, rtol=0.02, atol=1e-3)


def test_negative_light_reaches_more_colours(of):
    """Colours that are more saturated than any displayed colour without negative light."""
    light = seen(500)
    light[:, 2] = -0.04 * light[:, 0]
    wanted = mixed(light)
    found = of(mixed).scene_linear(wanted)
    assert of(mixed).reach < 0.8 and of(film).reach > 0.95
    assert (found[:, 2] < 0).mean() > 0.9
    assert np.median(steps(mixed(found), wanted)) < 1 < 5 < np.median(steps(mixed(np.maximum(found, 0)), wanted))


def test_unreachable_colours_are_approximated_as_closely_as_possible(of):
    """They are nearer than with light clamped at zero, the start of the search."""
    wanted = np.array([[0.9, 0.05, 0.05], [0.05, 0.9, 0.05], [0.1, 0.1, 0.9]])
    greys = 2.0 ** np.linspace(-10, 4, 500)
    curve = mixed(np.repeat(greys[:, None], 3, axis=1))[:, 0]
    single = np.interp(wanted, curve, greys)
    inverse = of(mixed)
    assert np.square(mixed(inverse.scene_linear(wanted)) - wanted).sum() < np.square(mixed(single) - wanted).sum()
    assert np.isfinite(inverse.scene_linear(wanted)).all()


def test_an_exposure_is_a_scale(of):
    brighter = view_inverse.invert(lambda colors: mixed(8 * colors), scale=1 / 8)
    wanted = np.random.default_rng(3).random((100, 3))
    np.testing.assert_allclose(8 * brighter.scene_linear(wanted), of(mixed).scene_linear(wanted), rtol=1e-3, atol=1e-4)


def test_the_inverse_reports_its_error(of):
    assert of(film).error < 0.5 and of(mixed).error < 1
    folded = view_inverse.invert(lambda colors: np.abs(2 * gamma(colors) - 1))  # dark colours are displayed bright
    assert folded.error > 50


def test_pictures_keep_their_shape_and_colours_out_of_range_are_clamped(of):
    picture = np.array([[[-1.0, 0.5, 2.0], [0.0, 0.5, 1.0]]])
    found = of(film).scene_linear(picture)
    assert found.shape == picture.shape and found.dtype == np.float32
    np.testing.assert_array_equal(found[0, 0], found[0, 1])


def test_the_loss_of_colours_counts_them_by_weight_and_ends_where_rounding_does(of):
    reached = mixed(seen(spread=0.2))
    lost = np.tile([[1.0, 0.0, 0.0]], (len(reached), 1))
    wanted, even = np.concatenate([reached, lost]), np.ones(2 * len(reached))
    light = np.repeat([1.0, 0.0], len(reached))
    fine = view_inverse.loss(mixed, of(mixed), wanted, light)
    half = view_inverse.loss(mixed, of(mixed), wanted, even)
    assert 50 < fine.psnr < 58.93 and fine.unreached < 0.01
    assert half.psnr < fine.psnr - 5 and half.unreached == pytest.approx(0.5, abs=0.01)
    exact = view_inverse.loss(gamma, of(gamma), np.random.default_rng(2).random((3000, 3)), np.ones(3000))
    assert exact.psnr > 55 and exact.unreached == 0
