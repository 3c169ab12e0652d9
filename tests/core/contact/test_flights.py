"""Flights are skipped up to a contact, and no further."""

import numpy as np
import pytest

from r5dgs_core.contact import flights, world
from r5dgs_core.motion import rotations, torque_free_rotation
from tests.support import contacts
from tests.support.contacts import SIZE, G

pytest.importorskip("mujoco", reason="mujoco is not installed; it comes with the extra 'contact'")

RADIUS = contacts.ball([0, 0, 0]).ball_radius or 0.0


def free(place, state):
    """Time of free flight of bodies whose unit is that of the world."""
    return flights.Flights(place, 1.0).time(
        np.concatenate([state.places, state.quats], axis=1).ravel().tolist(),
        np.concatenate([state.velocities, state.spins], axis=1).ravel().tolist(),
    )


def test_a_ball_flies_until_it_touches_the_plane():
    ball = contacts.ball([0, 0, 0.5])
    place = contacts.on_plane(ball)
    state = world.at_rest(place)
    state.velocities[0] = [3.0, 0, 1.0]
    found = free(place, state)
    height = state.places[0, 2] + found - 0.5 * G * found**2
    assert height == pytest.approx(RADIUS, rel=1e-3)


def test_two_bodies_that_fall_together_fly_until_they_meet():
    place = world.World((contacts.ball([0, 0, 0]), contacts.ball([0.5, 0.02, 0])), None, np.array([0, 0, -G]))
    state = world.at_rest(place)
    state.velocities[:] = [[1.5, 0, 2.0], [-0.5, 0, 2.0]]
    found = free(place, state)
    apart = state.places[1] - state.places[0] + found * (state.velocities[1] - state.velocities[0])
    assert np.linalg.norm(apart) == pytest.approx(2 * RADIUS, rel=1e-3)
    state.velocities[:, 0] *= -1
    assert free(place, state) == np.inf


@pytest.mark.parametrize(("gap", "speed", "pull"), [(1.0, 1.0, -1e-17), (1e-16, 10.0, -9.8), (2.0, 3.0, -9.8)])
def test_a_body_that_rises_flies_until_it_has_come_down_again(gap, speed, pull):
    found = flights._fall(gap, speed, pull)
    assert found > speed / -pull  # later than the highest point
    assert abs(gap + speed * found + 0.5 * pull * found**2) < 1e-9 * speed * found


@pytest.mark.parametrize("fixed", [False, True])
def test_a_body_that_touches_or_may_touch_another_does_not_fly(fixed):
    place = contacts.on_plane(contacts.box([0, 0, 1.0]), contacts.box([0.05, 0, 1.0 + SIZE], fixed=fixed))
    assert free(place, world.at_rest(place)) == 0.0
    resting = contacts.on_plane(contacts.box([0, 0, 0.5 * SIZE]))
    assert free(resting, world.at_rest(resting)) == 0.0


def test_a_body_flies_at_most_until_it_reaches_a_fixed_one():
    place = contacts.on_plane(contacts.ball([0, 0, 1.0]), contacts.ball([0.5, 0, 1.0], fixed=True))
    state = world.at_rest(place)
    state.velocities[0] = [2.0, 0, 0]
    reach = 2 * RADIUS
    assert 0.1 < free(place, state.one(0)) < (0.5 - reach) / 2.0


@pytest.mark.parametrize("sides", [(SIZE,) * 3, (SIZE, 0.7 * SIZE, 0.3 * SIZE)])
def test_a_flight_follows_the_parabola_and_the_free_rotation_at_all_times(sides):
    place = contacts.on_plane(contacts.box([0, 0, 2.0], sides))
    runs, state = contacts.simulate(place, draft=True)
    state.velocities[0], state.spins[0] = [1.0, 0.2, 0.5], [2.0, 5.0, 3.0]
    times = np.array([0.0, 0.05, 0.31, 0.5])
    quats, places = runs.poses(state, times)
    expected = state.places[0] + times[:, None] * state.velocities[0] - 0.5 * G * times[:, None] ** 2 * [0, 0, 1]
    np.testing.assert_allclose(places[:, 0], expected, atol=1e-9)
    inertia = place.bodies[0].solid.inertia
    turned, _ = torque_free_rotation.rotations_and_spins(inertia, state.spins[0], times)
    assert np.abs(rotations.angle_between(quats[:, 0], turned)).max() < 2e-3


@pytest.mark.parametrize("e", [0.3, 0.5, 0.7])
def test_a_bounce_that_follows_a_flight_keeps_its_restitution_with_the_long_steps_of_fits(e):
    ball = contacts.ball([0, 0, 0.4], restitution=e)
    runs, state = contacts.simulate(contacts.on_plane(ball), draft=True)
    fall = np.sqrt(2 * (0.4 - RADIUS) / G)
    runs.load(state)
    runs.advance(fall * (1 + 0.9 * e))
    now = runs.state()
    rise = now.places[0, 2] - RADIUS + now.velocities[0, 2] ** 2 / (2 * G)
    assert np.sqrt(rise / (0.4 - RADIUS)) == pytest.approx(e, abs=0.02)
