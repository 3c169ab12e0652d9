"""Contacts that no smooth law explains are believed if they predict held-out poses better, and only then."""

import dataclasses

import numpy as np
import pytest

from r5dgs_core.bake import contact
from r5dgs_core.contact import held_out, scene_bodies, scene_future, scene_world, world
from r5dgs_core.contact.scene_world import Wishes
from r5dgs_core.motion import models, rotations
from r5dgs_core.motion_fit import model_selection
from tests.support import contact_scenes, contacts
from tests.support.contact_scenes import SIZE, TIMES, G

pytest.importorskip("mujoco", reason="mujoco is not installed; it comes with the extra 'contact'")
UP = np.array([0.0, 0.0, 1.0])
LATER = 1.4


def observed(quats, places):
    """Scene of a box seen in poses at `TIMES`, which moves on by the law that is fitted to them. [S, 4], [S, 3]"""
    turns, moved = rotations.multiply(quats, rotations.conjugate(quats[-1])), places - places[-1]
    least = 0.003 * SIZE, 0.004
    fit = model_selection.fit(TIMES, turns, moved, radius=SIZE / 2, up=UP, least_noise=least)
    scene = contact_scenes.with_units(contact_scenes.scene((fit.model, places[-1])))
    corners = contacts.box(np.zeros(3), (SIZE,) * 3).solid.vertices
    hull = dataclasses.replace(scene.hulls[0], vertices=rotations.rotate(quats[-1][None], corners) + places[-1])
    poses = scene.tracks.poses.copy()
    poses[1] = np.concatenate([rotations.make_continuous(turns), moved], axis=1)
    groups = (scene.groups[0], dataclasses.replace(scene.groups[1], history=fit.history))
    tracks = dataclasses.replace(scene.tracks, poses=poses)
    return dataclasses.replace(scene, hulls=(hull,), groups=groups, tracks=tracks)


@pytest.fixture(scope="module")
def tumbling():
    """Scene of a box that tumbles over the floor in the observed time, and its true place later."""
    box = contacts.box(np.array([0, 0.2, 0.3]), (SIZE,) * 3, restitution=0.2)
    runs, state = contacts.simulate(world.World((box,), world.Plane(UP, 0.0), -G * UP), speed=3.0)
    state.velocities[0], state.spins[0] = [1.2, 0.3, -1.0], [1.0, 7.0, 2.0]
    quats, places = runs.poses(state, np.append(TIMES, LATER))
    return observed(quats[:-1, 0], places[:-1, 0]), places[-1, 0]


def dragged():
    """Scene of a box that a hand moves to and fro over the floor."""
    steps = np.array([0, 1, 2, -1, -2, 1, 3, 1, -2, -1, 2, 3, -3])
    places = np.stack([0.05 * np.cumsum(steps), 0.03 * np.cumsum(steps[::-1]), np.zeros(13)], axis=1)
    return observed(rotations.identity(13), places + [0, 0.2, SIZE / 2])


@pytest.mark.slow
def test_a_tumbling_box_whose_law_is_that_of_a_driven_body_gets_contacts(tumbling):
    scene, place = tumbling
    assert scene_bodies.of(scene)[0][0].reason.startswith("its motion is that of a driven body")
    found = scene_future.predict(scene, Wishes(samples=1))
    compared = found.compared["box 1"]
    assert compared.better and compared.contact < compared.smooth - 1
    end = scene.groups[1].pivot + models.evaluate(found.groups[1].model, LATER - TIMES[-1])[1]
    smooth = scene.groups[1].pivot + models.evaluate(scene.groups[1].model, LATER - TIMES[-1])[1]
    assert np.linalg.norm(end - place) < 0.4 * SIZE < SIZE < np.linalg.norm(smooth - place)
    (row,) = contact.needs((), found)
    assert row["value"] == pytest.approx(compared.smooth - compared.contact) and row["threshold"] == held_out.BETTER
    assert "no smooth law explains its last motion; held-out poses are predicted with errors of" in row["reason"]


def test_a_box_that_a_hand_drags_over_the_floor_keeps_its_motion():
    scene = dragged()
    (body,), _ = scene_bodies.of(scene)
    assert held_out.is_unexplained(scene, body) and held_out.in_contact(scene, body, world.Plane(UP, 0.0))
    found = scene_future.predict(scene, Wishes(samples=1))
    assert found.groups is scene.groups and not found.taken
    assert any(line.startswith("box 1: keeps its smooth motion: contacts ") for line in found.lines)


def test_contacts_that_are_not_better_by_more_than_the_noise_are_refused(tumbling, monkeypatch):
    scene, _ = tumbling
    monkeypatch.setattr(held_out, "compare", lambda fitter, up: held_out.Comparison(2.9, 2.0))
    found = scene_future.predict(scene, Wishes(samples=1))
    assert not found.taken and not held_out.Comparison(2.9, 2.0).better and held_out.Comparison(3.1, 2.0).better
    assert "box 1: keeps its smooth motion: contacts are not clearly better: held-out" in " ".join(found.lines)


def test_explained_or_flying_bodies_are_not_in_doubt(tumbling, monkeypatch):
    scene, _ = tumbling
    (body,), _ = scene_bodies.of(scene)
    assert not held_out.in_contact(scene, body, world.Plane(UP, -SIZE)) and not held_out.in_contact(scene, body, None)
    monkeypatch.setattr(scene_world, "plane", None)
    smooth = contact_scenes.scene(contact_scenes.sliding(0.4))
    assert not held_out.is_unexplained(smooth, scene_bodies.of(smooth)[0][0])
    assert not scene_future.predict(smooth).taken


def test_a_body_that_passes_through_another_is_simulated_if_contacts_predict_its_slide_as_well_as_its_law():
    model, place = contact_scenes.sliding(1.6)
    law = models.MotionModel("translation", velocity=model.velocity, acceleration=model.velocity * -0.25)
    still = models.STATIC, place + [0.8, 0, 0]
    scene = contact_scenes.with_units(contact_scenes.scene((law, place), still))
    body = scene_bodies.of(scene)[0][0]
    assert body.reason == "its acceleration is not that of gravity"
    assert not held_out.is_unexplained(scene, body)
    found = scene_future.predict(scene, Wishes(samples=1))
    assert set(found.taken) == {"box 1", "box 2"}
    compared = found.compared["box 1"]
    assert compared.good and not compared.better


def test_a_body_that_accelerates_over_the_floor_by_itself_keeps_its_motion():
    model, place = contact_scenes.sliding(1.6)
    law = models.MotionModel("translation", velocity=model.velocity, acceleration=2.0 * model.velocity)
    scene = contact_scenes.with_units(contact_scenes.scene((law, place), (models.STATIC, place + [1.0, 0, 0])))
    found = scene_future.predict(scene, Wishes(samples=1))
    assert found.penetrations and not found.taken and found.groups is scene.groups


def test_a_body_whose_heights_drift_is_in_contact_and_one_in_flight_is_not():
    scene = contact_scenes.scene(contact_scenes.sliding(1.0))
    body, plane = scene_bodies.of(scene)[0][0], world.Plane(UP, 0.0)

    def with_heights(heights):
        poses = scene.tracks.poses.copy()
        poses[1, :, 6] += heights
        moved = dataclasses.replace(scene, tracks=dataclasses.replace(scene.tracks, poses=poses))
        return held_out.in_contact(moved, body, plane)

    since = TIMES - TIMES[-1]
    assert with_heights(0.2 * SIZE * since)
    assert not with_heights(-0.5 * G * (since + 0.15) ** 2 + 0.05 * SIZE)
    assert not with_heights(np.full(len(since), 0.3 * SIZE))


def test_contacts_are_good_if_they_explain_the_poses_or_no_worse_than_the_smooth_law():
    compare = held_out.Comparison
    assert compare(1.0, 2.9).good and compare(8.0, 8.5).good and not compare(8.0, 9.5).good
    assert not compare(8.0, 7.5).better and compare(8.0, 6.5).better
