"""Gravity of a scene's bodies, and laws of tracks with known errors."""

from __future__ import annotations

import numpy as np
import pytest

from r5dgs_core.bake import future_fit
from r5dgs_core.motion import rotations
from r5dgs_core.motion.history import PoseErrors
from r5dgs_core.motion_fit import model_selection, shared_gravity
from tests.support import scenes

TIMES = np.linspace(0, 0.75, 15)
FAMILY = ("static", "translation", "translation, quadratic")  # other tests choose from the whole family


def fits_of(accelerations):
    rng, fits = np.random.default_rng(0), {}
    for index, acceleration in enumerate(accelerations):
        tau = (TIMES - TIMES[-1])[:, None]
        path = tau * [0.3, 0.5, 0.1] + 0.5 * tau**2 * acceleration + 1e-3 * rng.normal(size=(15, 3))
        path -= path[-1]
        track = shared_gravity.BodyTrack(TIMES, rotations.identity(15), path, np.ones(15))
        fits[index] = track, model_selection.fit(TIMES, track.quats, path, radius=0.3, candidates=FAMILY)
    return fits


@pytest.mark.parametrize(("convention", "up"), [("blender", 2), ("opengl", 1)])
def test_falling_bodies_share_gravity_and_braking_ones_do_not(convention, up):
    down = np.zeros(3)
    down[up] = -6.0
    fits = fits_of([down, down, np.array([-4.0, 0, 0])])
    shared = {index: fit.model for index, fit in future_fit.share_gravity(fits, convention).items()}
    np.testing.assert_array_equal(shared[0].acceleration, shared[1].acceleration)
    np.testing.assert_allclose(shared[0].acceleration, down, atol=0.2)
    assert np.delete(shared[0].acceleration, up).tolist() == [0, 0]
    assert shared[2] is fits[2][1].model


def test_conventions_without_an_up_axis_share_no_gravity():
    fits = fits_of([np.array([0, 0, -6.0])] * 2)
    assert future_fit.share_gravity(fits, "colmap") == {k: fit for k, (_, fit) in fits.items()}
    assert future_fit.share_gravity({}, "blender") == {}


def test_a_law_does_not_follow_slow_errors_of_rotations_that_are_known():
    scene = scenes.make_scene(60, 1)
    tau = scene.tracks.times - scene.t_max
    drifting = np.radians(1.3) * (np.tanh((tau + 0.15) / 0.08) - np.tanh(0.15 / 0.08))  # in the last poses
    poses = np.zeros((len(tau), 7))
    poses[:, :4] = rotations.rotvecs_to_quats(tau[:, None] * [0.9, 2.7, 0.7] + drifting[:, None] * [0.3, 0.9, 0.3])
    poses[:, 4:] = tau[:, None] * [2.0, -1.0, -0.9]
    index = next(g.id for g in scene.groups if g.role == "body")
    observed = np.ones(len(tau), bool)
    claimed = PoseErrors((0.002,) * len(tau), (np.radians(0.6),) * len(tau))
    known, unknown = (
        future_fit.fit(scene, index, observed, poses, (0.0, 0.0), errors)[1].chosen for errors in (claimed, None)
    )
    assert known == "translation + spin" and unknown == "ballistic + spin, accelerating"
