"""Colours of cameras are found from the points that they share, and equal cameras are left alone."""

import dataclasses

import numpy as np
import pytest

from r5dgs_core.train.initialization import background_images, color_balance, plane_sweep
from tests.core.train.initialization.test_plane_sweep import floor_views

DEPTHS = 48


def found(views, forced=False):
    images = background_images.compute(views)
    return color_balance.find(images, plane_sweep.Sweep(images, 3000, DEPTHS), DEPTHS, forced)


def named(views):
    return [
        dataclasses.replace(view, camera=dataclasses.replace(view.camera, name=f"cam{k}"))
        for k, view in enumerate(views)
    ]


def recolored(views, gains, offsets):
    """The views in other colours. Gains and offsets [C, 3]"""
    return [
        view.with_arrays(np.rint(np.clip(255 * (view.image / 255 * g + o), 0, 255)).astype(np.uint8))
        for view, g, o in zip(views, gains, offsets, strict=True)
    ]


@pytest.fixture(scope="module")
def wrong():
    rng = np.random.default_rng(4)
    gains, offsets = 1 + 0.1 * rng.normal(size=(5, 3)), 0.01 * rng.normal(size=(5, 3))
    gains, offsets = gains / gains.mean(0), offsets - offsets.mean(0)
    return gains, offsets, recolored(named(floor_views()), gains, offsets)


def test_gains_and_offsets_are_found(wrong):
    gains, offsets, views = wrong
    balance = found(views)
    assert balance is not None and balance.gain_db > 6
    rows = [balance.names.index(view.camera.name) for view in views]
    at = 0.5  # the middle of the texture's colours, where gain and offset are told apart least
    errors = at * balance.gains[rows] + balance.offsets[rows] - (at * gains + offsets)
    assert np.sqrt(np.mean(errors**2)) < 0.15 * np.sqrt(np.mean((at * gains + offsets - at) ** 2))


def test_corrected_views_agree(wrong):
    _, _, views = wrong
    balance = found(views)
    clean = named(floor_views())
    before, after = (
        np.mean([np.abs(a.image.astype(float) - b.image).mean() for a, b in zip(some, clean, strict=True)])
        for some in (views, balance.views(views))
    )
    assert after < 0.3 * before


def test_equal_cameras_are_left_alone():
    assert found(named(floor_views())) is None


def test_the_means_of_gains_and_offsets_stay_if_colours_are_forced():
    balance = found(named(floor_views()), forced=True)
    np.testing.assert_allclose(balance.gains.mean(0), 1, atol=1e-9)
    np.testing.assert_allclose(balance.offsets.mean(0), 0, atol=1e-9)
    assert np.abs(balance.gains - 1).max() < 0.03


def test_cameras_without_common_points_are_not_compared():
    views = named(floor_views())
    dark = [view.with_arrays(np.zeros_like(view.image)) for view in views]
    assert found(dark) is None
