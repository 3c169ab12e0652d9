"""The ground of a body is found from its poses, also if none of them touches it."""

import numpy as np
import pytest

from r5dgs_core.contact import floors, identify, observed_track, simulation, stepping, world
from r5dgs_core.motion import rotations
from tests.support import contacts
from tests.support.contacts import SIZE, G

UP = np.array([0.0, 0.0, 1.0])
GRAVITY = -G * UP


def track(heights, times, noise=1e-3):
    places = np.stack([0.3 * times, 0 * times, heights], axis=1)
    ones = np.full(len(times), noise * SIZE)
    return observed_track.Track(times, rotations.identity(len(times)), places, ones, np.full(len(times), noise))


def bounce(times, e=0.6, fall=0.3):
    """Height of a ball's lowest point, dropped from a height, up to its second impact."""
    hit = np.sqrt(2 * fall / G)
    since = np.maximum(times - hit, 0)
    return np.where(times < hit, fall - 0.5 * G * times**2, e * G * hit * since - 0.5 * G * since**2)


@pytest.mark.parametrize("ground", [-0.1, 0.0, 0.1])
def test_the_ground_of_a_ball_that_no_picture_shows_touching_it_is_where_both_flights_meet(ground):
    times = np.arange(0.0, 0.45, 0.04)
    gaps = bounce(times)
    assert gaps.min() > 0.15 * SIZE
    seen = track(gaps + 0.5 * SIZE + ground * SIZE, times)
    ball = contacts.ball([0, 0, 0])
    height = floors.of(ball, world.Plane(UP, 0.0), seen, GRAVITY) + ball.ball_radius - 0.5 * SIZE
    assert height == pytest.approx(ground * SIZE, abs=0.01 * SIZE)


def test_a_body_that_rests_is_as_high_as_its_ground_and_one_in_flight_tells_nothing():
    times, box = np.arange(0.0, 0.2, 0.04), contacts.box([0, 0, 0])
    plane = world.Plane(UP, 0.0)
    assert floors.of(box, plane, track(np.full(5, 0.53 * SIZE), times), GRAVITY) == pytest.approx(0.03 * SIZE)
    assert floors.of(box, plane, track(1 - 0.5 * G * times**2, times), GRAVITY) is None
    above = track(bounce(times, fall=0.05) + 2 * SIZE, times)  # it bounces off something else
    assert floors.of(box, plane, above, GRAVITY) is None


def test_the_ground_of_a_body_that_stays_on_it_is_that_of_its_last_poses_although_its_heights_drift():
    times, ball = np.linspace(0, 0.6, 19), contacts.ball([0, 0, 0])
    drift = SIZE * (0.1 * np.minimum(times / 0.3, 1.0) + 0.002 * np.sin(40 * times))
    drift[-2:] += 0.005 * SIZE  # a kink like that of an impact
    seen = track(ball.ball_radius + drift, times, 1e-4)
    found = floors.of(ball, world.Plane(UP, 0.05 * SIZE), seen, GRAVITY)
    assert found == pytest.approx(float(np.median(drift[-6:])), abs=1e-9)


@pytest.mark.parametrize("noise", [1e-3, 1e-4], ids=["noisy", "exact"])
def test_friction_and_restitution_are_fitted_if_no_pose_is_close_to_the_ground(noise):
    pytest.importorskip("mujoco", reason="mujoco is not installed; it comes with the extra 'contact'")
    times = np.arange(0.0, 0.45, 0.04)
    place = contacts.on_plane(contacts.ball([0, 0, 0]))
    radius = place.bodies[0].ball_radius
    fitter = identify.Fitter(
        simulation.Simulation(place, stepping.choose(2.5, SIZE, G, 0.5, draft=True)),
        track(bounce(times) + radius, times, noise),
    )
    found = fitter.run()
    assert found.material.restitution == pytest.approx(0.6, abs=0.04)
    assert found.misfit < 4
