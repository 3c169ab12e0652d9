import numpy as np
import pytest

from r5dgs_core.motion import joint as joints
from r5dgs_core.motion import models, rotations
from r5dgs_core.motion.history import Band
from r5dgs_core.motion_fit import joints as joint_fit
from tests.support import arms

TIMES = np.linspace(0.0, 0.75, 13)


def off_axis(found, axis):
    """Angle between the axes in degrees, and distance of the points across the axis."""
    away = found.joint.point - arms.POINT
    return (
        np.degrees(np.arccos(min(1.0, abs(found.joint.axis @ axis)))),
        np.linalg.norm(away - axis * (axis @ away)),
    )


@pytest.mark.parametrize("kind", joints.KINDS)
def test_exact_joints_are_found_exactly(kind):
    upper, lower, axis = arms.links(kind, TIMES, np.random.default_rng(0))
    found = joint_fit.find(TIMES, upper, lower)
    assert found is not None and found.joint.kind == kind
    assert found.place_error < 1e-9 and found.turn_error < 1e-7
    count = len(TIMES)
    parameters = {"hinge": count + 4, "ball": 3 * count + 3, "slider": count + 2}[kind]
    assert found.cost == pytest.approx((parameters - 6 * count) * np.log(6 * count), rel=1e-3)
    if kind == "ball":
        assert found.joint.axis is None and found.joint.limits is None
        np.testing.assert_allclose(found.joint.point, arms.POINT, atol=1e-9)
    if kind == "hinge":
        assert max(off_axis(found, axis)) < 1e-5
    if kind == "slider":
        assert off_axis(found, axis)[0] < 1e-5
        assert np.ptp(found.joint.limits) == pytest.approx(0.6 * 0.75 - 0.3 * 0.75**2)


@pytest.mark.default_cases("hinge", "slider", "free")
@pytest.mark.parametrize("kind", [*joints.KINDS, "free"])
def test_the_kind_is_found_in_noise(kind):
    for seed in range(4):
        rng = np.random.default_rng(seed)
        upper, lower, axis = arms.links(kind, TIMES, rng, 0.004, 0.014)
        found = joint_fit.find(TIMES, upper, lower)
        assert (found.joint.kind if found else "free") == kind
        if found and kind == "hinge":
            assert off_axis(found, axis)[0] < 5 and off_axis(found, axis)[1] < 0.03


def test_slipped_poses_do_not_hide_a_hinge():
    upper, lower, axis = arms.links("hinge", TIMES, np.random.default_rng(1), 0.002, 0.005)
    lower.displacements[[3, 7]] += [0.2, 0.1, -0.1]
    lower.quats[[3, 7]] = rotations.multiply(rotations.rotvecs_to_quats(np.array([0.5, 0.3, 0])), lower.quats[[3, 7]])
    found = joint_fit.find(TIMES, upper, lower)
    assert found is not None and found.joint.kind == "hinge" and off_axis(found, axis)[0] < 4


def test_bodies_that_hardly_move_relative_to_each_other_have_no_joint():
    upper, _, _ = arms.links("hinge", TIMES, np.random.default_rng(2))
    noisy = joint_fit.Link(
        upper.quats,
        upper.displacements + 1e-4 * np.random.default_rng(3).normal(size=(13, 3)),
        *(upper.pivot, upper.radius),
    )
    assert joint_fit.find(TIMES, upper, noisy, least_noise=(0.001, 0.002)) is None


def test_a_prediction_keeps_the_joint_closed():
    later = np.linspace(0.0, 1.25, 9)
    for kind in joints.KINDS:
        upper, lower, _ = arms.links(kind, TIMES, np.random.default_rng(5), 0.004, 0.014)
        found = joint_fit.find(TIMES, upper, lower).joint
        quats, moves = found.poses(later)
        if kind != "slider":
            assert np.abs(moves).max() == 0
        if kind == "slider":
            assert (quats == rotations.identity(len(later))).all()
            assert np.abs(np.cross(moves, found.axis)).max() < 1e-12
        if kind == "hinge":
            assert np.abs(np.cross(quats[:, 1:], found.axis)).max() < 1e-12


def swinging(angles):
    """A link at rest, and one that turns by given angles about a hinge."""
    upper = joint_fit.Link(rotations.identity(len(angles)), np.zeros((len(angles), 3)), arms.PIVOTS[0], 0.4)
    quats = rotations.rotvecs_to_quats(angles[:, None] * [0.0, 1.0, 0.0])
    still = rotations.identity(len(angles)), np.zeros((len(angles), 3))
    own = quats, np.zeros((len(angles), 3))
    return upper, joint_fit.Link(
        *joints.composed(still, upper.pivot, own, arms.POINT, arms.PIVOTS[1]), arms.PIVOTS[1], 0.4
    )


def test_limits_are_the_observed_range_of_more_than_a_turn():
    angles = 10 * (TIMES - 0.75)
    found = joint_fit.find(TIMES, *swinging(angles)).joint
    assert np.ptp(found.limits) == pytest.approx(7.5) and found.stop_time is None
    assert "degrees" in found.text()


def test_a_joint_stops_at_a_limit_at_which_it_turned_around():
    angles = np.where(TIMES < 0.5, 0.4 - 2 * TIMES, -1.6 + 2 * TIMES)  # hits a stop at t = 0.5 with full rebound
    found = joint_fit.find(TIMES, *swinging(angles - angles[-1]))
    assert found.joint.stop_time is None  # moves away from the stop
    model = models.MotionModel("ballistic_spin", angular_velocity=found.joint.axis * -2.0)
    if found.joint.limits[0] == 0:
        model = model.transformed(-np.eye(3), 1.0)
    back = joints.Joint("hinge", arms.POINT, found.joint.axis, (-0.5, 0.9), model)
    at = joint_fit._stop_time(back, np.array([0.1, -0.5, 0.9, 0.3]), 0.75)
    assert at == pytest.approx(0.57 / 2, abs=0.01)


@pytest.mark.parametrize("kind", ["hinge", "slider"])
@pytest.mark.parametrize(("speed", "passed"), [(-2.0, (0.5 + 0.05 * 1.4) / 2), (3.0, (0.9 + 0.05 * 1.4) / 3)])
def test_a_limit_may_be_passed_by_a_twentieth_of_the_range(kind, speed, passed):
    axis = np.array([0.0, 0.6, 0.8])
    rates = {"angular_velocity": speed * axis} if kind == "hinge" else {"velocity": speed * axis}
    model = models.MotionModel("ballistic_spin", **rates)
    joint = joints.Joint(kind, arms.POINT, axis, (-0.5, 0.9), model)
    step = 3.0 * 0.75 / 2047
    both = np.array([0.1, -0.5, 0.9, 0.0])
    assert joint_fit._stop_time(joint, both, 0.75) == pytest.approx(passed, abs=1.01 * step)
    # The joint left one end at the first time or turned around at the other one only.
    toward = 0.9 if speed > 0 else -0.5
    assert joint_fit._stop_time(joint, np.array([toward, 0.1, -0.2, 0.0]), 0.75) is None
    assert joint_fit._stop_time(joint, np.array([0.1, 0.4 - toward, -0.2, 0.0]), 0.75) is None


@pytest.mark.parametrize("cut", [0, 3])
def test_the_centre_of_rotations_solves_the_weighted_equations(cut):
    rng = np.random.default_rng(6)
    quats = rotations.rotvecs_to_quats(rng.normal(size=(13, 3)))
    weights = np.r_[np.zeros(cut), rng.uniform(0.5, 1.5, 13 - cut)]
    center = np.array([0.3, -0.2, 0.5])
    moves = center - rotations.rotate(quats, center) + 0.01 * rng.normal(size=(13, 3))
    moves[:cut] += 5.0
    arms_of = np.eye(3) - rotations.quats_to_rotmats(quats)
    normal = np.einsum("s,sxi,sxj->ij", weights, arms_of, arms_of)
    expected = np.linalg.solve(normal, np.einsum("s,sxi,sx->i", weights, arms_of, moves))
    np.testing.assert_allclose(joint_fit._pivot(quats, moves, weights), expected, atol=1e-10)
    np.testing.assert_allclose(expected, center, atol=0.02)


def test_the_centre_of_rotations_about_one_axis_is_the_nearest_to_the_reference():
    axis, center = np.array([0.0, 0.0, 1.0]), np.array([0.3, -0.2, 0.5])
    quats = rotations.rotvecs_to_quats(np.linspace(-1, 0, 9)[:, None] * axis)
    moves = center - rotations.rotate(quats, center)
    np.testing.assert_allclose(joint_fit._pivot(quats, moves, np.ones(9)), [0.3, -0.2, 0.0], atol=1e-10)


def test_a_part_is_as_uncertain_as_its_parent_and_its_own_motion():
    times = (0.75, 1.0, 1.5)
    parent = Band(times, (0.01, 0.03, 0.08), (0.0, 0.1, 0.2))
    own = Band(times, (0.0, 0.04, 0.05), (0.02, 0.03, 0.04))
    found = joint_fit.carried(parent, own, 0.5, 0.25)
    np.testing.assert_allclose(found.half_width, np.hypot([0.01, 0.08, 0.18], own.half_width))
    np.testing.assert_allclose(found.half_angle, np.hypot(parent.half_angle, own.half_angle))
    assert 1.0 < found.predictable_until < 1.5
    assert joint_fit.carried(None, own, 0.5, 0.2) is None


def test_the_cheapest_joints_form_a_tree():
    far = np.inf
    costs = np.array([[far, -9, -5, far], [-9, far, -7, far], [-5, -7, far, far], [far, far, far, far]])
    assert joint_fit.parents(costs, 0) == [None, 0, 1, None]
    assert joint_fit.parents(costs, 2) == [1, 2, None, None]
