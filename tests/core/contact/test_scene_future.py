"""Scenes get motions with contacts where their smooth motions pass through something, and only there."""

import dataclasses

import numpy as np
import pytest

from r5dgs_core.contact import held_out, scene_future, scene_world, simulation, world
from r5dgs_core.contact.scene_world import Wishes
from r5dgs_core.motion import models, rotations
from r5dgs_core.motion.history import Band, History
from r5dgs_core.motion.models import MotionModel
from r5dgs_core.scene import scene_file
from tests.support import contact_scenes
from tests.support.contact_scenes import SIZE

pytest.importorskip("mujoco", reason="mujoco is not installed; it comes with the extra 'contact'")
FEW = Wishes(samples=6)


def lowest(scene, group, t):
    """Height of the lowest corner of a box at a time."""
    quats, moved = models.evaluate(group.model, t - scene.t_max)
    corners = next(hull.vertices for hull in scene.hulls if hull.motion_id == group.id)
    return float((rotations.rotate(quats, corners - group.pivot) + group.pivot + moved)[:, 2].min())


@pytest.fixture(scope="module")
def fallen():
    scene = contact_scenes.scene(contact_scenes.falling(), contact_scenes.resting(2.0))
    return scene, scene_future.predict(scene, FEW)


def test_a_falling_box_comes_to_rest_on_the_floor_and_keeps_its_smooth_motion(fallen):
    scene, found = fallen
    assert list(found.taken) == ["box 1"] and "friction 0.3" in found.taken["box 1"] and not found.lines
    assert found.penetrations["box 1"] > 1
    box, other = found.groups[1], found.groups[2]
    assert box.smooth == scene.groups[1].model and other is scene.groups[2]
    assert lowest(scene, scene.groups[1], 1.0) < -SIZE
    heights = [lowest(scene, box, t) for t in (0.8, 1.0, 2.5)]
    assert np.abs(heights).max() < 0.3 * SIZE and abs(heights[-1]) < 0.1 * SIZE
    before, after = (models.evaluate(group.model, 0.05)[1] for group in (scene.groups[1], box))
    np.testing.assert_allclose(before, after, atol=0.02 * SIZE)  # in flight
    assert np.linalg.norm(models.evaluate(box.model, 9.0)[1] - models.evaluate(box.model, 2.0)[1]) < 1e-9


@pytest.mark.parametrize(("kind", "simulated"), [("bounce", False), ("ballistic_spin", True)])
def test_a_body_bounces_on_off_the_floor_that_its_impacts_have_shown(kind, simulated):
    model, center = contact_scenes.falling(0.4)
    depth = center[2] - 0.45 * SIZE  # its floor is 0.05 sizes lower than the one that is seen
    landing = (-1.5 + np.sqrt(1.5**2 + 2 * contact_scenes.G * depth)) / contact_scenes.G
    model = dataclasses.replace(model, kind=kind, bounce_time=landing, restitution=0.8, angular_velocity=np.zeros(3))
    found = scene_future.predict(contact_scenes.scene((model, center)), FEW)
    assert ("box 1" in found.penetrations) == simulated == ("box 1" in found.taken)


@pytest.mark.parametrize(("smooth", "contact", "taken"), [(1.0, 8.0, False), (1.0, 2.5, True), (20.0, 19.0, True)])
def test_a_body_that_sinks_into_the_ground_keeps_its_law_if_contacts_predict_held_out_poses_worse(
    fallen, monkeypatch, smooth, contact, taken
):
    monkeypatch.setattr(held_out, "compare", lambda *_: held_out.Comparison(smooth, contact))
    found = scene_future.predict(fallen[0], FEW)
    assert ("box 1" in found.taken) == taken
    assert taken or "contacts are worse" in found.lines[0]


def test_the_band_widens_at_the_first_impact(fallen):
    _, found = fallen
    band = found.groups[1].history.band
    times, widths = np.array(band.times) - 0.6, np.array(band.half_width)
    impact = found.recording.touches[0].time if found.recording.touches[0].bodies == (-1, 0) else 0.17
    assert widths[times < impact - 0.02].max() < 0.1 * SIZE < widths[times > impact + 0.1].max()


def test_a_scene_with_contacts_is_stored_and_read(fallen, tmp_path):
    scene, found = fallen
    path = scene_file.write(dataclasses.replace(scene, groups=found.groups), tmp_path / "scene.r5dgs")
    back = scene_file.read(path)
    assert back.groups[1].model == found.groups[1].model and back.groups[1].smooth == scene.groups[1].model


@pytest.fixture(scope="module")
def pushed():
    """Scene of a box that slides into another one, with a band of the other one, and its prediction."""
    scene = contact_scenes.with_units(contact_scenes.scene(contact_scenes.sliding(1.5), contact_scenes.resting(0.8)))
    smooth = History(band=Band((0.6, 1.6), (0.1 * SIZE, 0.5 * SIZE), (0.1, 0.4)))
    groups = (*scene.groups[:2], dataclasses.replace(scene.groups[2], history=smooth))
    scene = dataclasses.replace(scene, groups=groups)
    return scene, scene_future.predict(scene, FEW)


def test_a_sliding_box_pushes_the_one_that_it_hits(pushed):
    scene, found = pushed
    assert set(found.taken) == {"box 1", "box 2"} and "both assumed" in found.taken["box 2"]
    first, second = (models.evaluate(group.model, 0.8)[1] for group in found.groups[1:])
    assert second[0] > 0.05 * SIZE and first[0] < 0.4 + second[0] + 0.05 * SIZE
    assert models.evaluate(scene.groups[1].model, 0.8)[1][0] == pytest.approx(1.2)


def test_the_band_of_a_body_that_is_only_hit_includes_that_of_its_smooth_motion(pushed):
    smooth, band = (part.groups[2].history.band for part in pushed)
    times = np.array(band.times)
    assert smooth is not band and (band.widths(times) >= smooth.widths(times) - 1e-12).all()
    assert (band.angles(times) >= smooth.angles(times) - 1e-12).all()


@pytest.mark.parametrize(
    ("bodies", "line"),
    [
        ([contact_scenes.sliding(0.4)], ""),
        ([contact_scenes.resting()], ""),
        (
            [(MotionModel("constant_twist", velocity=[0, 0, -2], angular_velocity=[0, 0, 1]), np.array([0, 0, 0.6]))],
            "box 1: keeps its smooth motion: its motion is that of a driven body (screw)",
        ),
        (
            [(MotionModel("translation", velocity=[0, 0, -2], acceleration=[9, 0, 0]), np.array([0, 0, 0.6]))],
            "box 1: keeps its smooth motion: its acceleration is not that of gravity",
        ),
        (
            [(MotionModel("translation", velocity=[0, 0, -2.0]), np.array([0, 0, 0.6]))],
            "no contacts are predicted: gravity is unknown",
        ),
    ],
)
def test_without_need_or_reason_the_groups_stay_and_nothing_is_simulated(bodies, line, monkeypatch):
    monkeypatch.setattr(simulation, "Simulation", None)
    monkeypatch.setattr(scene_world, "Simulation", None)
    scene = contact_scenes.scene(*bodies)
    found = scene_future.predict(scene)
    assert found.groups is scene.groups and not found.taken
    assert [text for text in found.lines if line and text.startswith(line)] == list(found.lines)
    assert bool(found.lines) == bool(line)


def test_a_body_that_slides_on_a_board_does_not_pass_into_it(monkeypatch):
    monkeypatch.setattr(scene_world, "Simulation", None)
    model, center = contact_scenes.sliding(0.8)
    scene = contact_scenes.scene((model, center + [0, 0, 0.04]), contact_scenes.resting(0.4))
    scene = contact_scenes.with_hull(scene, 2, [0.4, 0.2, 0.02], [2.4, 1.2, 0.04])
    assert not scene_future.predict(scene).penetrations


@pytest.mark.slow
def test_a_body_whose_poses_contacts_do_not_explain_moves_on_and_nothing_hits_it(monkeypatch):
    fit = scene_world._fit

    def unsound(scene, body, *rest):
        fitter, estimate = fit(scene, body, *rest)
        return fitter, estimate if body.name == "box 1" else dataclasses.replace(estimate, misfit=np.nan)

    monkeypatch.setattr(scene_world, "_fit", unsound)
    made = contact_scenes.scene(contact_scenes.sliding(1.5), contact_scenes.sliding(-0.5, 0.8))
    found = scene_future.predict(contact_scenes.with_units(made), Wishes(samples=1))
    assert "box 2: keeps its smooth motion: contacts do not explain its poses" in found.lines
    assert found.groups[2] is made.groups[2] and "box 2" not in found.taken


@pytest.mark.parametrize("gap", [0.0, 0.3])
def test_a_pushed_body_at_rest_moves_off_and_stays_over_the_floor(gap):
    model, center = contact_scenes.resting()
    scene = contact_scenes.with_units(contact_scenes.scene((model, center + [0, 0, gap])))
    found = scene_future.predict(scene, Wishes(pushes={1: np.array([0.5, 0, 0])}, samples=1))
    first, last = (models.evaluate(found.groups[1].model, tau)[1] for tau in (0.01, 2.0))
    assert last[0] > 0.01 and abs(first[2]) < 1e-3 * SIZE
    assert last[2] == pytest.approx(-gap, abs=1e-3 * SIZE if not gap else 0.1 * SIZE)


def test_users_push_bodies_change_materials_and_leave_bodies_out(fallen):
    scene, _ = fallen
    ice = Wishes(materials={1: (0.0, 0.0)}, pushes={2: np.array([0.0, 1.0, 0.0])}, samples=2)
    found = scene_future.predict(scene, ice)
    assert found.taken["box 1"].startswith("friction 0, restitution 0.05,")  # the least that is simulated
    assert models.evaluate(found.groups[2].model, 0.5)[1][1] > 0.1
    assert not scene_future.predict(scene, Wishes(ignored=frozenset({1}))).taken


def test_the_plane_of_the_floor_is_found_to_a_few_percent_of_the_size(fallen):
    scene, _ = fallen
    bodies = scene_future.scene_bodies.of(scene)[0]
    plane = scene_world.plane(scene, bodies, 1.0, np.array([0, 0, 1.0]))
    assert plane.normal[2] > 0.999 and abs(plane.height) < 0.1 * SIZE  # a pixel is 0.12 * SIZE


def test_bodies_that_overlap_at_t_max_are_shrunk_until_they_do_not():
    scene = contact_scenes.scene(contact_scenes.resting(0.0), contact_scenes.resting(0.38))
    bodies = tuple(world.Body(body.solid) for body in scene_future.scene_bodies.of(scene)[0])
    made = world.World(bodies, world.Plane(np.array([0, 0, 1.0]), 0.0), np.array([0, 0, -4.0]))
    apart = scene_world.apart(made)
    assert sum(body.solid.volume for body in apart.bodies) < sum(body.solid.volume for body in bodies)
    runs = simulation.Simulation(apart, simulation.Stepping(100.0, 1e-3))
    assert (0, 1) not in runs.deepest(world.at_rest(apart))
    assert min(body.solid.vertices[:, 2].min() for body in apart.bodies) == pytest.approx(0.0, abs=1e-9)


def test_a_flat_hull_is_named_and_left_out():
    scene = contact_scenes.scene(contact_scenes.falling())
    hull = dataclasses.replace(scene.hulls[0], vertices=scene.hulls[0].vertices * [1, 1, 0])
    found = scene_future.predict(dataclasses.replace(scene, hulls=(hull,)))
    assert found.lines == ("box 1: has no contacts: the points of a hull lie in a plane",)


def test_shapes_of_bodies_that_are_never_close_are_not_compared(monkeypatch):
    compared, overlap = [], scene_future._overlap

    def counted(body, path, other, others_path):
        compared.append((body.name, other.name))
        return overlap(body, path, other, others_path)

    monkeypatch.setattr(scene_future, "_overlap", counted)
    model, center = contact_scenes.falling()
    far = contact_scenes.resting(20.0)
    below = (MotionModel(radius=0.5 * SIZE), center - [0, 0, 0.5 * center[2]])
    scene_future.predict(contact_scenes.scene((model, center), far, below), FEW)
    assert compared == [("box 1", "box 3")]
