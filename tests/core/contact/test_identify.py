"""Material and state of simulated tosses are found from noisy poses."""

import dataclasses

import numpy as np
import pytest

from r5dgs_core.contact import futures, identify, observed_track, world
from r5dgs_core.motion import rotations
from r5dgs_core.motion.history import UNKNOWN_TURN
from tests.support import contacts
from tests.support.contacts import SIZE

pytest.importorskip("mujoco", reason="mujoco is not installed; it comes with the extra 'contact'")
FRICTION = 0.25


def observed(until, seed=0, noise=0.005, height=0.09):
    """Fitter of a box that is thrown onto a plane, poses up to a time, and the true places of later times."""
    rng, times = np.random.default_rng(seed), np.arange(0, 0.6, 1 / 30)
    runs, state = contacts.simulate(contacts.on_plane(contacts.box([0, 0, height], friction=FRICTION)), draft=True)
    state.velocities[0], state.spins[0] = [1.5, 0.3, 0.2], [0.5, 1.0, 2.0]
    quats, places = runs.poses(state, times)
    seen = int((times <= until).sum())
    turns = rotations.rotvecs_to_quats(rng.normal(0, noise, (seen, 3)))
    track = observed_track.Track(
        times[:seen],
        rotations.multiply(turns, quats[:seen, 0]),
        places[:seen, 0] + rng.normal(0, noise * SIZE, (seen, 3)),
        np.full(seen, noise * SIZE),
        np.full(seen, noise),
    )
    return identify.Fitter(runs, track), times, places[:, 0]


@pytest.fixture(scope="module")
def slid():
    fitter, times, places = observed(0.4)
    return fitter, fitter.run(), times, places


def test_the_friction_of_a_slide_and_its_end_are_found(slid):
    fitter, estimate, times, places = slid
    assert estimate.material.friction == pytest.approx(FRICTION, rel=0.15)
    end = fitter.poses(estimate.state, estimate.material, times[-1:] - estimate.time)[1][0]
    still = np.linalg.norm(fitter.track.places[-1] - places[-1])
    assert np.linalg.norm(end - places[-1]) < 0.15 * SIZE < still


def test_the_samples_of_a_fit_hold_the_true_end(slid):
    fitter, estimate, times, places = slid
    found = futures.sample(fitter, estimate, times[-1:], 24, np.random.default_rng(1))
    center = np.median(found.places, axis=1)
    assert np.linalg.norm(center[0] - places[-1]) < 2 * found.radii(center, 0.95)[0] < SIZE
    shown = fitter.poses(estimate.state, estimate.material, times[-1:] - estimate.time)[0][0]
    assert found.other_faces(shown, np.array([0.0, 0.0, 1.0])) == 0.0
    assert found.angles(found.quats[:, 0], 0.9)[0] < 1.0


def test_samples_agree_with_the_last_poses_even_if_a_direction_seems_undetermined(slid):
    fitter, estimate, _, _ = slid
    covariance = estimate.covariance.copy()
    covariance[8, 8] += 9.0  # of the vertical velocity, as of a body whose fit moves it into the floor
    wide = dataclasses.replace(estimate, covariance=covariance)
    found = futures.sample(fitter, wide, fitter.track.times[-1:], 24, np.random.default_rng(3))
    away = np.linalg.norm(found.places[0] - fitter.track.places[-1], axis=-1)
    assert away.max() < 10 * fitter.track.place_noise[-1]


def test_a_flight_tells_nothing_about_the_material():
    fitter, times, places = observed(0.11, height=0.22)
    estimate = fitter.run()
    assert len(fitter.track) >= 3
    np.testing.assert_allclose(np.sqrt(np.diag(estimate.covariance))[12:], [0.35, 0.85], rtol=0.2)
    rng = np.random.default_rng(2)
    drawn = [np.log(material.friction) for _, material in futures.draws(fitter, estimate, 400, rng)]
    assert np.std(drawn) == pytest.approx(0.35, rel=0.15)  # a prior is not widened
    first, again = (
        futures.sample(fitter, estimate, times[[3, -1]], 24, np.random.default_rng(1)).radii(places[[3, -1]], 0.9)
        for _ in range(2)
    )
    assert first.tolist() == again.tolist() and first[1] > 2 * first[0]


def test_a_simulation_that_fails_beside_the_best_state_leaves_its_uncertainty_known(monkeypatch):
    fitter, _, _ = observed(0.11, height=0.22, noise=1e-4)
    expected = fitter.run()
    slopes, calls = fitter._slopes, []

    def failing(*arguments):
        calls.append(None)
        found = slopes(*arguments)
        return np.full_like(found, np.nan) if len(calls) == 2 else found

    monkeypatch.setattr(fitter, "_slopes", failing)
    found = fitter.run()
    assert len(calls) > 2
    np.testing.assert_allclose(np.diag(found.covariance), np.diag(expected.covariance), rtol=0.5)


@pytest.mark.parametrize("slipped", [slice(0, 1), slice(2, 4)], ids=["first", "last"])
def test_unknown_rotations_do_not_enter_a_fit(slipped):
    fitter, _, places = observed(0.11, height=0.22, noise=1e-4)
    quats, noise = fitter.observed.quats.copy(), fitter.observed.turn_noise.copy()
    quats[slipped] = rotations.multiply(quats[slipped], rotations.rotvecs_to_quats(np.array([0.3, -0.4, 0.2])))
    noise[slipped] = UNKNOWN_TURN
    track = dataclasses.replace(fitter.observed, quats=quats, turn_noise=noise)
    found, expected = identify.Fitter(fitter.simulation, track).run(), fitter.run()
    assert rotations.angle_between(found.state.quats, expected.state.quats)[0] < 0.01
    np.testing.assert_allclose(found.state.spins, expected.state.spins, atol=0.1)


def test_the_state_between_two_steps_is_that_of_the_poses_there():
    fitter, _, _ = observed(0.11, height=0.22)
    start = fitter.ballistic(fitter.track)
    known = np.eye(identify.PARAMETERS), np.zeros(identify.PARAMETERS)
    estimate = identify.Estimate(start, 0.0, world.Material(0.3, 0.3), *known, 0.0, 0.0, np.zeros(3), 1.0)
    late = 20.9 * fitter.simulation.stepping.step
    quats, places = fitter.poses(start, estimate.material, np.array([late]))
    found = fitter.at(estimate, late)
    np.testing.assert_allclose(found.places, places, atol=1e-12)
    np.testing.assert_allclose(found.quats, quats, atol=1e-12)


def test_poses_after_the_first_contact_have_the_error_of_the_simulation_too(slid):
    fitter, _, _, _ = slid
    assert 0 < fitter.flight < len(fitter.track)
    before, after = slice(0, fitter.flight), slice(fitter.flight, None)
    np.testing.assert_array_equal(fitter.track.place_noise[before], fitter.observed.place_noise[before])
    assert (fitter.track.place_noise[after] > fitter.observed.place_noise[after]).all()
    assert (fitter.track.turn_noise[after] > fitter.observed.turn_noise[after]).all()


def test_residuals_that_repeat_tell_less_than_independent_ones(slid):
    fitter, _, _, _ = slid
    rng, shape = np.random.default_rng(0), (2, len(fitter.track), 3)
    independent = fitter._told(fitter.track, rng.normal(0, 0.5, shape))
    repeated = fitter._told(fitter.track, np.tile(rng.normal(0, 0.5, (2, 1, 3)), (1, shape[1], 1)))
    assert repeated < 0.2 < 0.4 < independent <= 1.0
    assert fitter._told(fitter.track, rng.normal(0, 3.0, shape)) < 0.5 * independent


def test_the_pose_before_an_impact_that_a_simulation_misses_is_left_out_of_the_last_ones(slid):
    fitter, estimate, _, _ = slid
    squares = np.full(len(fitter.track), 0.5)
    followed, missed = fitter._last(dataclasses.replace(estimate, squares=squares))
    assert len(followed) == identify.LAST and not missed
    squares[-identify.LAST + 1 :] = 40.0
    left, missed = fitter._last(dataclasses.replace(estimate, squares=squares))
    assert left.times.tolist() == followed.times[1:].tolist() and missed


def test_pieces_of_a_track_tell_the_friction_of_a_slide(slid):
    fitter, _, _, _ = slid
    found = fitter._by_pieces(identify.WIDE)
    assert found is not None
    material, covariance = found
    assert material.friction == pytest.approx(FRICTION, rel=0.25)
    assert np.sqrt(covariance[0, 0]) < 0.5 * identify.WIDE.friction
