import numpy as np
import pytest

from r5dgs_core.motion import rotations
from r5dgs_core.motion.pose_track import PoseTrack
from r5dgs_core.motion_fit import candidates, plausibility

ZERO, X, Z = np.zeros(3), np.array([1.0, 0, 0]), np.array([0, 0, 1.0])


def solution(name, **parts):
    law = candidates.BY_NAME[name]
    blocks = {"r": ZERO, "e": ZERO, **parts}
    missing = {block: np.zeros(len(law.rows[block])) for block in law.blocks if block not in blocks}
    theta = law.pack(blocks | missing)
    return candidates.FittedCandidate(law, theta, np.eye(len(theta)), np.zeros((19, 6)), np.ones(19))


def track(v, w):
    tau = np.linspace(-1, 0, 19)
    return PoseTrack(tau, rotations.rotvecs_to_quats(w * tau[:, None]), v * tau[:, None], np.ones(19))


@pytest.mark.parametrize(("v", "w"), [(3 * X, ZERO), (ZERO, 3 * Z), (2 * X, 2.5 * Z)])
def test_a_body_may_move_at_most_two_and_a_half_times_as_far_as_observed(v, w):
    seen = track(v, w)
    for factor, far in ((2.4, False), (2.6, True)):
        law = solution("translation + spin", v=factor * v, w=factor * w)
        assert plausibility.runs_away(law, seen) == far


def test_turns_count_by_the_mean_way_of_points_on_the_sphere():
    # Points on a sphere of radius one that turns by w move by sqrt(2/3) |w| in the root mean square.
    rng = np.random.default_rng(0)
    points = rng.normal(size=(20000, 3))
    points /= np.linalg.norm(points, axis=1)[:, None]
    way = np.sqrt((np.cross(Z, points) ** 2).sum(1).mean())
    seen = track(X, ZERO)
    for factor, far in ((2.4, False), (2.6, True)):
        law = solution("spin", w=factor / way * Z)
        assert plausibility.runs_away(law, seen) == far


def test_the_fastest_part_of_the_track_counts():
    tau = np.linspace(-1, 0, 19)
    d = np.where(tau < -0.5, tau + 0.5, 0)[:, None] * 6 * X  # moves at first, then rests
    seen = PoseTrack(tau, rotations.identity(19), d, np.ones(19))
    assert not plausibility.runs_away(solution("translation", v=12 * X), seen)
    assert plausibility.runs_away(solution("translation", v=18 * X), seen)


@pytest.mark.parametrize(("v", "holds"), [(Z, True), (-Z, True), (X, False), (Z + 0.4 * X, True), (Z + 0.6 * X, False)])
def test_friction_cannot_stop_a_body_that_slides_on_a_vertical_line(v, holds):
    law = solution("slide, friction", v=0.3 * v)
    assert plausibility.rises(law, 5 * Z) == holds
    assert not plausibility.rises(law, None)
    assert not plausibility.rises(solution("translation", v=v), Z)


LEANING = [(-Z, False), (-Z + 0.4 * X, False), (-Z + 0.6 * X, True), (Z, True), (X, True)]


@pytest.mark.parametrize(("a", "leans"), LEANING)
def test_a_body_bounces_off_level_floors_alone_if_the_up_axis_is_known(a, leans):
    law = solution("bounces", a=9 * a, v=-5 * a)
    assert plausibility.leans(law, 2 * Z) == leans == (not plausibility.is_possible(law, 2 * Z))
    assert not plausibility.leans(law, None)
    assert not plausibility.leans(solution("ballistic + spin", a=a), Z)
