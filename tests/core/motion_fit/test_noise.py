import numpy as np
import pytest

from r5dgs_core.motion import rotations
from r5dgs_core.motion.pose_track import PoseTrack
from r5dgs_core.motion_fit import noise

EVEN = np.linspace(-1, 0, 400)
UNEVEN = np.sort(np.random.default_rng(0).uniform(-1, 0, 400))


@pytest.mark.parametrize("tau", [EVEN, UNEVEN], ids=["even", "uneven"])
def test_the_noise_of_a_smooth_motion_is_estimated_without_a_law(tau):
    rng, place, turn = np.random.default_rng(1), 0.01, 0.02
    d = [1, 2, 3] + tau[:, None] * [3, -1, 0] + tau[:, None] ** 2 * [0, 5, -4] + place * rng.normal(size=(400, 3))
    quats = rotations.rotvecs_to_quats((tau + tau**2)[:, None] * [0, 0, 2.0])
    quats = rotations.multiply(rotations.rotvecs_to_quats(turn * rng.normal(size=(400, 3))), quats)
    found = noise.estimate(PoseTrack(tau, quats, d, np.ones(400)))
    assert found.place == pytest.approx(place, rel=0.1)
    assert found.turn == pytest.approx(turn, rel=0.1)


def test_motions_quadratic_in_time_have_the_least_noise():
    tau = UNEVEN[::20]
    quats = rotations.rotvecs_to_quats((tau + tau**2)[:, None] * [0, 0, 2.0])
    found = noise.estimate(PoseTrack(tau, quats, tau[:, None] ** 2 * [0, 5.0, -4], np.ones(len(tau))))
    assert (found.place, found.turn) == (noise.FLOOR, noise.FLOOR)


def test_images_bound_the_noise_by_a_share_of_the_diameter():
    assert noise.of_images(2.0) == pytest.approx((0.004, 0.002))
    assert noise.of_images(2.0, place=0.1, turn=0.2) == (0.1, 0.2)
