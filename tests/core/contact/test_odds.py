"""Probabilities from sampled futures."""

import pytest

from r5dgs_core.contact import odds, scene_world
from tests.support import contact_scenes

pytest.importorskip("mujoco", reason="mujoco is not installed; it comes with the extra 'contact'")


def test_a_body_that_slides_into_another_touches_it_first_in_every_future():
    scene = contact_scenes.with_units(contact_scenes.scene(contact_scenes.sliding(1.5), contact_scenes.resting(0.7)))
    first, second = odds.of(scene, 4)
    assert (first.name, first.hits) == ("box 1", {"box 2": 1.0})
    assert (second.name, second.hits) == ("box 2", {"box 1": 1.0})
    assert first.rests == first.leaves == 0.0  # it slid without friction
    assert first.turns_over == second.turns_over == 0.0


@pytest.mark.slow
@pytest.mark.filterwarnings("error:overflow:RuntimeWarning")
def test_futures_whose_simulation_failed_are_left_out(monkeypatch):
    scene = contact_scenes.with_units(contact_scenes.scene(contact_scenes.sliding(1.5), contact_scenes.resting(0.7)))
    sound = scene_world.SceneWorld.draws

    def broken(made, t_max, materials, wishes):
        for number, (state, used) in enumerate(sound(made, t_max, materials, wishes)):
            state.velocities[0] *= 1e200 if number == 0 and wishes.samples == 3 else 1.0
            yield state, used

    monkeypatch.setattr(scene_world.SceneWorld, "draws", broken)
    assert odds.of(scene, 3)[0].hits == {"box 2": 1.0}


def test_a_scene_without_need_of_contacts_has_no_odds():
    assert odds.of(contact_scenes.scene(contact_scenes.resting()), 4) == []
