"""Probabilities from sampled futures."""

import dataclasses

import numpy as np
import pytest

from r5dgs_core.cli.commands import objects
from r5dgs_core.contact import odds, scene_future, scene_world
from r5dgs_core.motion import rotations
from r5dgs_core.shapes import directions
from tests.support import contact_scenes

pytest.importorskip("mujoco", reason="mujoco is not installed; it comes with the extra 'contact'")


def test_a_body_that_slides_into_another_touches_it_first_in_every_future():
    scene = contact_scenes.with_units(contact_scenes.scene(contact_scenes.sliding(1.5), contact_scenes.resting(0.7)))
    first, second = odds.of(scene, 4)
    assert (first.name, first.hits) == ("box 1", {"box 2": 1.0})
    assert (second.name, second.hits) == ("box 2", {"box 1": 1.0})
    assert first.rests == first.leaves == 0.0  # it slid without friction
    assert first.turns_over == second.turns_over == 0.0


def test_a_body_that_ends_on_another_face_turns_over_and_a_ball_has_no_faces():
    box, up = contact_scenes.scene(contact_scenes.falling()), np.array([0.0, 0.0, 1.0])
    outline = box.groups[1].pivot + 0.5 * contact_scenes.SIZE * directions.sphere(64)
    ball = dataclasses.replace(box, hulls=(dataclasses.replace(box.hulls[0], vertices=outline),))
    shares = []
    for made in (box, ball):
        found = scene_future.predict(contact_scenes.with_units(made))
        last = found.recording.quats[-1, 0]
        for turn in ([0.0, 0.0, 1.5], [1.5, 0.0, 0.0]):
            shown = rotations.multiply(rotations.rotvecs_to_quats(np.array(turn)), last)
            shares.append(odds._odds(found.world, 0, [found.recording], shown, up).turns_over)
    assert shares == [0.0, 1.0, None, None]


def test_the_share_of_futures_that_turn_over_is_printed_for_bodies_with_faces():
    found = odds.Odds("box", rests=1.0, leaves=0.0, hits={"mug": 0.5}, turns_over=0.25)
    assert objects.odds_text(dataclasses.asdict(found)) == (
        "box: comes to rest 100%, is off the ground at the end 0%, ends on another side than shown 25%, "
        "touches mug first 50%"
    )
    assert "side" not in objects.odds_text(dataclasses.asdict(dataclasses.replace(found, turns_over=None)))


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
