"""Simulated contacts against exact answers."""

import builtins
import dataclasses

import numpy as np
import pytest

from r5dgs_core import errors
from r5dgs_core.contact import recording, simulation, stepping, world
from r5dgs_core.shapes import solid
from tests.support import contacts
from tests.support.contacts import SIZE, G

pytest.importorskip("mujoco", reason="mujoco is not installed; it comes with the extra 'contact'")


@pytest.mark.parametrize("e", [0.3, 0.5, 0.9])
def test_a_ball_rises_to_the_share_e_squared_of_the_height_from_which_it_fell(e):
    fall = 0.2
    ball = contacts.ball([0, 0, fall + 0.5 * SIZE], restitution=e)
    place = contacts.on_plane(dataclasses.replace(ball))
    place = dataclasses.replace(place, plane=world.Plane(place.plane.normal, 0.5 * SIZE - ball.ball_radius))
    runs, state = contacts.simulate(place)
    landing = np.sqrt(2 * fall / G)
    times = landing + np.linspace(0.01, 2 * e * landing, 60)
    _, places = runs.poses(state, times)
    assert (places[:, 0, 2] - 0.5 * SIZE).max() == pytest.approx(e**2 * fall, rel=0.06)


@pytest.mark.parametrize("direction", [(1, 0), (1, 1)])
def test_a_box_slides_as_far_in_every_direction_as_its_friction_allows(direction):
    speed, friction = 1.2, 0.35
    runs, state = contacts.simulate(contacts.on_plane(contacts.box([0, 0, 0.02], (0.2, 0.2, 0.04), friction)))
    state.velocities[0, :2] = speed * np.array(direction) / np.linalg.norm(direction)
    _, places = runs.poses(state, np.array([0.6]))
    assert np.linalg.norm(places[-1, 0, :2]) == pytest.approx(speed**2 / (2 * friction * G), rel=0.01)


def test_a_ball_that_slides_goes_on_rolling_at_five_sevenths_of_its_speed():
    runs, state = contacts.simulate(contacts.on_plane(contacts.ball([0, 0, 0.5 * SIZE], 0.4)))
    state.velocities[0, 0] = 1.0
    runs.load(state)
    runs.advance(0.5)
    now = runs.state()
    assert now.velocities[0, 0] == pytest.approx(5 / 7, rel=0.02)
    assert now.spins[0, 1] * runs.world.bodies[0].ball_radius == pytest.approx(now.velocities[0, 0], rel=0.01)


@pytest.mark.parametrize("e", [0.1, 0.5, 0.9])
def test_a_bounce_with_enough_friction_ends_the_slip_of_a_ball(e):
    fall, speed = 0.2, 0.5
    ball = contacts.ball([0, 0, fall + 0.5 * SIZE], friction=0.6, restitution=e)
    runs, state = contacts.simulate(contacts.on_plane(ball, height=0.5 * SIZE - ball.ball_radius))
    state.velocities[0, 0] = speed
    runs.load(state)
    runs.advance(np.sqrt(2 * fall / G) * (1 + 0.6 * e))
    now = runs.state()
    assert now.velocities[0, 2] > 0.0
    assert now.velocities[0, 0] == pytest.approx(5 / 7 * speed, rel=0.03)
    assert now.spins[0, 1] * ball.ball_radius == pytest.approx(now.velocities[0, 0], abs=0.1 * speed)


def test_two_balls_exchange_momentum_and_keep_it():
    heavy = contacts.ball([0.3, 0.02, 0], restitution=0.9, density=3.0)
    light = contacts.ball([0, 0, 0], restitution=0.9)
    runs, state = contacts.simulate(world.World((light, heavy), None, np.zeros(3)))
    state.velocities[0, 0] = 1.0
    runs.load(state)
    runs.advance(0.6)
    after = runs.state().velocities
    np.testing.assert_allclose(after[0] + 3 * after[1], [1, 0, 0], atol=1e-6)
    normal = np.array([0.3, 0.02, 0]) / np.hypot(0.3, 0.02)
    assert after[0, 0] < 0.0 < after[1, 0] and 0.5 < (after[1] - after[0]) @ normal <= 0.95


@pytest.mark.parametrize("e", [0.1, 0.5, 0.9])
def test_a_collision_of_two_balls_with_enough_friction_ends_their_slip(e):
    balls = [contacts.ball([x, 0, 0], friction=0.8, restitution=e) for x in (0, 1.5 * SIZE)]
    runs, state = contacts.simulate(world.World(tuple(balls), None, np.zeros(3)))
    radius = balls[0].ball_radius or 0.0
    state.velocities[0] = [1.0, 0.2, 0.0]
    state.places[0, 1] -= 0.2 * (1.5 * SIZE - 2 * radius)  # they meet along x
    runs.load(state)
    runs.advance(0.2)
    now = runs.state()
    slip = now.velocities[0, 1] - now.velocities[1, 1] + radius * (now.spins[0, 2] + now.spins[1, 2])
    assert now.velocities[1, 0] > 0.5
    assert abs(slip) < 0.1 * 0.2


def test_two_bodies_have_the_friction_of_the_rougher_one_and_the_product_of_their_restitutions():
    balls = contacts.ball([0, 0, 0], 0.2, 0.9), contacts.ball([1.5 * SIZE, 0, 0], 0.7, 0.5)
    runs, state = contacts.simulate(world.World(balls, None, np.zeros(3)))
    assert runs.model.pair_friction[0, 0] == 0.7
    state.velocities[0, 0] = 1.0
    runs.load(state)
    runs.advance(0.5)
    assert runs.state().velocities[:, 0] @ [-1, 1] == pytest.approx(0.45, abs=0.02)


def test_the_ground_and_fixed_bodies_leave_the_material_to_the_other_body():
    table = contacts.box([0, 0, 0], fixed=True, friction=world.NEUTRAL.friction, restitution=world.NEUTRAL.restitution)
    runs = contacts.simulate(contacts.on_plane(table, contacts.ball([1, 1, 1], 0.1, 0.8)))[0]
    table_pair, ground_pair = runs.model.pair_solref
    np.testing.assert_allclose(table_pair, ground_pair)
    np.testing.assert_allclose(runs.model.pair_friction[:, :2], 0.1)


def test_bodies_of_equal_density_have_masses_by_volume():
    small = contacts.ball([0, 0, 0], restitution=0.9)
    large = dataclasses.replace(small, solid=solid.of(2 * small.solid.vertices + [0.3, 0, 0]))
    runs, state = contacts.simulate(world.World((small, large), None, np.zeros(3)))
    state.velocities[0, 0] = 1.0
    runs.load(state)
    runs.advance(0.6)
    after = runs.state().velocities
    assert after[1, 0] > 0.1
    np.testing.assert_allclose(after[0] + 8 * after[1], [1, 0, 0], atol=1e-6)


@pytest.mark.parametrize("scale", [2.0**-40, 2.0**40])
def test_the_unit_of_length_does_not_matter(scale):
    def thrown(unit):
        box = contacts.box([0, 0, 0.2], restitution=0.3)
        box = dataclasses.replace(box, solid=solid.of(unit * box.solid.vertices))
        place = world.World((box,), world.Plane(np.array([0, 0, 1.0]), -0.1 * unit), np.array([0, 0, -G * unit]))
        runs, state = contacts.simulate(place, speed=2.0 * unit)
        state.velocities[0], state.spins[0] = [unit, 0, 0], [1, 2, 3]
        found = recording.record(runs, state, 0.6)
        return found.places / unit, found.quats, len(found.touches)

    (places, quats, touches), (expected, turns, count) = thrown(scale), thrown(1.0)
    assert touches == count > 0
    np.testing.assert_allclose(places, expected, atol=1e-5)
    np.testing.assert_allclose(quats, turns, atol=1e-4)


@pytest.mark.parametrize(
    ("slope", "friction", "height", "slides", "tips"),
    [(10, 0.3, 0.1, False, False), (25, 0.3, 0.1, True, False), (30, 0.9, 0.3, False, True)],
)
def test_a_box_on_a_slope_rests_slides_or_tips(slope, friction, height, slides, tips):
    box = contacts.box([0, 0, 0.5 * height], (0.1, 0.1, height), friction, 0.1)
    runs, state = contacts.simulate(contacts.on_plane(box, slope=np.radians(slope)), speed=0.5)
    quats, places = runs.poses(state, np.array([0.3]))
    assert (places[-1, 0, 0] > 0.03) == (slides or tips)
    assert (2 * np.arccos(min(abs(quats[-1, 0, 0]), 1)) > 0.3) == tips


def test_a_stack_stays_where_it_stands_and_comes_to_rest():
    place = contacts.on_plane(*(contacts.box([0, 0, (0.5 + k) * SIZE], restitution=0.1) for k in range(3)))
    runs, state = contacts.simulate(place, speed=0.3)
    found = recording.record(runs, state, 1.0)
    assert found.rests and found.times[-1] < 1.0
    assert np.linalg.norm(found.places[-1] - state.places, axis=1).max() < 1e-3 * SIZE


def test_bodies_rest_on_their_own_floors_and_still_meet():
    low, high = contacts.box([0, 0, 0.05]), contacts.box([0.3, 0, 0.25], floor=0.2)
    runs, state = contacts.simulate(contacts.on_plane(low, high))
    _, places = runs.poses(state, np.array([0.5]))
    np.testing.assert_allclose(places[-1, :, 2], [0.05, 0.25], atol=1e-3)
    state.velocities[1, 0] = -3.0
    state.places[1, 2] = 0.08
    assert (-1, 1) in runs.deepest(state)
    found = recording.record(*contacts.simulate(contacts.on_plane(low, contacts.box([0.3, 0, 0.06], floor=0.0))), 0.1)
    assert {touch.bodies for touch in found.touches} == {(-1, 0), (-1, 1)}


def test_fixed_bodies_stay():
    place = contacts.on_plane(contacts.box([0, 0, 0.5], fixed=True), contacts.ball([0, 0, 0.7]))
    runs, state = contacts.simulate(place)
    _, places = runs.poses(state, np.array([0.6]))
    np.testing.assert_allclose(places[-1, 0], [0, 0, 0.5], atol=1e-12)
    assert places[-1, 1, 2] == pytest.approx(0.55 + 0.5 * SIZE, abs=3e-3)


def test_a_failed_simulation_gives_no_numbers():
    runs, state = contacts.simulate(contacts.on_plane(contacts.box([0, 0, 0.5])))
    state.velocities[0] = 1e200
    assert np.isnan(runs.poses(state, np.array([0.1]))[1]).all()


def test_a_missing_package_is_one_error_with_the_command(monkeypatch):
    original = builtins.__import__

    def refuse(name, *rest):
        if name == "mujoco":
            raise ImportError("No module named 'mujoco'", name="mujoco")
        return original(name, *rest)

    monkeypatch.setattr(builtins, "__import__", refuse)
    with pytest.raises(errors.BackendError, match=r"contacts: cannot import mujoco; .*pip install 'r5dgs\[contact\]'"):
        simulation.Simulation(contacts.on_plane(contacts.box([0, 0, 1])), stepping.Stepping(100.0, 1e-3))


def test_the_step_shrinks_with_speed_and_never_exceeds_the_number_of_steps():
    slow, fast = (stepping.choose(speed, SIZE, G, 1.0) for speed in (1.0, 3.0))
    assert fast.step == pytest.approx(slow.step / 3) and stepping.choose(1.0, SIZE, G, 1.0, True).step > slow.step
    assert 1e6 / stepping.choose(1e3, SIZE, G, 1e6).step <= stepping.MOST_STEPS * (1 + 1e-9)
    assert stepping.choose(0.0, SIZE, 0.0, 1.0).step > 0
