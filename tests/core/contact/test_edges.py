"""Bodies that move off their support fall to the ground below, and others stay on it."""

import dataclasses

import numpy as np
import pytest
from scipy import spatial

from r5dgs_core.bake import contact
from r5dgs_core.contact import edges, scene_bodies, scene_future, scene_world, simulation, stepping, support, world
from r5dgs_core.contact.scene_world import Wishes
from r5dgs_core.motion import models
from tests.support import contact_scenes, contacts
from tests.support.contact_scenes import SIZE

pytest.importorskip("mujoco", reason="mujoco is not installed; it comes with the extra 'contact'")
UP = np.array([0.0, 0.0, 1.0])
DEPTH = 0.8


def table(speed, border=0.5, acceleration=0.0, **options):
    """A box that slides on a floor which is lower beyond a border in x."""
    model, place = contact_scenes.sliding(speed)
    model = dataclasses.replace(model, acceleration=np.array([acceleration, 0, 0]))
    scene = contact_scenes.with_units(contact_scenes.scene((model, place), **options))
    means = scene.gaussians.means.copy()
    means[(scene.gaussians.object_ids == 0) & (means[:, 0] > border), 2] -= DEPTH
    return dataclasses.replace(scene, gaussians=dataclasses.replace(scene.gaussians, means=means))


def test_a_box_that_slides_off_a_table_falls_to_the_ground_below():
    scene = table(2.0)
    found = scene_future.predict(scene, Wishes(samples=2))
    assert found.leaving == "box 1" and list(found.taken) == ["box 1"]
    outline, ground = found.world.world.edge.outline, found.world.world.edge.ground
    assert outline[:, 0].max() == pytest.approx(0.5, abs=0.15 * SIZE)
    assert ground.height == pytest.approx(-DEPTH, abs=0.1 * SIZE)
    model = found.groups[1].model
    assert abs(models.evaluate(model, 0.15)[1][2]) < 0.05 * SIZE  # still on the table
    fallen = models.evaluate(model, np.array([1.0, 1.1, 1.2]))[1][:, 2]
    assert (fallen < -DEPTH + SIZE).all() and (fallen > -DEPTH - 0.05 * SIZE).all()
    assert contact.needs((), found)[0]["reason"].startswith("moves off the edge of its support")


@pytest.mark.parametrize(("acceleration", "leaves"), [(-0.4, True), (4.0, False)], ids=["braked", "driven"])
def test_a_body_whose_law_is_no_free_motion_falls_off_the_edge_if_contacts_explain_its_poses(acceleration, leaves):
    scene = table(2.0, acceleration=acceleration)
    assert scene_bodies.of(scene)[0][0].reason
    found = scene_future.predict(scene, Wishes(samples=1))
    assert found.leaving == "box 1" and bool(found.taken) == leaves


@pytest.mark.parametrize("brakes", [False, True], ids=["drift", "friction"])
def test_a_body_whose_law_brakes_falls_off_the_edge_only_if_its_poses_do_not_brake(brakes):
    scene = table(1.1, 0.6, acceleration=-1.5 if brakes else -0.2)
    model = dataclasses.replace(scene.groups[1].model, acceleration=np.array([-1.5, 0, 0]))
    scene = dataclasses.replace(scene, groups=(scene.groups[0], dataclasses.replace(scene.groups[1], model=model)))
    assert models.evaluate(model, np.linspace(0, 0.8))[1][:, 0].max() < 0.5
    found = scene_future.predict(scene, Wishes(samples=1, until=1.4))
    assert bool(found.leaving) == (not brakes)
    assert brakes or list(found.taken) == ["box 1"]


def test_noise_does_not_widen_a_support_where_a_body_leaves_it():
    pixels = np.stack(np.meshgrid(*[np.linspace(-2, 2, 81)] * 2), -1).reshape(-1, 2)
    solid = pixels[:, 0] + np.random.default_rng(0).normal(0, 0.1, len(pixels)) < 0.5
    corners = pixels[solid][spatial.ConvexHull(pixels[solid]).vertices]
    path = np.array([[-1.0, 0.0], [0.9, 0.0]])
    found = edges._trimmed(corners, np.array([1.0, 0.0]), path, pixels[solid], pixels[~solid], 1.0)
    assert corners[:, 0].max() > 0.65 and found[:, 0].max() == pytest.approx(0.45, abs=0.05)
    np.testing.assert_array_equal(found.min(axis=0), corners.min(axis=0))


def test_depths_that_are_blurred_beyond_the_border_do_not_widen_an_outline():
    pixels = np.stack(np.meshgrid(*[np.linspace(-2, 2, 81)] * 2), -1).reshape(-1, 2)
    seen_through = np.random.default_rng(0).uniform(size=len(pixels)) < np.clip(2 * (pixels[:, 0] - 0.4), 0, 1)
    solid = ~seen_through  # half of the pixels 0.25 beyond the border at 0.4 show the support
    corners = pixels[solid][spatial.ConvexHull(pixels[solid]).vertices]
    path = np.array([[-1.0, 0.0], [0.85, 0.0]])
    found = edges._trimmed(corners, np.array([1.0, 0.0]), path, pixels[solid], pixels[~solid], 1.0)
    assert found[:, 0].max() == pytest.approx(0.4, abs=0.15 + 1e-9)  # 0.55 is on the grid


@pytest.mark.parametrize(("speed", "border"), [(1.0, 2.0), (0.2, 0.5), (-2.0, 0.5)], ids=["far", "slow", "away"])
def test_a_body_that_does_not_reach_the_edge_keeps_its_motion(speed, border, monkeypatch):
    monkeypatch.setattr(scene_world, "Simulation", None)
    scene = table(speed, border)
    found = scene_future.predict(scene)
    assert found.groups is scene.groups and not found.leaving


def test_no_picture_is_rendered_over_a_whole_floor(monkeypatch):
    monkeypatch.setattr(support, "surface", None)
    scene = contact_scenes.with_units(contact_scenes.scene(contact_scenes.sliding(0.8)))
    (body,), _ = scene_bodies.of(scene)
    assert edges.first(scene, [body], [0], 1.4, UP) is None


@pytest.mark.parametrize("make", [contacts.box, contacts.ball], ids=["box", "ball"])
def test_bodies_rest_on_a_support_with_an_edge_and_fall_beyond_it(make):
    size = contacts.SIZE
    outline = np.array([[-1, -1, 0], [0.3, -1, 0], [0.3, 1, 0], [-1, 1, 0]])
    edge = world.Edge(outline, world.Plane(UP, -0.5))
    place = contacts.on_plane(make([0, 0, 0.5 * size]), make([0.6, 0, 0.5 * size]))
    runs = simulation.Simulation(dataclasses.replace(place, edge=edge), stepping.choose(3.0, size, contacts.G, 2.0))
    quats, places = runs.poses(world.at_rest(place), np.array([1.5]))
    np.testing.assert_allclose(places[0, :, 2], [0.5 * size, 0.5 * size - 0.5], atol=0.01 * size)
    assert np.abs(quats[0, 0, 1:]).max() < 1e-3 and np.abs(places[0, 0, :2]).max() < 0.01 * size
