"""The centre of a motion stays in place, also after it was moved."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from r5dgs_core.motion import models, rotation_centers, rotations
from r5dgs_core.motion.models import MotionModel

TAU = np.linspace(0.0, 1.5, 7)
POINTS = np.random.default_rng(5).normal(size=(5, 3))
W, EPS, POINT = np.array([0.4, -1.0, 2.0]), np.array([0.3, 0.2, -0.5]), np.array([0.7, -0.2, 0.4])

numbers = st.floats(-3, 3).map(lambda x: round(x, 3))
vectors = st.tuples(numbers, numbers, numbers).map(np.array)
directions = vectors.filter(lambda v: np.linalg.norm(v) > 0.1)


def places(model, points, taus=TAU):
    """Positions of points of the body, given relative to the pivot. [H, n, 3]"""
    quats, displacements = models.evaluate(model, taus)
    body = np.broadcast_to(points, (len(taus), len(points), 3))
    return rotations.rotate(quats[:, None], body) + displacements[:, None]


def spins(**more):
    """Pure rotations about a point beside the pivot."""
    rates = {"angular_velocity": W, "angular_acceleration": EPS}
    arms = {"velocity": -np.cross(W, POINT), "acceleration": -np.cross(EPS, POINT)}
    return {
        "hinge": MotionModel("ballistic_spin", center_offset=POINT, **rates),
        "pendulum": MotionModel("ballistic_spin", center_offset=POINT, angular_velocity=W, frequency=5.0),
        "started from rest": MotionModel("ballistic_spin", center_offset=POINT, angular_acceleration=EPS),
        "turn": MotionModel("constant_twist", angular_velocity=W, velocity=arms["velocity"]),
        "orbit": MotionModel("world_twist", **rates, **arms),
    }


@pytest.mark.parametrize("name", spins())
@given(point=vectors)
def test_the_point_that_a_motion_is_moved_to_stays(name, point):
    moved = rotation_centers.with_center(spins()[name], point, old=POINT)
    np.testing.assert_allclose(places(moved, point[None])[:, 0], np.broadcast_to(point, (len(TAU), 3)), atol=1e-7)
    assert np.ptp(places(moved, point + POINTS), axis=0).max() > 0.05


@pytest.mark.parametrize("name", spins())
@given(point=vectors)
def test_every_other_point_moves_as_it_did_about_the_old_one(name, point):
    model = spins()[name]
    moved = rotation_centers.with_center(model, point, old=POINT)
    about = places(moved, point + POINTS) - point
    np.testing.assert_allclose(about, places(model, POINT + POINTS) - POINT, atol=1e-7)


@pytest.mark.parametrize("name", ["hinge", "pendulum", "started from rest", "turn"])
@given(direction=directions)
def test_points_on_the_new_axis_stay_fixed_and_the_speed_is_kept(name, direction):
    model = spins()[name]
    if name == "hinge":  # one that turns about one axis throughout
        model = dataclasses.replace(model, angular_acceleration=0.3 * W)
    at = rotation_centers.center(model)
    turned = rotation_centers.with_axis(model, direction)
    np.testing.assert_allclose(rotation_centers.axis(turned), direction / np.linalg.norm(direction), atol=1e-12)
    line = at + np.array([[-1.0], [0.0], [2.0]]) * rotation_centers.axis(turned)
    np.testing.assert_allclose(places(turned, line), np.broadcast_to(line, (len(TAU), 3, 3)), atol=1e-9)
    for new, old in ((turned.angular_velocity, model.angular_velocity),
                     (turned.angular_acceleration, model.angular_acceleration)):  # fmt: skip
        assert np.linalg.norm(new) == pytest.approx(np.linalg.norm(old))


@given(direction=directions, point=vectors)
def test_a_screw_keeps_its_rise_and_an_orbit_its_drift(direction, point):
    for kind in ("constant_twist", "world_twist"):
        screw = MotionModel(kind, angular_velocity=[0, 0, 2.0], velocity=[0.4, 0.1, 0.3])
        turned = rotation_centers.with_axis(rotation_centers.with_center(screw, point), direction, through=point)
        along = rotation_centers.axis(turned)
        np.testing.assert_allclose(turned.velocity @ along, 0.3, atol=1e-9)
        moved = places(turned, point[None])[:, 0] - point
        np.testing.assert_allclose(moved, 0.3 * TAU[:, None] * along, atol=1e-6)


@given(point=vectors)
def test_a_spring_swings_about_its_rest(point):
    spring = MotionModel("translation", velocity=[0.3, 0, -1.0], acceleration=[1.0, 2.0, 3.0], frequency=4.0)
    moved = rotation_centers.with_center(spring, point)
    here, there = places(moved, np.zeros((1, 3))), places(moved, np.zeros((1, 3)), TAU + np.pi / 4.0)
    np.testing.assert_allclose(0.5 * (here + there)[:, 0], np.broadcast_to(point, (len(TAU), 3)), atol=1e-9)
    np.testing.assert_allclose(rotation_centers.center(moved), point, atol=1e-12)


@pytest.mark.parametrize("name", spins())
def test_the_center_is_on_the_axis_and_of_a_twist_the_nearest_to_the_pivot(name):
    model = spins()[name]
    center, axis = rotation_centers.center(model), rotation_centers.axis(model)
    np.testing.assert_allclose(np.cross(center - POINT, axis), 0, atol=1e-12)
    np.testing.assert_allclose(center @ axis if name in ("turn", "orbit") else center - POINT, 0, atol=1e-12)


@pytest.mark.parametrize("name", spins())
def test_moving_to_the_current_place_changes_nothing(name):
    model = spins()[name]
    for same in (
        rotation_centers.with_center(model, rotation_centers.center(model)),
        rotation_centers.with_axis(model, rotation_centers.axis(model)),
    ):
        for field in ("velocity", "acceleration", "angular_velocity", "angular_acceleration", "center_offset"):
            np.testing.assert_allclose(getattr(same, field), getattr(model, field), atol=1e-12)


def test_an_axis_can_be_reversed():
    for along in (*np.eye(3), W):
        model = MotionModel("constant_twist", angular_velocity=along)
        np.testing.assert_allclose(rotation_centers.with_axis(model, -along).angular_velocity, -along, atol=1e-12)


def test_the_axis_of_a_spin_from_rest_can_be_changed():
    model = MotionModel("world_twist", velocity=[0.4, 0.1, 0.3], angular_acceleration=[0, 0, 2.0])
    turned = rotation_centers.with_axis(model, np.array([1.0, 0, 0]))
    np.testing.assert_allclose(turned.angular_acceleration, [2.0, 0, 0], atol=1e-12)
    np.testing.assert_allclose(turned.velocity, [0.3, 0.1, -0.4], atol=1e-12)


def test_motions_without_center_or_axis_raise():
    without = (
        MotionModel("static"),
        MotionModel("translation", velocity=W, acceleration=EPS),
        MotionModel("constant_twist", velocity=W),
        MotionModel("world_twist", velocity=W),
        MotionModel("free_top", angular_velocity=W, inertia=np.eye(3)),
    )
    for model in without:
        assert rotation_centers.center(model) is None
        with pytest.raises(ValueError, match=model.kind):
            rotation_centers.with_center(model, POINT)
        if model.kind != "free_top":
            assert rotation_centers.axis(model) is None
            with pytest.raises(ValueError, match=model.kind):
                rotation_centers.with_axis(model, POINT)
    with pytest.raises(ValueError, match="direction"):
        rotation_centers.with_axis(spins()["turn"], np.zeros(3))
