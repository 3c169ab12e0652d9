import dataclasses
import itertools
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from r5dgs_core.motion import models, rotations, se3
from r5dgs_core.motion.models import MotionModel, evaluation
from r5dgs_core.motion.models.base import RATES, Rates
from tests.support import problems

OFFSETS = {"offset_rotvec": [0.05, -0.02, 0.1], "offset_displacement": [0.02, 0.01, -0.03]}
RNG = np.random.default_rng(5)
WORLD_TWIST = MotionModel(
    "world_twist",
    velocity=[0.5, 0.3, -0.9],
    acceleration=[-0.2, 0.8, 0.5],
    angular_velocity=[1.2, -0.7, 2.6],
    angular_acceleration=[0.9, 1.1, -0.4],
    radius=0.3,
)
CASES = {name: model for name, (model, _) in problems.MOTIONS.items()} | {
    "world twist": WORLD_TWIST,
    "tumbling": problems.TUMBLING,
    "bounces": problems.BOUNCING,
    "contacts": problems.TOSSED,
}


def with_offsets(model):
    return MotionModel.from_dict({**model.to_dict(), **OFFSETS})


@pytest.mark.parametrize("name", CASES)
def test_the_future_starts_at_the_bind_state_to_the_bit(name):
    quats, displacements = models.evaluate(with_offsets(CASES[name]), np.array([0.0, 0.3]))
    assert quats[0].tolist() == [1.0, 0.0, 0.0, 0.0]
    assert displacements[0].tolist() == [0.0, 0.0, 0.0]
    assert (quats[1] != quats[0]).any()


@pytest.mark.parametrize("name", CASES)
def test_the_motion_converges_to_the_fitted_curve(name):
    model = with_offsets(CASES[name])
    tau = 40 * model.fade_time
    quats, displacements = models.evaluate(model, tau)
    curve_quats, curve, _, _ = models.curve(model, tau)
    np.testing.assert_allclose(displacements, curve + model.offset_displacement, atol=1e-12)
    expected = rotations.multiply(curve_quats, rotations.rotvecs_to_quats(model.offset_rotvec))
    assert rotations.angle_between(quats, expected) < 1e-12


@pytest.mark.parametrize("tau", [0.0, 0.013, 1.7])
def test_batches_of_models_equal_single_models(tau):
    group = [m for case in CASES.values() for m in (case, with_offsets(case), with_offsets(models.STATIC))]
    # A kind ignores the rates that are not its own.
    group.append(MotionModel("translation", velocity=[1, 2, 3], angular_velocity=[3, 2, 1], center_offset=[1, 1, 1]))
    group.append(MotionModel("static", velocity=[1, 2, 3], angular_velocity=[3, 2, 1]))
    assert {model.kind for model in group} == set(models.KINDS)
    quats, displacements = models.evaluate_all(group, tau)
    for model, quat, displacement in zip(group, quats, displacements, strict=True):
        expected = models.evaluate(model, tau)
        allowed = 2e-9 if model.kind == "world_twist" else 1e-12  # its steps may be others
        np.testing.assert_allclose(quat, expected[0], atol=allowed)
        np.testing.assert_allclose(displacement, expected[1], atol=allowed)
    assert [len(x) for x in models.evaluate_all([], tau)] == [0, 0]
    with pytest.raises(ValueError, match="tau"):
        models.evaluate_all(group, -0.1)


@pytest.mark.parametrize("kind", models.KINDS)
def test_curves_have_the_shape_of_the_broadcast_rates_and_times(kind):
    group = [model for model in CASES.values() if model.kind == kind]
    tau = np.array([0.1, 0.4, 0.9])
    for model in group:
        for shape, found in zip(((4,), (3,), (3,), (3,)), models.curve(model, tau), strict=True):
            assert found.shape == (*tau.shape, *shape)
    if type(models.KINDS[kind]).motion is not models.MotionKind.motion:
        found = models.KINDS[kind].motion(Rates(*(rate[:, None] for rate in Rates.of(2 * group[:1]))), tau[:, None])
        assert [part.shape for part in found] == [(2, 3, 4), (2, 3, 3), (2, 3, 3), (2, 3, 3)]


@pytest.mark.parametrize("tau", [1.0, 10.0, 30.0])
def test_far_in_the_future_twists_agree_with_keys(tau):
    rates = {"velocity": [1, 0, 0], "acceleration": [0, 1, 0]}
    twist = MotionModel("world_twist", **rates, angular_velocity=[5, 0, 0], angular_acceleration=[0, 5, 0])
    stack = models.MotionStack([twist])
    quat, displacement = models.evaluate(twist, tau)
    quats, displacements = stack.poses(tau)
    assert rotations.angle_between(quats[0], quat) < 1e-8
    np.testing.assert_allclose(displacements[0], displacement, rtol=0, atol=1e-8)


@pytest.mark.parametrize("name", CASES)
def test_rates_are_the_exact_derivative(name):
    model, tau, h = with_offsets(CASES[name]), np.array([0.01, 0.4, 1.7]), 1e-6
    _, _, spins, velocities = models.evaluate_with_rates(model, tau)
    (q0, d0), (q1, d1) = models.evaluate(model, tau - h), models.evaluate(model, tau + h)
    np.testing.assert_allclose((d1 - d0) / (2 * h), velocities, atol=2e-7)
    turn = rotations.quats_to_rotvecs(rotations.multiply(q1, rotations.conjugate(q0)))
    np.testing.assert_allclose(turn / (2 * h), spins, atol=2e-7)


@pytest.mark.parametrize("name", CASES)
def test_distances_are_kept(name):
    points = np.random.default_rng(0).normal(size=(30, 3))
    quats, displacements = models.evaluate(with_offsets(CASES[name]), 2.3)
    moved = rotations.rotate(quats, points) + displacements
    before, after = (np.linalg.norm(x[:, None] - x[None], axis=-1) for x in (points, moved))
    np.testing.assert_allclose(after, before, atol=1e-12)


@pytest.mark.parametrize("scale", [0.5, -2.0])
@pytest.mark.parametrize("name", CASES)
def test_a_model_transforms_with_its_world(name, scale):
    turn = rotations.rotvecs_to_quats(np.array([0.4, -0.9, 0.7]))
    model = with_offsets(CASES[name])
    rates = {f"{name}.{axis}": rate for name in RATES for axis, rate in zip("xyz", getattr(model, name), strict=True)}
    values = np.array([*rates.values(), model.frequency])
    model = replace(model, covariance=np.outer(values, values), covariance_names=(*rates, "frequency"))
    moved = model.transformed(rotations.quats_to_rotmats(turn), scale)
    tau = np.array([0.0, 0.4, 1.7])
    (quats, displacements), (moved_quats, moved_displacements) = (models.evaluate(m, tau) for m in (model, moved))
    expected = rotations.multiply(rotations.multiply(turn, quats), rotations.conjugate(turn))
    assert rotations.angle_between(moved_quats, expected).max() < 1e-8
    np.testing.assert_allclose(moved_displacements, scale * rotations.rotate(turn, displacements), atol=1e-8)
    assert moved.radius == abs(scale) * model.radius
    values = np.concatenate([*(getattr(moved, name) for name in RATES), [moved.frequency]])
    np.testing.assert_allclose(moved.covariance, np.outer(values, values), atol=1e-12)


@pytest.mark.parametrize("name", [name for name in CASES if CASES[name].knots is None])
def test_a_fitted_motion_may_start_from_any_pose(name):
    model, tau = CASES[name], np.array([0.0, 0.3, 0.9])
    rotvec, displacement = np.array([[0.5, -0.2, 0.9]]), np.array([[0.3, 0.1, -0.2]])
    start = rotations.rotvecs_to_quats(rotvec)
    rates = Rates(*(rate[:, None] for rate in Rates.of([model])))
    fitted = models.KINDS[model.kind].fitted(rates, rotvec, displacement, tau, model.inertia)
    if model.inertia is not None:  # it rotates with the body
        turn = rotations.quats_to_rotmats(start)[0]
        model = replace(model, inertia=turn @ model.inertia @ turn.T)
    quats, displacements, _, _ = models.curve(model, tau)
    assert rotations.angle_between(fitted[0][0], rotations.multiply(quats, start)).max() < 2e-6
    np.testing.assert_allclose(fitted[1][0], displacements + displacement, atol=1e-6)


@pytest.mark.parametrize("name", CASES)
def test_nothing_jumps_at_t_max_and_speeds_are_finite(name):
    model = with_offsets(CASES[name])
    quats, displacements, spins, velocities = models.evaluate_with_rates(model, np.array([0.0, 1e-9, 1e-8]))
    assert rotations.angle_between(quats, quats[0]).max() < 1e-6
    assert np.abs(displacements).max() < 1e-6
    assert np.isfinite(spins).all() and np.isfinite(velocities).all()
    assert np.abs(velocities).max() < 100


@pytest.mark.parametrize("name", CASES)
def test_single_precision_keeps_distances_relative_to_the_pivot(name):
    points = RNG.normal(size=(30, 3))
    quats, _ = models.evaluate(with_offsets(CASES[name]), 2.3)
    moved = rotations.rotate(quats, points).astype(np.float32)
    before, after = (np.linalg.norm(x[:, None] - x[None], axis=-1) for x in (points, moved))
    np.testing.assert_allclose(after, before, rtol=1e-6, atol=1e-6)


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("kind", [kind for kind in models.KINDS if kind != "static"])
def test_overflow_is_finite_or_logged(kind, caplog):
    inertia = np.diag([1.0, 2.0, 2.5]) if models.KINDS[kind].needs_inertia else None
    knots = problems.TOSSED.knots if models.KINDS[kind].needs_knots else None
    sane = CASES["hinge"]
    expected = models.evaluate_all([sane, models.STATIC], 0.8)
    rates = ("velocity", "acceleration", "angular_velocity", "angular_acceleration", "precession", "second_velocity")
    for rate, size in itertools.product(rates, (1e30, 1e200, 1e308)):
        evaluation._warn_of_wild_motion.cache_clear()
        caplog.clear()
        given = {"velocity": [0.1, 0, 0], "angular_velocity": [0, 0.1, 0], rate: [0.3 * size, 0.0, 0.8 * size]}
        wild = MotionModel(kind, inertia=inertia, knots=knots, **given)
        quats, displacements = models.evaluate_all([sane, wild], 0.8)
        np.testing.assert_array_equal(quats[0], expected[0][0])
        np.testing.assert_array_equal(displacements[0], expected[1][0])
        for part in (quats, displacements, *models.evaluate_with_rates(wild, np.array([0.0, 0.8]))):
            assert np.isfinite(part).all(), (rate, size)
        if quats[1].tolist() == [1, 0, 0, 0] and not displacements[1].any():
            assert "are not finite" in caplog.text or wild.is_static or not wild.turns, (rate, size)


def test_velocity_and_spin_at_t_max_are_those_of_the_model():
    for kind in ("ballistic_spin", "constant_twist", "world_twist"):
        model = MotionModel(kind, velocity=[1, 2, 3], angular_velocity=[0.1, -0.2, 0.3])
        _, _, spin, velocity = models.evaluate_with_rates(model, 0.0)
        np.testing.assert_allclose(spin, model.angular_velocity)
        np.testing.assert_allclose(velocity, model.velocity)


def test_a_hinge_keeps_its_axis_in_place():
    model = problems.MOTIONS["hinge, accelerating"][0]
    quats, displacements = models.evaluate(model, np.linspace(0, 3, 20))
    axis_point = rotations.rotate(quats, np.broadcast_to(model.center_offset, displacements.shape)) + displacements
    np.testing.assert_allclose(axis_point, np.broadcast_to(model.center_offset, displacements.shape), atol=1e-12)


@pytest.mark.parametrize("name", ["pendulum", "spring"])
def test_a_swing_returns_after_each_period(name):
    model = CASES[name]
    period = 2 * np.pi / model.frequency
    tau = np.linspace(0, period, 9)
    for here, later in zip(models.curve(model, tau), models.curve(model, tau + 3 * period), strict=True):
        np.testing.assert_allclose(later, here, atol=1e-12)
    assert np.abs(models.curve(model, 0.5 * period)[1]).max() > 0.1


def test_a_pendulum_keeps_its_axis_in_place():
    model = CASES["pendulum"]
    quats, displacements = models.evaluate(model, np.linspace(0, 3, 20))
    hook = rotations.rotate(quats, np.broadcast_to(model.center_offset, displacements.shape)) + displacements
    np.testing.assert_allclose(hook, np.broadcast_to(model.center_offset, displacements.shape), atol=1e-12)


def test_the_force_of_a_spring_is_proportional_to_its_displacement():
    model, tau, h = CASES["spring"], np.linspace(0, 2, 11), 1e-4
    rest = model.acceleration / model.frequency**2  # of d, where nothing pulls
    before, here, after = (models.curve(model, tau + shift)[1] for shift in (-h, 0, h))
    np.testing.assert_allclose((after - 2 * here + before) / h**2, -(model.frequency**2) * (here - rest), atol=1e-4)


def test_a_damped_swing_decays_to_its_centre():
    spring = CASES["damped spring"]
    centre = models.KINDS["translation"].center(spring)
    np.testing.assert_allclose(models.curve(spring, 20.0)[1], centre, atol=1e-9)
    pull = spring.frequency**2 + spring.damping**2
    for tau in (0.0, 0.2, 0.7):
        h = 1e-4
        before, here, after = (models.curve(spring, tau + shift)[1] for shift in (-h, 0, h))
        rate, bend = (after - before) / (2 * h), (after - 2 * here + before) / h**2
        np.testing.assert_allclose(bend, -2 * spring.damping * rate - pull * (here - centre), atol=1e-4)


def test_damped_time_factors_approach_undamped_ones_and_each_other_smoothly():
    tau = np.array([[-1.3], [0.0], [0.3], [2.1]])
    for frequency in (1e-3, 1.0, 30.0):
        for damped, plain in zip(
            models.time_factors(frequency, tau, 1e-9), models.time_factors(frequency, tau), strict=True
        ):
            np.testing.assert_allclose(damped, plain, atol=1e-7)
    # Both sides of the size at which a series replaces the closed form.
    series, closed = (models.time_factors(frequency, np.ones(1), 0.4e-3) for frequency in (0.9e-3, 1.0e-3))
    for low, high in zip(series, closed, strict=True):
        np.testing.assert_allclose(low, high, rtol=1e-6)


def test_drag_without_damping_is_free_flight():
    rates = {"velocity": [1, 0, 2], "acceleration": [0, 0.5, -9], "angular_velocity": [0.3, 2, 1]}
    for damping in (0.0, 1e-12, 1e-7):
        slowed = MotionModel("drag", **rates, damping=damping)
        free = MotionModel("ballistic_spin", **rates)
        for x, y in zip(models.evaluate(slowed, 1.3), models.evaluate(free, 1.3), strict=True):
            np.testing.assert_allclose(x, y, atol=1e-5)


def test_a_fall_with_drag_nears_its_terminal_velocity_however_stiff():
    for damping in (2.5, 1e3, 1e6):
        model = MotionModel("drag", velocity=[5, 0, 1], acceleration=[0, 0, -6], damping=damping)
        _, d, spin, velocity = models.evaluate_with_rates(model, np.array([0.0, 30.0, 1e4]))
        np.testing.assert_allclose(velocity[1:], [[0, 0, -6 / damping]] * 2, atol=1e-12)
        assert np.isfinite(d).all() and not spin.any()
        np.testing.assert_allclose(d[2] - d[1], [0, 0, -6 / damping * (1e4 - 30)], rtol=1e-9)


def test_friction_ends_in_rest_and_stays_there():
    model = CASES["rolling friction"]
    quats, d, spins, velocities = models.evaluate_with_rates(model, np.array([0.0, 0.3, 0.6, 0.7, 50.0]))
    np.testing.assert_allclose(velocities[1], 0.5 * model.velocity)
    assert not velocities[2:].any() and not spins[2:].any()
    assert (d[2:] == d[2]).all() and (quats[2:] == quats[2]).all()
    np.testing.assert_allclose(d[2], 0.5 * 0.6 * model.velocity)
    assert models.evaluate(MotionModel("friction", velocity=[1, 0, 0]), 5.0)[1].tolist() == [5, 0, 0]


def test_a_precessing_body_keeps_its_pivot_and_the_tilt_of_its_axis():
    model, tau = CASES["precession"], np.linspace(0, 3, 20)
    quats, d, spins, _ = models.evaluate_with_rates(model, tau)
    pivot = rotations.rotate(quats, np.broadcast_to(model.center_offset, d.shape)) + d
    np.testing.assert_allclose(pivot, np.broadcast_to(model.center_offset, d.shape), atol=1e-12)
    own = spins - model.precession
    np.testing.assert_allclose(own @ model.precession, own[0] @ model.precession, rtol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(own, axis=1), np.linalg.norm(own[0]), rtol=1e-9)


def test_a_ball_bounces_off_its_floor_with_a_share_of_its_speed_until_it_rests():
    ball = CASES["bounces"]
    fall = ball.velocity[2] + ball.acceleration[2] * ball.bounce_time
    floor = ball.velocity[2] * ball.bounce_time + 0.5 * ball.acceleration[2] * ball.bounce_time**2
    tau, speed = ball.bounce_time, -fall
    for _ in range(6):
        h = 1e-7
        _, d, _, v = models.evaluate_with_rates(ball, np.array([tau - h, tau + h]))
        np.testing.assert_allclose(d[:, 2], floor, atol=1e-5)
        np.testing.assert_allclose(v[:, 2], [-speed, ball.restitution * speed], atol=1e-4)
        np.testing.assert_allclose(v[:, :2], [[0.4, 0.3]] * 2)
        speed *= ball.restitution
        tau += 2 * speed / 14
    _, d, _, v = models.evaluate_with_rates(ball, np.array([10.0, 20.0, 1e6]))
    np.testing.assert_allclose(d[:, 2], floor, atol=1e-9)
    assert not v[:, 2].any()
    heights = models.evaluate(ball, np.linspace(0, 5, 500))[1][:, 2]
    assert (heights >= floor - 1e-9).all()


def test_a_trajectory_passes_its_knots_with_the_rates_of_both_sides_and_keeps_the_last_ones():
    knots, h = problems.TOSSED.knots, 1e-9
    for row in knots[1:]:
        before, at, after = (models.curve(problems.TOSSED, row[0] + shift) for shift in (-h, 0.0, h))
        np.testing.assert_allclose(at[1], row[1:4], atol=1e-12)
        assert rotations.angle_between(at[0], row[4:8]) < 1e-7
        np.testing.assert_allclose(np.concatenate([before[3], after[3]]), row[8:14], atol=1e-6)
        np.testing.assert_allclose(np.concatenate([before[2], after[2]]), row[14:20], atol=1e-6)
    last = knots[-1]
    quat, d, _, _ = models.curve(problems.TOSSED, last[0] + 2.0)
    np.testing.assert_allclose(d, last[1:4] + 2 * last[11:14])
    turned = rotations.multiply(rotations.rotvecs_to_quats(2 * last[17:20]), last[4:8])
    assert rotations.angle_between(quat, turned) < 1e-7
    assert models.kinks(problems.TOSSED, 0.7).tolist() == [0.5]


def test_a_ball_that_does_not_bounce_stays_on_the_floor_and_one_that_loses_nothing_bounces_on():
    clay, steel = (dataclasses.replace(CASES["bounces"], restitution=rho) for rho in (0.0, 1.0))
    later = models.evaluate(clay, np.array([0.11, 0.5, 9.0]))[1][:, 2]
    np.testing.assert_allclose(later, later[0], atol=1e-9)
    high = models.evaluate(steel, np.linspace(50, 60, 800))[1][:, 2]
    assert high.max() > later[0] + 0.1 and high.min() > later[0] - 1e-6


def test_the_time_factors_are_steady_without_a_frequency_to_the_bit_and_smooth_towards_it():
    tau = np.array([[-2.0], [0.0], [0.3], [7.1]])
    once, twice = models.time_factors(0.0, tau)
    assert once.tolist() == tau.tolist()
    assert twice.tolist() == (0.5 * tau**2).tolist()
    for frequency in (1e-200, 1e-9, 1e-5):
        for slow, still in zip(models.time_factors(frequency, tau), (once, twice), strict=True):
            np.testing.assert_allclose(slow, still, rtol=1e-9)
    for frequency in (0.01, 0.07, 0.5, 3.0):
        once, twice = models.time_factors(frequency, tau)
        np.testing.assert_allclose(once, np.sin(frequency * tau) / frequency, rtol=1e-12)
        np.testing.assert_allclose(twice, 2 * (np.sin(0.5 * frequency * tau) / frequency) ** 2, rtol=1e-12)


def test_a_model_that_does_not_swing_is_written_as_before():
    assert "frequency" not in MotionModel("translation", velocity=[1, 0, 0]).to_dict()
    assert MotionModel.from_dict(CASES["spring"].to_dict()).frequency == CASES["spring"].frequency


def test_a_screw_is_a_hinge_where_it_does_not_advance():
    tau = np.linspace(0, 3, 7)
    w, u = np.array([0, 0, 2.0]), np.array([0.5, 0.2, 0.0])
    hinge = MotionModel("ballistic_spin", angular_velocity=w, center_offset=u)
    screw = MotionModel("constant_twist", angular_velocity=w, velocity=-np.cross(w, u))
    for x, y in zip(models.evaluate(hinge, tau), models.evaluate(screw, tau), strict=True):
        np.testing.assert_allclose(x, y, atol=1e-12)


def test_world_twist_equals_many_magnus_steps():
    m = WORLD_TWIST
    rates = (m.angular_velocity, m.velocity, m.angular_acceleration, m.acceleration)
    for tau in (0.1, 1.0, 4.0):
        quats, displacements = models.evaluate(m, tau)
        fine_quats, fine = se3.integrate(*rates, tau, 8192)
        assert rotations.angle_between(quats, fine_quats) < 1e-8
        np.testing.assert_allclose(displacements, fine, atol=1e-8)


def test_world_twist_does_not_depend_on_the_other_requested_times():
    together = models.evaluate(WORLD_TWIST, np.array([0.2, 9.0]))
    alone = models.evaluate(WORLD_TWIST, 0.2)
    for x, y in zip(together, alone, strict=True):
        np.testing.assert_array_equal(x[0], y)


def test_batches_of_any_shape_equal_single_times():
    tau = np.array([[0.0, 0.1, 0.2], [0.7, 1.5, 3.0]])
    for model in CASES.values():
        quats, displacements = models.evaluate(model, tau)
        assert quats.shape == (2, 3, 4)
        assert displacements.shape == (2, 3, 3)
        one = models.evaluate(model, 1.5)
        np.testing.assert_allclose(quats[1, 1], one[0], atol=1e-14)
        np.testing.assert_allclose(displacements[1, 1], one[1], atol=1e-13)


@settings(max_examples=50)
@given(
    st.lists(st.floats(-1e6, 1e6), min_size=3, max_size=3), st.floats(1e-6, 1e3), st.sampled_from(tuple(models.KINDS))
)
def test_json_restores_a_model_to_the_bit(vector, number, kind):
    names = ("velocity.x", "velocity.y")
    model = MotionModel(
        kind,
        velocity=vector,
        offset_rotvec=vector,
        fade_time=number,
        inertia=np.diag([number, number / 3, 1e-3]) if models.KINDS[kind].needs_inertia else None,
        knots=problems.TOSSED.knots if models.KINDS[kind].needs_knots else None,
        covariance=np.eye(2) / 3,
        covariance_names=names,
    )
    back = MotionModel.from_dict(json.loads(json.dumps(model.to_dict())))
    assert back == model
    assert back.to_dict() == model.to_dict()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"kind": "teleport"}, "kind"),
        ({"velocity": [1, 2]}, "velocity"),
        ({"velocity": [1, 2, math.nan]}, "velocity"),
        ({"velocity": "fast"}, "velocity"),
        ({"fade_time": 0.0}, "fade_time"),
        ({"radius": -1.0}, "radius"),
        ({"frequency": -1.0}, "frequency"),
        ({"frequency": math.nan}, "frequency"),
        ({"speed": 3}, "speed"),
        ({"kind": "free_top"}, "inertia"),
        ({"inertia": np.eye(3).tolist()}, "inertia"),
        ({"kind": "free_top", "inertia": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]}, "inertia"),
        ({"kind": "free_top", "inertia": [[1, 0.5, 0], [0, 1, 0], [0, 0, 1]]}, "inertia"),
        ({"covariance": [[1.0]]}, "covariance"),
        ({"kind": "trajectory"}, "knots: expected those of a trajectory"),
        ({"knots": problems.TOSSED.knots.tolist()}, "knots: expected None"),
        ({"kind": "trajectory", "knots": [[1.0, 2.0]]}, "knots: expected finite numbers of shape"),
        ({"kind": "trajectory", "knots": "far"}, "knots: expected finite numbers of shape"),
        ({"kind": "trajectory", "knots": problems.TOSSED.knots[::-1].tolist()}, "increasing"),
        ({"kind": "trajectory", "knots": problems.TOSSED.knots[1:].tolist()}, "time 0"),
        ({"kind": "trajectory", "knots": (2 * problems.TOSSED.knots).tolist()}, "unit quaternions"),
    ],
)
def test_malformed_models_are_refused_by_the_name_of_the_key(change, message):
    data = {**MotionModel().to_dict(), **change}
    with pytest.raises(ValueError, match=message):
        MotionModel.from_dict(data)


@pytest.mark.parametrize("data", [{}, {"radius": 1.0}, "static", None])
def test_models_without_a_kind_are_refused(data):
    with pytest.raises(ValueError, match="'kind'"):
        MotionModel.from_dict(data)


def test_times_before_t_max_are_refused():
    with pytest.raises(ValueError, match="tau"):
        models.evaluate(MotionModel(), -0.1)


def test_static_and_turning_models_are_distinguished():
    assert MotionModel().is_static
    assert not MotionModel(offset_displacement=[0, 0, 1e-9]).is_static
    assert not MotionModel("translation", velocity=[1, 0, 0]).turns
    assert MotionModel("ballistic_spin", angular_acceleration=[0, 0, 1]).turns
    assert MotionModel("static", offset_rotvec=[0.1, 0, 0]).turns
    assert MotionModel("ballistic_spin", center_offset=[1, 0, 0]).is_static
    assert MotionModel("ballistic_spin", frequency=3.0).is_static
    assert not MotionModel("ballistic_spin", angular_acceleration=[0, 0, 1], frequency=3.0).is_static
    assert problems.TUMBLING.turns


def test_the_numbers_that_blend_files_store_stay():
    released = (
        *("static", "translation", "ballistic_spin", "constant_twist", "world_twist", "free_top"),
        *("drag", "friction", "precession", "bounce", "two_oscillations"),
    )
    assert [models.MENU_NUMBERS[name] for name in released] == list(range(len(released)))
    numbers = list(models.MENU_NUMBERS.values())
    assert len(set(numbers)) == len(numbers), "two kinds of motion have one number in MENU_NUMBERS"


@pytest.mark.parametrize("kind", models.KINDS)
def test_the_pages_describe_each_kind(kind):
    pages = Path(__file__).parents[3] / "docs"
    assert f"| `{kind}` |" in (pages / "reference/conventions.md").read_text()
    assert f"*{models.KINDS[kind].label}*" in (pages / "user/motion.md").read_text()
    assert f"`{models.KINDS[kind].word}`" in (pages / "user/objects.md").read_text()


def test_the_row_motions_lists_the_kinds_and_rates_that_need_the_feature():
    page = (Path(__file__).parents[3] / "docs/reference/scene_format.md").read_text()
    (row,) = (line for line in page.splitlines() if line.startswith("| `motions` |"))
    basic = {"static", "translation", "ballistic_spin", "constant_twist", "world_twist", "free_top"}
    rates = {*models.FIELDS} - {*models.RATES, "frequency"}
    names = {*models.KINDS} - basic | {name for name in rates if not name.startswith("second_")}
    assert {name for name in names if f"`{name}`" not in row} == set()


@pytest.mark.parametrize("data", [{"kind": "teleport"}, {"kind": "static", "jump": [1, 0, 0]}])
def test_motions_of_later_releases_are_refused_with_a_remedy(data):
    with pytest.raises(ValueError, match=r"(teleport|jump).*update R5DGS"):
        models.MotionModel.from_dict(data)
