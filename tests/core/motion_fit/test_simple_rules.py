import numpy as np

from r5dgs_core.motion import models, rotations
from r5dgs_core.motion.pose_track import PoseTrack
from r5dgs_core.motion_fit import candidates, model_selection, simple_rules
from tests.support.problems import RADIUS, T_MAX

TIMES = np.linspace(0, T_MAX, 15)
TAU = (TIMES - T_MAX) / T_MAX
NOISE = candidates.Noise(0.02, 0.02)


def track(path):
    return PoseTrack(TAU, rotations.identity(len(path)), path, np.ones(len(path)))


def law(name, poses):
    return candidates.solve(candidates.BY_NAME[name], poses, NOISE)


def test_a_line_predicts_a_path_that_goes_on_and_rest_one_that_goes_back_and_forth():
    rng = np.random.default_rng(0)
    ahead = np.array([3.0, 0.0, 1.0]) * TAU[:, None] + 0.02 * rng.normal(size=(15, 3))
    assert simple_rules.better(track(ahead), NOISE, law("static", track(ahead))).candidate.name == "translation + spin"
    around = np.stack([np.sin(9 * TAU), np.cos(13 * TAU), 0 * TAU], -1)
    chosen = law("ballistic + spin", track(around))
    assert simple_rules.better(track(around), NOISE, chosen).candidate.name == "static"


def test_a_law_that_predicts_later_poses_better_stays():
    rng = np.random.default_rng(0)
    thrown = track(np.array([3.0, 0.0, 5.0]) * TAU[:, None] ** 2 + 0.02 * rng.normal(size=(15, 3)))
    assert simple_rules.better(thrown, NOISE, law("ballistic + spin", thrown)) is None


def test_short_tracks_have_no_rule():
    short = track(np.zeros((15, 3))).rows(slice(-7, None))
    assert simple_rules.better(short, NOISE, law("static", short)) is None


def test_a_motion_that_no_law_predicts_is_not_extrapolated_far():
    rng = np.random.default_rng(3)
    waves = rng.uniform(3, 9, 3)
    drift = np.array([0.3, 0, 0]) * rng.normal(size=(15, 1))
    path = 0.5 * np.sin(waves * TIMES[:, None] + rng.uniform(0, 6, 3)) + drift
    fit = model_selection.fit(TIMES, rotations.identity(15), path - path[-1], radius=RADIUS)
    assert fit.history.band.predictable_until is not None
    _, d = models.evaluate(fit.model, np.array([1.0 - T_MAX]))
    assert np.linalg.norm(d) < 2
