"""Gravity of a scene's bodies."""

from __future__ import annotations

import numpy as np
import pytest

from r5dgs_core.motion import fitting, gravity, rotations
from r5dgs_core.scene.scene import MotionGroup
from r5dgs_core.train import falling

TIMES = np.linspace(0, 0.75, 15)
NAMES = {1: "apple", 2: "pear", 3: "cart"}


def scene_of(accelerations):
    rng, rows, fits, played = np.random.default_rng(0), [], {}, []
    for index, acceleration in enumerate(accelerations):
        tau = (TIMES - TIMES[-1])[:, None]
        path = tau * [0.3, 0.5, 0.1] + 0.5 * tau**2 * acceleration + 1e-3 * rng.normal(size=(15, 3))
        path -= path[-1]
        track = gravity.Track(TIMES, rotations.identity(15), path, np.ones(15))
        fit = fitting.fit(TIMES, track.quats, path, radius=0.3)
        fits[index] = track, fit
        played.append(np.concatenate([track.quats, path], axis=1))
        rows.append(MotionGroup(index, index + 1, "body", 0, np.zeros(3), fit.model))
    return rows, fits, played


@pytest.mark.parametrize(("convention", "up"), [("blender", 2), ("opengl", 1)])
def test_what_falls_shares_gravity_and_what_brakes_does_not(convention, up):
    down = np.zeros(3)
    down[up] = -6.0
    rows, fits, played = scene_of([down, down, np.array([-4.0, 0, 0])])
    shared = falling.share_gravity(rows, fits, played, convention, NAMES)
    np.testing.assert_array_equal(shared[0].model.acceleration, shared[1].model.acceleration)
    np.testing.assert_allclose(shared[0].model.acceleration, down, atol=0.2)
    assert np.delete(shared[0].model.acceleration, up).tolist() == [0, 0]
    assert shared[2] is rows[2]


def test_where_nobody_says_what_is_up_nothing_is_shared():
    rows, fits, played = scene_of([np.array([0, 0, -6.0])] * 2)
    assert falling.share_gravity(rows, fits, played, "colmap", NAMES) == rows
    assert falling.share_gravity([], {}, [], "blender", {}) == []
