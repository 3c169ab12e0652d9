import dataclasses
import math

import numpy as np
import pytest

from r5dgs_core.motion import rotations
from r5dgs_core.motion.pose_track import PoseTrack
from r5dgs_core.motion_fit import backtest, breaks, candidates

COUNT = 15
TAU = np.linspace(-1, 0, COUNT)
SIGMA = 0.01
STATIC, LINE = candidates.BY_NAME["static"], candidates.BY_NAME["translation + spin"]


def observed(rng, v=0.0, scale=1.0, count=COUNT):
    """Noisy poses of a body that moves at velocity v along x; place and turn have the noise ``scale * SIGMA``."""
    noise = scale * SIGMA * rng.normal(size=(2, count, 3))
    d = v * TAU[-count:, None] * [1, 0, 0] + noise[0]
    return PoseTrack(TAU[-count:], rotations.rotvecs_to_quats(noise[1]), d, np.ones(count))


def fitted(law, track, noise):
    solution = candidates.solve(law, track, noise)
    assert solution is not None
    return solution


def test_errors_of_predictions_by_the_mean_of_earlier_poses():
    noise = candidates.Noise(4 * SIGMA, 4 * SIGMA)  # so that the robust weights of all poses are near one
    track = observed(np.random.default_rng(0))
    values = np.concatenate([track.displacements, 2 * track.quats[:, 1:]], 1)
    shares = []
    for held in (1, 3, 5):
        errors = values[-held:] - values[:-held].mean(0)
        shares += list((errors**2).sum(1) / (6 * SIGMA**2 * (1 + 1 / (COUNT - held))))
    # The refit starts far from its minimum, so that it takes its steps.
    chosen = dataclasses.replace(fitted(STATIC, track, noise), theta=np.full(6, 20 * SIGMA))
    assert backtest.relative_error(chosen, track, noise, 1 / 16) == pytest.approx(np.mean(shares), rel=0.05)


@pytest.mark.parametrize("variance", [0.25, 1.0])
def test_predictions_of_the_true_law_have_the_expected_error(variance):
    rng, noise = np.random.default_rng(1), candidates.Noise(SIGMA, SIGMA)
    errors = []
    for _ in range(60):
        track = observed(rng, v=1.0, scale=math.sqrt(variance))
        errors.append(backtest.relative_error(fitted(LINE, track, noise), track, noise, variance))
    assert np.mean(errors) == pytest.approx(1.0, abs=0.15)


def test_predictions_of_a_wrong_law_have_a_large_error_of_limited_size():
    noise, track = candidates.Noise(SIGMA, SIGMA), observed(np.random.default_rng(2), v=0.5)
    assert backtest.relative_error(fitted(STATIC, track, noise), track, noise, 1.0) > 10
    fast = observed(np.random.default_rng(2), v=100.0)
    assert backtest.relative_error(fitted(STATIC, fast, noise), fast, noise, 1.0) <= 100


def test_what_cannot_be_predicted_has_no_error():
    noise, track = candidates.Noise(SIGMA, SIGMA), observed(np.random.default_rng(3), v=1.0)
    short = track.rows(slice(-7, None))
    assert backtest.relative_error(fitted(STATIC, short, noise), short, noise, 1.0) == 1.0
    # A break before the last two poses is unknown to the earlier ones.
    late = breaks.BreakCandidate("start", "ballistic_spin", ("v", "w", "c"), low=TAU[-3], high=TAU[-2], gap=COUNT - 2)
    size = late.parameters
    broken = candidates.FittedCandidate(late, np.zeros(size), np.eye(size), np.zeros((COUNT, 6)), np.ones(COUNT))
    assert backtest.relative_error(broken, track, noise, 1.0) == 1.0
