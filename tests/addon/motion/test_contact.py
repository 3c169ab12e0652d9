"""Panel *Contact*: prediction by the worker, and contacts off and on again."""

import importlib
import json
from types import SimpleNamespace

import numpy as np
import pytest

from r5dgs_core.scene import scene_file
from tests.support import contact_scenes, layouts, motions
from tests.support.contact_scenes import SIZE

NAME = "box 1 anchor"
POINTS, ENUMS = (
    ("co", "handle_left", "handle_right"),
    ("interpolation", "handle_left_type", "handle_right_type", "type"),
)


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    """File of a box that slides towards another one, which rests at some distance."""
    scene = contact_scenes.with_units(contact_scenes.scene(contact_scenes.sliding(1.2), contact_scenes.resting(2.0)))
    return scene_file.write(scene, tmp_path_factory.mktemp("contact") / "boxes.r5dgs")


@pytest.fixture
def boxes(blender, path):
    """Collection of that scene with the sliding box active."""
    collection = motions.load_again(blender, path)
    motions.choose(blender, blender.data.objects[NAME])
    return collection


@pytest.fixture
def worker(extension, monkeypatch):
    """Worker in this process: what it was asked."""
    pytest.importorskip("mujoco", reason="mujoco is not installed; it comes with the extra 'contact'")
    server = importlib.import_module("r5dgs_core.worker.server").Server()
    prediction = importlib.import_module("r5dgs_core.worker.contact_prediction")
    wishes = prediction.Wishes
    monkeypatch.setattr(prediction, "Wishes", lambda **given: wishes(**given, samples=3))
    asked = []

    def submit(key, steps):
        ((_, command, arguments),) = json.loads(json.dumps(steps))
        asked.append(arguments)
        return SimpleNamespace(answer=lambda: server.answer({"command": command, **arguments}))

    monkeypatch.setattr(motions.addon("worker.jobs"), "submit", submit)
    return asked


def add_wall(bpy, x=0.6):
    """Collection of a wall across the path of the box."""
    bpy.ops.mesh.primitive_cube_add(size=1, location=(x, 0.2, 0.3), scale=(0.1, 1.0, 0.6))
    meshes = bpy.data.collections.new("Walls")
    meshes.objects.link(bpy.context.object)
    return meshes


def keys(bpy):
    """All keys of all objects, with handles and types, exactly."""
    found = {}
    for obj in bpy.data.objects:
        for name, curve in motions.curves(obj).items():
            for field in (*POINTS, *ENUMS):
                count = len(curve.keyframe_points) * (2 if field in POINTS else 1)
                values = np.zeros(count, np.int32 if field in ENUMS else np.float32)
                curve.keyframe_points.foreach_get(field, values)
                found[obj.name, name, field] = values.tolist()
    return found


def place(bpy, collection, t):
    motions.go_to(bpy, collection, t)
    return motions.matrix(bpy, bpy.data.objects[NAME])[:3, 3]


@pytest.fixture
def stopped(blender, boxes, worker):
    """Collection whose sliding box stops at a wall."""
    boxes.r5dgs_contact.obstacles = add_wall(blender)
    assert blender.ops.r5dgs.predict_contacts() == {"FINISHED"}
    return boxes


def test_a_box_stops_at_a_mesh_of_the_collection(blender, stopped):
    assert place(blender, stopped, 0.7)[0] == pytest.approx(0.12, abs=0.05 * SIZE)
    assert place(blender, stopped, 1.0)[0] < 0.6 - 0.05 - SIZE / 2 + 0.05 * SIZE
    assert "box 1: friction" in stopped.r5dgs_contact.result
    physics = motions.addon("motion.physics")
    anchor = blender.data.objects[NAME]
    assert physics.is_written(anchor) and physics.band(anchor).half_width and not physics.edited(anchor.r5dgs_motion)
    stopped.r5dgs_contact.obstacles = None
    assert blender.ops.r5dgs.predict_contacts() == {"FINISHED"}
    assert place(blender, stopped, 1.0)[0] == pytest.approx(0.48, abs=1e-3)
    assert stopped.r5dgs_contact.result.startswith("Nothing touches anything")


@pytest.mark.parametrize("ticked", [False, True])
def test_rigid_bodies_get_the_material_of_the_prediction_or_that_of_the_panel(blender, boxes, worker, ticked):
    boxes.r5dgs_contact.obstacles = add_wall(blender)
    own = blender.data.objects[NAME].r5dgs_contact
    own.use_friction, own.friction = ticked, 0.9
    assert blender.ops.r5dgs.predict_contacts() == {"FINISHED"}
    fitted = motions.addon("motion.physics").material(blender.data.objects[NAME])
    assert fitted is not None and own.friction == pytest.approx(0.9 if ticked else fitted[0])
    motions.choose(blender, blender.data.objects[NAME])
    assert blender.ops.r5dgs.hand_over() == {"FINISHED"}
    found = blender.data.objects["box 1 proxy"].rigid_body
    assert (found.friction, found.restitution) == pytest.approx((own.friction, fitted[1]))


def test_off_and_on_again_restores_the_former_keys_exactly(blender, stopped):
    curve = motions.curves(blender.data.objects[NAME])["location", 0]
    curve.keyframe_points[-1].co[1] += 0.01  # an edit by hand
    curve.update()
    before, fields = keys(blender), blender.data.objects[NAME].r5dgs_motion.written
    assert blender.ops.r5dgs.switch_contacts() == {"FINISHED"}
    assert place(blender, stopped, 1.0)[0] == pytest.approx(0.48, abs=1e-3)
    assert blender.data.objects[NAME].r5dgs_motion.kind == "translation" and keys(blender) != before
    assert blender.ops.r5dgs.switch_contacts() == {"FINISHED"}
    assert keys(blender) == before
    state = blender.data.objects[NAME].r5dgs_motion
    assert (
        state.kind == "trajectory" and state.written == fields and not blender.data.objects[NAME].r5dgs_contact.former
    )


@pytest.mark.slow
def test_undo_takes_back_the_prediction_and_the_switch(blender, boxes, worker):
    boxes.r5dgs_contact.obstacles = add_wall(blender)
    blender.ops.ed.undo_push(message="wall")
    found = [keys(blender)]
    for name in ("predict_contacts", "switch_contacts", "switch_contacts"):
        assert getattr(blender.ops.r5dgs, name)() == {"FINISHED"}
        blender.ops.ed.undo_push(message=name)
        found.append(keys(blender))
    assert found[0] != found[1] != found[2] and found[3] == found[1]
    for former in (found[2], found[1], found[0]):
        blender.ops.ed.undo()
        assert keys(blender) == former
    blender.ops.ed.redo()
    assert keys(blender) == found[1]


def test_the_fields_of_the_panel_are_sent_in_the_units_of_the_scene(blender, boxes, worker):
    root, scene = boxes.r5dgs.root, blender.context.scene
    root.location, root.rotation_mode, root.rotation_euler = (1.0, 0, 0), "XYZ", (0, 0, np.pi / 2)
    scene.render.fps = 30  # the scene has 60 frames per unit of time
    own, settings = blender.data.objects[NAME].r5dgs_contact, boxes.r5dgs_contact
    own.use_friction, own.friction, own.mass = True, 0.7, 3.0
    settings.use_gravity, settings.gravity, settings.obstacles = True, 2.0, add_wall(blender)
    blender.context.view_layer.update()
    assert blender.ops.r5dgs.predict_contacts() == {"FINISHED"}
    (asked,) = worker
    assert asked["bodies"] == [{"group": 1, "friction": pytest.approx(0.7), "mass": 3.0}]
    assert asked["gravity"] == pytest.approx(8.0) and asked["until"] == pytest.approx(boxes.r5dgs.t_end)
    (wanted,) = motions.addon("motion.contact").request(blender.context, boxes).obstacles.values()
    np.testing.assert_allclose(wanted.mean(0), [0.2, 0.4, 0.3], atol=1e-6)  # (0.6, 0.2, 0.3) about the moved root


def test_a_collection_without_meshes_or_of_a_scene_is_refused(blender, boxes, worker):
    boxes.r5dgs_contact.obstacles = blender.data.collections.new("Nothing")
    with pytest.raises(RuntimeError, match="Nothing: expected meshes to collide with, found none"):
        blender.ops.r5dgs.predict_contacts()
    assert not worker


def test_the_panel_says_if_the_worker_cannot_simulate_and_smooth_motions_stay(blender, boxes, monkeypatch):
    panels = importlib.import_module("r5dgs.r5dgs_addon.panels.contact")
    assert "r5dgs.predict_contacts" in layouts.draw(blender, *panels.CLASSES)
    before = keys(blender)
    monkeypatch.setattr(motions.addon("worker.jobs"), "simulates", lambda: False)
    assert "lacks MuJoCo" in " ".join(layouts.draw(blender, *panels.CLASSES))
    with pytest.raises(RuntimeError, match="lacks MuJoCo"):
        blender.ops.r5dgs.predict_contacts()
    with pytest.raises(RuntimeError, match="No predicted motion of this scene has contacts"):
        blender.ops.r5dgs.switch_contacts()
    assert keys(blender) == before
