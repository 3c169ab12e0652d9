"""Knots reproduce recorded simulations."""

import numpy as np
import pytest

from r5dgs_core.contact import path_knots, recording
from r5dgs_core.motion import knots, models, rotations
from tests.support import contacts
from tests.support.contacts import SIZE

pytest.importorskip("mujoco", reason="mujoco is not installed; it comes with the extra 'contact'")
PIVOT = np.array([0.01, 0, 0.22])


@pytest.fixture(scope="module")
def tossed():
    runs, state = contacts.simulate(contacts.on_plane(contacts.box([0, 0, 0.2], restitution=0.4)))
    state.velocities[0], state.spins[0] = [0.8, 0.2, 0.5], [3, 2, 1]
    return recording.record(runs, state, 1.2), state


def test_the_knots_of_a_toss_reproduce_it_within_the_tolerance(tossed):
    found, state = tossed
    model = path_knots.model(found, 0, state.places[0], PIVOT, SIZE, 0.1)
    assert len(model.knots) < 40
    quats, moved = models.curve(model, found.times)[:2]
    arms = rotations.rotate(found.quats[:, 0], np.broadcast_to(PIVOT - state.places[0], moved.shape))
    missed = np.linalg.norm(moved - (found.places[:, 0] + arms - PIVOT), axis=1)
    turned = 0.5 * SIZE * rotations.angle_between(quats, found.quats[:, 0])
    assert (missed + turned).max() < 1.1 * path_knots.CONTACT_TOLERANCE * SIZE


def test_the_first_impact_is_one_knot_whose_velocity_jumps(tossed):
    found, state = tossed
    model = path_knots.model(found, 0, state.places[0], state.places[0], SIZE, 0.1)
    row = model.knots[np.argmin(np.abs(model.knots[:, 0] - found.touches[0].time))]
    assert row[0] == pytest.approx(found.touches[0].time, abs=2e-3)
    assert row[knots.VELOCITY[0]][2] < -1 and row[knots.VELOCITY[1]][2] > row[knots.VELOCITY[0]][2] + 1


def test_a_body_that_rests_stays_at_its_last_knot(tossed):
    found, state = tossed
    model = path_knots.model(found, 0, state.places[0], PIVOT, SIZE, 0.1)
    assert found.rests
    here, later = (models.evaluate(model, tau)[1] for tau in (model.knots[-1, 0] + 5.0, model.knots[-1, 0] + 50.0))
    np.testing.assert_allclose(here, later, atol=1e-12)


def test_a_start_beside_the_bind_state_is_faded_in(tossed):
    found, state = tossed
    model = path_knots.model(found, 0, state.places[0] + [0.004, 0, 0], PIVOT, SIZE, 0.1)
    assert model.knots[0, 1:4].tolist() == [0, 0, 0]
    assert np.linalg.norm(model.offset_displacement) == pytest.approx(0.004, rel=0.2)
    assert models.evaluate(model, 0.0)[1].tolist() == [0, 0, 0]
