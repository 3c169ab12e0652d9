"""What a track does not show beyond its noise is left out, and nothing else."""

import numpy as np
import pytest

from r5dgs_core.motion import fitting, keyframes, models, rotations
from r5dgs_core.motion.models import MotionModel
from r5dgs_core.train import plain_motion

TIMES = np.linspace(0.0, 0.75, 15)
RADIUS = 0.3
SLIDE = MotionModel("translation", velocity=[0.4, -0.2, 0.0], radius=RADIUS)
SPIN = MotionModel("ballistic_spin", velocity=[0.4, 0, 0], angular_velocity=[0, 0, 1.5], radius=RADIUS)
FALL = MotionModel("translation", velocity=[0.2, 0, 1.0], acceleration=[0, 0, -3.0], radius=RADIUS)


def observed(model, noise=1.0, seed=0):
    """Noisy poses of a motion relative to the noisy last one. [S, 7]"""
    draw = np.random.default_rng(seed)
    quats, displacements, _, _ = models.curve(model, TIMES - TIMES[-1])
    turns = rotations.rotvecs_to_quats(noise * 0.003 * draw.standard_normal((len(TIMES), 3)))
    quats = rotations.multiply(turns, quats)
    displacements = displacements + noise * 0.001 * draw.standard_normal((len(TIMES), 3))
    quats = rotations.multiply(quats, rotations.conjugate(quats[-1]))
    return np.concatenate([quats, displacements - displacements[-1]], axis=1)


def reduced(poses):
    fit = fitting.fit(TIMES, poses[:, :4], poses[:, 4:], radius=RADIUS)
    plain = plain_motion.reduce("thing", TIMES, poses, fit)
    return plain, {row["name"]: row["decision"] for row in plain.rows}


@pytest.mark.parametrize("noise", [0.0, 1.0])
@pytest.mark.parametrize("seed", range(3))
def test_what_slides_straight_is_a_straight_slide_of_two_keys(noise, seed):
    plain, found = reduced(observed(SLIDE, noise, seed))
    assert found == {"motion": "on", "rotation": "off", "curved_path": "off"}
    assert (plain.poses[:, :4] == [1, 0, 0, 0]).all() and not plain.model.turns
    np.testing.assert_array_equal(plain.poses[:, 4:], plain.model.velocity * (TIMES - TIMES[-1])[:, None])
    np.testing.assert_allclose(plain.model.velocity, SLIDE.velocity, atol=0.02)
    assert np.linalg.norm(plain.shift) < 0.005
    seen = keyframes.slopes(TIMES, plain.poses[:, 4:])
    still = keyframes.Keys(TIMES[:1], plain.poses[:1, :4], np.zeros((1, 4)), np.zeros((1, 4)))
    past = keyframes.Keys(TIMES[[0, -1]], plain.poses[[0, -1], 4:], seen[[0, -1]], seen[[0, -1]])
    later = keyframes.reduce(keyframes.model_sampler(plain.model, TIMES[-1]), TIMES[-1], 1.5, 1e-5, RADIUS)
    joined = keyframes.join(keyframes.Curves(past, still), later)
    assert joined.location.times.tolist() == [0.0, 1.5]
    assert joined.rotation.times.tolist() == [0.0]


@pytest.mark.parametrize(("model", "wanted"), [(SPIN, ("on", "on")), (FALL, ("off", "on"))])
def test_what_turns_or_falls_keeps_that(model, wanted):
    poses = observed(model)
    plain, found = reduced(poses)
    assert (found["rotation"], found["curved_path"]) == wanted
    np.testing.assert_array_equal(plain.poses[:, 4:], poses[:, 4:])
    assert (plain.shift == 0).all()
    assert np.array_equal(plain.poses[:, :4], poses[:, :4]) == (wanted[0] == "on")


def test_a_wobble_that_no_model_explains_is_no_noise():
    poses = observed(SLIDE)
    poses[:, 6] += 0.05 * np.where(np.arange(len(TIMES)) % 2, 1, -1) + 0.05
    poses[:, 6] -= poses[-1, 6]
    plain, found = reduced(poses)
    assert found["curved_path"] == "on"
    np.testing.assert_array_equal(plain.poses[:, 4:], poses[:, 4:])


def test_a_body_that_came_to_rest_keeps_what_it_did_before():
    quats, moved = models.evaluate(SPIN, np.minimum(TIMES, 0.4))
    quats = rotations.multiply(quats, rotations.conjugate(quats[-1]))
    poses = np.concatenate([quats, moved - moved[-1]], axis=1)
    plain, found = reduced(poses)
    assert found["rotation"] == found["curved_path"] == "on"
    np.testing.assert_array_equal(plain.poses, poses)
    assert plain.model.kind == "static"
