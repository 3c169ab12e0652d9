"""Capture: the data set agrees with Blender to the pixel, and Blender's file is restored afterwards."""

import dataclasses
import importlib
import importlib.util
import itertools
import json
import math
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from r5dgs_core import errors
from r5dgs_core.data import dataset, images
from r5dgs_core.scene import cameras
from tests.support import scenes

pytest.importorskip("bpy", reason="bpy is not installed; it comes with the extra 'test' on Python 3.11")
pytestmark = pytest.mark.blender
SMALL = {"resolution_x": 40, "resolution_y": 30, "samples": 1, "denoise": False}
STILL = {"frame_end": 1, "objects": "SELECTED"}  # a single time; the moving ball is selected


@pytest.fixture(scope="module")
def service(extension):
    """The capture services of the add-on, as attributes of one object."""
    names = ("capture", "cameras", "captured_objects", "files", "overrides", "render", "settings")
    modules = {name: importlib.import_module(f"r5dgs.r5dgs_addon.capture.{name}") for name in names}
    return type("Service", (), modules)


@pytest.fixture
def scene(blender):
    """Two coloured balls, one moving along x, on a floor that is not an object; four cameras, one of them novel."""
    for ob in list(blender.data.objects):
        blender.data.objects.remove(ob)
    add_ball(blender, "still ball", (-1.0, 0.0, 0.5), (0.1, 0.3, 0.8))
    moving = add_ball(blender, "moving ball", (0.0, 0.0, 0.5), (0.8, 0.3, 0.1))
    for frame, x in ((1, 0.2), (9, 1.4)):
        moving.location.x = x
        moving.rotation_euler.z = x
        moving.keyframe_insert("location", frame=frame)
        moving.keyframe_insert("rotation_euler", frame=frame)
    blender.ops.mesh.primitive_plane_add(size=8, location=(0, 0, -0.1))
    for number, azimuth in enumerate((-130, -90, -50)):
        add_camera(blender, f"cam{number}", azimuth)
    add_camera(blender, "cam novel", -70)
    light = blender.data.objects.new("sun", blender.data.lights.new("sun", "SUN"))
    light.data.energy = 2.0
    blender.context.scene.collection.objects.link(light)
    blender.context.scene.frame_start, blender.context.scene.frame_end = 1, 9
    blender.ops.object.select_all(action="DESELECT")
    moving.select_set(True)
    blender.context.view_layer.update()
    return blender.context.scene


def add_ball(bpy, name, location, color, radius=0.35):
    bpy.ops.mesh.primitive_uv_sphere_add(radius=radius, location=location, segments=24, ring_count=16)
    ball = bpy.context.object
    ball.name = name
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    next(n for n in material.node_tree.nodes if n.type == "BSDF_PRINCIPLED").inputs[0].default_value = (*color, 1)
    ball.data.materials.append(material)
    return ball


def add_camera(bpy, name, azimuth_deg, distance=5.0, height=3.0):
    from mathutils import Vector

    camera = bpy.data.objects.new(name, bpy.data.cameras.new(name))
    azimuth = math.radians(azimuth_deg)
    camera.location = (distance * math.cos(azimuth), distance * math.sin(azimuth), height)
    look = Vector((0.1, 0, 0.4)) - camera.location
    camera.rotation_euler = look.to_track_quat("-Z", "Y").to_euler()
    bpy.context.scene.collection.objects.link(camera)
    return camera


def settings_for(service, directory, **changes):
    """Small and fast settings: frames 1, 5, 9 are t = 0, 0.5, 1."""
    values = {**SMALL, "directory": directory, "frame_step": 4, "t_max": 0.5, "objects": "ANIMATED", **changes}
    return service.settings.CaptureSettings(**values)


def capture(service, bpy, directory, **changes):
    result = service.capture.capture(bpy.context, settings_for(service, directory, **changes))
    return dataset.read(directory), result


def fingerprint(bpy):
    """State of the file that a capture changes temporarily."""
    scene, found = bpy.context.scene, {}
    owners = [scene.render, scene.render.image_settings, scene.cycles, scene.view_settings, scene.display_settings]
    owners += [*scene.view_layers, *(layer.cycles for layer in scene.view_layers)]
    for number, owner in enumerate(owners):
        for prop in owner.bl_rna.properties:
            if prop.type in ("BOOLEAN", "INT", "FLOAT", "STRING", "ENUM") and not getattr(prop, "is_array", False):
                found[number, type(owner).__name__, prop.identifier] = getattr(owner, prop.identifier)
    found["frame"] = scene.frame_current, scene.frame_subframe
    found["camera"] = scene.camera and scene.camera.name
    found["objects"] = sorted((ob.name, ob.pass_index, ob.hide_viewport) for ob in bpy.data.objects)
    found["cameras"] = sorted((camera.name, camera.dof.use_dof) for camera in bpy.data.cameras)
    found["markers"] = [(marker.frame, marker.camera and marker.camera.name) for marker in scene.timeline_markers]
    return found


# Times


@given(st.integers(-20, 20), st.integers(0, 60), st.integers(1, 7), st.floats(0, 1), st.integers(1, 5), st.booleans())
def test_the_splits_divide_time_at_t_max(extension, start, length, step, t_max, val_every, between):
    capture_module = importlib.import_module("r5dgs.r5dgs_addon.capture.capture")
    settings = capture_module.CaptureSettings(
        directory="x", frame_step=step, t_max=t_max, val_every=val_every, val_between=between
    )
    plan = capture_module.plan_times(settings, start, start + length)
    assert sorted(plan.observed + plan.test) == [float(f) for f in range(start, start + length + 1, step)]
    assert all(plan.time(frame) <= t_max + 1e-6 for frame in plan.observed)
    assert all(plan.time(frame) > t_max for frame in plan.test)
    assert plan.val and all(plan.observed[0] <= frame <= plan.observed[-1] for frame in plan.val)
    assert between or set(plan.val) <= set(plan.observed)
    assert plan.time(start) == 0.0 and all(0.0 <= plan.time(frame) <= 1.0 for frame in plan.frames)


def test_val_includes_times_between_the_observed_ones(service):
    settings = service.settings.CaptureSettings(directory="x", frame_step=4, t_max=0.75, val_every=4)
    plan = service.capture.plan_times(settings, 1, 61)
    assert len(plan.observed) == 12
    assert plan.val == (5.0, 15.0, 21.0, 31.0, 37.0)


# Rigs


@pytest.mark.parametrize("kind", ["ARC", "RING", "HEMISPHERE"])
@pytest.mark.parametrize(("observed", "novel"), [(1, 0), (1, 1), (8, 2), (3, 5)])
def test_every_rig_camera_looks_at_the_target_from_its_distance(service, kind, observed, novel):
    target = np.array([40.0, -25.0, 3.0])
    groups = service.cameras.rig_poses(
        kind, observed, novel, target=target, radius=7.0, elevation_deg=20.0, elevation_spread_deg=6.0
    )
    assert [len(group) for group in groups] == [observed, novel]
    centers = []
    for pose in (*groups[0], *groups[1]):
        camera = scenes.camera_from_field_of_view(pose, 0.8, 64, 64)
        pixel, depth = cameras.project(camera, target)
        np.testing.assert_allclose(pixel, [32, 32], atol=1e-9)
        assert depth == pytest.approx(7.0)
        np.testing.assert_allclose(pose[:3, :3].T @ pose[:3, :3], np.eye(3), atol=1e-12)
        assert np.linalg.det(pose[:3, :3]) > 0 and pose[2, 1] > 0  # upright
        centers.append(camera.center)
    apart = [np.linalg.norm(a - b) for a, b in itertools.combinations(centers, 2)]
    assert min(apart, default=1.0) > 0.05


def test_an_arc_is_centred_on_its_azimuth_and_a_ring_is_closed(service):
    def azimuths(kind, **changes):
        poses, _ = service.cameras.rig_poses(kind, 4, 0, target=np.zeros(3), radius=1.0, elevation_deg=0.0, **changes)
        return [math.degrees(math.atan2(pose[1, 3], pose[0, 3])) for pose in poses]

    assert azimuths("ARC", azimuth_deg=-90, arc_deg=90) == pytest.approx([-135, -105, -75, -45])
    assert azimuths("RING", azimuth_deg=-90) == pytest.approx([-90, 0, 90, 180])


def test_a_file_with_one_camera_is_captured_from_an_arc_about_it(service, blender, tmp_path):
    blender.data.objects["Cube"].pass_index = 1
    data, result = capture(service, blender, tmp_path / "d", rig_observed=3, frame_end=1, objects="AUTO")
    assert result.objects == {1: "Cube"} and result.unseen == ()
    assert len(data.train) == 3 and len(data.val) == 2
    camera = blender.data.objects["Camera"]
    middle = data.train[1].camera.center / np.linalg.norm(data.train[1].camera.center)
    np.testing.assert_allclose(middle, np.array(camera.location.normalized()), atol=1e-5)
    assert not [ob.name for ob in blender.data.objects if ob.name.startswith(("obs", "novel"))]


# The data set agrees with Blender


@pytest.fixture
def captured(service, blender, scene, tmp_path):
    return capture(service, blender, tmp_path / "set", t_max=0.5, rig="NONE", test_views=2)


def test_the_layout_is_read_as_captured(captured):
    data, result = captured
    assert {view.camera.name for view in data.train} == {"cam0", "cam1", "cam2"}
    assert sorted({view.t for view in data.train}) == [0.0, 0.5]
    assert {view.camera.name for view in data.val} == {"cam novel"}
    assert {view.camera.name for view in data.test} == {"cam0", "cam2", "cam novel"}
    assert {view.t for view in data.test} == {1.0}
    assert result.images == {"train": 6, "val": len(data.val), "test": 3}
    assert data.object_names == {1: "moving ball"}
    assert data.ground_truth.t_max == 0.5 == data.t_max
    assert data.frames_per_unit == 8.0
    assert not data.has_alpha


def test_the_mask_covers_the_visible_pixels_of_the_object(captured):
    data, _ = captured
    truth = data.ground_truth
    for view in (*data.train, *data.val, *data.test):
        ids = dataset.load_mask(view)
        matrix = truth.matrices[0, int(np.argmin(np.abs(truth.times - view.t)))]
        pixel, _ = cameras.project(view.camera, matrix[:3, 3])
        ys, xs = np.nonzero(ids == 1)
        assert set(np.unique(ids)) == {0, 1}
        np.testing.assert_allclose([xs.mean() + 0.5, ys.mean() + 0.5], pixel, atol=0.5)


def test_poses_match_blenders_evaluation(captured, blender, scene):
    truth = captured[0].ground_truth
    moving = blender.data.objects["moving ball"]
    for index, t in enumerate(truth.times):
        frame = 1 + 8 * t
        scene.frame_set(math.floor(frame), subframe=frame % 1)
        np.testing.assert_allclose(truth.matrices[0, index], np.array(moving.matrix_world), atol=1e-6)
    assert set(truth.times) >= {0.0, 0.5, 1.0}


@pytest.mark.parametrize("transparent", [False, True])
@pytest.mark.parametrize("transform", ["Standard", "AgX"])
def test_colours_match_blenders_output(service, blender, scene, tmp_path, transparent, transform):
    changes = {"samples": 4, "seed": 7, "view_transform": transform, "transparent": transparent, "observed": "cam1"}
    blender.data.objects.remove(blender.data.objects["Plane"])
    data, _ = capture(service, blender, tmp_path / "set", rig="NONE", **STILL, **changes)
    render = scene.render
    render.engine, scene.cycles.samples, scene.cycles.seed, scene.cycles.use_denoising = "CYCLES", 4, 7, False
    render.resolution_x, render.resolution_y, render.resolution_percentage = 40, 30, 100
    render.film_transparent, render.dither_intensity = transparent, 0.0
    scene.view_settings.view_transform = transform
    render.image_settings.file_format, render.image_settings.color_depth = "PNG", "8"
    render.image_settings.color_mode = "RGBA" if transparent else "RGB"
    render.filepath, scene.camera = str(tmp_path / "own.png"), blender.data.objects["cam1"]
    scene.frame_set(1)
    blender.ops.render.render(write_still=True)
    own = images.read_png(tmp_path / "own.png").astype(int)
    ours = images.read_png(data.train[0].image_path).astype(int)
    assert own.shape == ours.shape == (30, 40, 4 if transparent else 3)
    assert np.ptp(own) > 60
    assert np.abs(own - ours).max() <= 1
    if transparent:
        assert data.has_alpha and (ours[0, 0] == 0).all()


@pytest.mark.parametrize("fit", ["AUTO", "HORIZONTAL", "VERTICAL"])
@pytest.mark.parametrize("size", [(44, 26), (26, 44)])
def test_intrinsics_follow_sensor_fit_shift_and_scale(service, blender, scene, tmp_path, fit, size):
    for name, shift in (("cam0", (0.0, 0.0)), ("cam1", (0.1, -0.15))):
        camera = blender.data.objects[name]
        camera.data.sensor_fit, camera.data.lens = fit, 30 if name == "cam1" else 35
        camera.data.shift_x, camera.data.shift_y = shift
        camera.scale = (2, 2, 2)
    data, _ = capture(
        service,
        blender,
        tmp_path / "set",
        resolution_x=size[0],
        resolution_y=size[1],
        observed="cam0, cam1",
        rig="NONE",
        **STILL,
    )
    assert len(data.train) == 2
    center = data.ground_truth.matrices[0, 0, :3, 3]
    for view in data.train:
        ys, xs = np.nonzero(dataset.load_mask(view) == 1)
        pixel, _ = cameras.project(view.camera, center)
        np.testing.assert_allclose([xs.mean() + 0.5, ys.mean() + 0.5], pixel, atol=0.5)
    rows = json.loads((data.root / "transforms_train.json").read_text())["frames"]
    assert ["fl_x" in row for row in rows] == [False, True]


def test_many_ids_are_exact_in_sixteen_bits(service, blender, scene, tmp_path):
    blender.data.objects["still ball"].pass_index = 3
    blender.data.objects["moving ball"].pass_index = 30001
    data, result = capture(service, blender, tmp_path / "set", frame_end=1, objects="AUTO")
    assert result.objects == {3: "still ball", 30001: "moving ball"}
    found = set()
    for view in data.train:
        assert images.read_png(view.mask_path).dtype == np.uint16
        found |= set(np.unique(dataset.load_mask(view)).tolist())
    assert found == {0, 3, 30001}


def test_an_object_that_no_image_shows_is_reported(service, blender, scene, tmp_path):
    add_ball(blender, "behind", (0, 0, -3.0), (0.5, 0.5, 0.5)).pass_index = 1
    blender.data.objects["moving ball"].pass_index = 2
    _, result = capture(service, blender, tmp_path / "set", frame_end=1, objects="PASS_INDEX")
    assert result.unseen == ("behind",)


# Selection of objects


def choose(service, bpy, choice, collection=""):
    with service.overrides.Overrides() as overrides:
        survey = service.captured_objects.survey(bpy.context, (1.0, 9.0), overrides)
        return service.captured_objects.choose(bpy.context.view_layer, survey, choice, collection)


def parent_to_empty(bpy, name, children):
    empty = bpy.data.objects.new(name, None)
    bpy.context.scene.collection.objects.link(empty)
    for child in children:
        child.parent = empty
    bpy.context.view_layer.update()
    return empty


def test_children_of_one_empty_are_one_object_with_its_pose(service, blender, scene):
    parts = [add_ball(blender, f"part {k}", (k, 2.0, 0.0), (0.5, 0.5, 0.5)) for k in range(2)]
    root = parent_to_empty(blender, "truck", parts)
    for frame, z in ((1, 0.0), (9, 2.0)):
        root.location.z = z
        root.keyframe_insert("location", frame=frame)
    found = choose(service, blender, "ANIMATED")
    assert [(o.id, o.name) for o in found] == [(1, "moving ball"), (2, "truck")]
    assert found[1].root == root and set(found[1].members) == set(parts)


def test_an_empty_that_carries_the_whole_scene_is_no_object(service, blender, scene):
    everything = [ob for ob in scene.objects if ob.type == "MESH"]
    parent_to_empty(blender, "world", everything)
    assert [o.name for o in choose(service, blender, "ANIMATED")] == ["moving ball"]


def test_moving_children_of_a_static_empty_are_separate_objects(service, blender, scene):
    other = add_ball(blender, "other ball", (0.0, 2.0, 0.5), (0.5, 0.5, 0.5))
    other.keyframe_insert("location", frame=1)
    other.location.y = 3.0
    other.keyframe_insert("location", frame=9)
    parent_to_empty(blender, "group", [other, blender.data.objects["moving ball"]])
    assert [o.name for o in choose(service, blender, "ANIMATED")] == ["moving ball", "other ball"]


def test_equal_pass_indices_are_one_object(service, blender, scene):
    for name in ("moving ball", "still ball"):
        blender.data.objects[name].pass_index = 5
    (found,) = choose(service, blender, "AUTO")
    assert found.id == 5 and len(found.members) == 2


def test_child_collections_are_objects(service, blender, scene):
    source, child = blender.data.collections.new("things"), blender.data.collections.new("pair")
    scene.collection.children.link(source)
    source.children.link(child)
    child.objects.link(blender.data.objects["moving ball"])
    source.objects.link(blender.data.objects["still ball"])
    found = choose(service, blender, "COLLECTION", "things")
    assert [(o.id, o.name, o.root.name) for o in found] == [(1, "pair", "moving ball"), (2, "still ball", "still ball")]


def test_the_selection_is_used_if_nothing_moves(service, blender, scene):
    blender.data.objects["moving ball"].animation_data_clear()
    blender.data.objects["moving ball"].select_set(False)
    blender.data.objects["still ball"].select_set(True)
    assert [o.name for o in choose(service, blender, "AUTO")] == ["still ball"]


def test_objects_hidden_in_renders_are_not_captured(service, blender, scene):
    blender.data.objects["still ball"].pass_index = 1
    moving = blender.data.objects["moving ball"]
    moving.pass_index = 2
    hidden = blender.data.collections.new("hidden")
    hidden.hide_render = True
    scene.collection.children.link(hidden)
    for collection in moving.users_collection:
        collection.objects.unlink(moving)
    hidden.objects.link(moving)
    assert [o.name for o in choose(service, blender, "AUTO")] == ["still ball"]


def test_poses_are_rigid_at_any_scale(service, blender, scene):
    moving = blender.data.objects["moving ball"]
    moving.scale = (2.0, -0.5, 1.0)
    with service.overrides.Overrides() as overrides:
        survey = service.captured_objects.survey(blender.context, (1.0, 4.5, 9.0), overrides)
    (found,) = service.captured_objects.choose(blender.context.view_layer, survey, "ANIMATED", "")
    poses = service.captured_objects.poses(survey, found)
    rotations = poses[:, :3, :3]
    np.testing.assert_allclose(rotations @ rotations.transpose(0, 2, 1), np.tile(np.eye(3), (3, 1, 1)), atol=1e-6)
    np.testing.assert_allclose(np.linalg.det(rotations), 1.0, atol=1e-6)
    turn = rotations[2] @ rotations[0].T
    np.testing.assert_allclose(
        turn[:2, :2], [[math.cos(1.2), -math.sin(1.2)], [math.sin(1.2), math.cos(1.2)]], atol=1e-5
    )


# Nothing else changes


def unusual(scene, bpy):
    """Give the file settings that a capture must restore."""
    scene.view_settings.view_transform = "AgX"
    scene.view_settings.look = "AgX - Punchy"
    scene.render.engine = "BLENDER_WORKBENCH"
    scene.render.image_settings.file_format = "JPEG"
    scene.render.image_settings.quality = 51
    scene.render.use_motion_blur = True
    scene.render.resolution_percentage = 37
    scene.cycles.samples = 9
    scene.camera = bpy.data.objects["cam2"]
    scene.camera.data.dof.use_dof = True
    scene.timeline_markers.new("cut", frame=1).camera = bpy.data.objects["cam0"]
    bpy.data.objects["still ball"].pass_index = 77
    bpy.data.objects["still ball"].hide_viewport = True
    scene.view_layers.new("second")
    scene.frame_set(3, subframe=0.25)


def test_the_file_is_as_it_was_after_a_capture(service, blender, scene, tmp_path):
    unusual(scene, blender)
    before = fingerprint(blender)
    assert len(before) > 200
    capture(service, blender, tmp_path / "set", rig="RING", rig_observed=2, **STILL)
    assert fingerprint(blender) == before


def test_the_file_is_as_it_was_after_an_error_and_no_folder_stays(service, blender, scene, tmp_path, monkeypatch):
    unusual(scene, blender)
    before = fingerprint(blender)
    calls = []

    def fail_later(*arguments, **keywords):
        calls.append(arguments)
        if len(calls) == 2:
            raise errors.DatasetError("disc full")

    monkeypatch.setattr(service.files, "write_view", fail_later)
    with pytest.raises(errors.DatasetError, match="disc full"):
        capture(service, blender, tmp_path / "set", rig="RING")
    assert fingerprint(blender) == before
    assert list(tmp_path.iterdir()) == []


def test_stopping_half_way_restores_the_file_and_leaves_nothing(service, blender, scene, tmp_path):
    before = fingerprint(blender)
    running = service.capture.steps(blender.context, settings_for(service, tmp_path / "set", rig="ARC"))
    states = [next(running), next(running)]
    assert [state.done for state in states] == [1, 2] and states[0].total > 20
    assert fingerprint(blender) != before
    running.close()
    assert fingerprint(blender) == before
    assert list(tmp_path.iterdir()) == []


# Errors


def test_no_camera_is_an_error(service, blender, scene, tmp_path):
    with pytest.raises(errors.ConfigError, match="capture.observed: .*'left\\*'.*choose a rig"):
        capture(service, blender, tmp_path / "set", rig="NONE", observed="left*")


def test_an_orthographic_camera_is_an_error(service, blender, scene, tmp_path):
    blender.data.objects["cam1"].data.type = "ORTHO"
    with pytest.raises(errors.ConfigError, match="'cam1': expected a perspective camera, got ORTHO"):
        capture(service, blender, tmp_path / "set", rig="NONE")


def test_no_object_is_an_error(service, blender, scene, tmp_path):
    blender.data.objects["moving ball"].animation_data_clear()
    with pytest.raises(errors.ConfigError, match="capture.objects: expected an object"):
        capture(service, blender, tmp_path / "set")
    with pytest.raises(errors.ConfigError, match="no collection 'toys'"):
        capture(service, blender, tmp_path / "set", objects="COLLECTION", object_collection="toys")


def test_a_folder_in_use_is_an_error_and_keeps_its_files(service, blender, scene, tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(errors.DatasetError, match="expected a new or empty folder"):
        capture(service, blender, tmp_path)
    assert (tmp_path / "notes.txt").read_text() == "mine"
    with pytest.raises(errors.DatasetError, match="found a file"):
        capture(service, blender, tmp_path / "notes.txt")


def test_an_empty_folder_is_used(service, blender, scene, tmp_path):
    (tmp_path / "set").mkdir()
    data, _ = capture(service, blender, tmp_path / "set", **STILL)
    assert len(data.train) == 3


def test_more_objects_than_blender_can_index_are_an_error(service, blender, scene, tmp_path, monkeypatch):
    monkeypatch.setattr(service.capture, "MAX_OBJECTS", 1)
    with pytest.raises(errors.ConfigError, match="expected ids up to 1.*found up to 2"):
        blender.data.objects["still ball"].select_set(True)
        capture(service, blender, tmp_path / "set", objects="SELECTED")
    assert blender.types.Object.bl_rna.properties["pass_index"].hard_max == 32767


def test_without_openimageio_the_remedy_is_named(service, blender, scene, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "OpenImageIO", None)
    with pytest.raises(errors.BackendError, match="pip install OpenImageIO"):
        capture(service, blender, tmp_path / "set")


def test_missing_denoiser_raises_an_error_with_the_remedy(service, blender, scene, tmp_path, monkeypatch):
    def render(**keywords):
        raise RuntimeError("Error: Failed to denoise, build has no OpenImageDenoise support\n")

    ops = SimpleNamespace(render=SimpleNamespace(render=render))
    stand_in = SimpleNamespace(ops=ops, app=blender.app, data=blender.data)
    monkeypatch.setattr(service.render, "bpy", stand_in)
    with pytest.raises(errors.BackendError, match="capture: Failed to denoise, .*; switch denoising off"):
        capture(service, blender, tmp_path / "set")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"samples": 0}, "capture.samples: expected at least 1, got 0"),
        ({"t_max": 1.5}, "capture.t_max"),
        ({"frame_start": 9, "frame_end": 1}, "frame_end >= frame_start, got 9 to 1"),
        ({"rig": "SPIRAL"}, "capture.rig: expected one of AUTO"),
        ({"view_transform": "Sepia"}, "capture.view_transform"),
        ({"rig": "ARC", "rig_observed": 0}, "capture.rig_observed"),
        ({"rig": "ARC", "rig_target": "nobody"}, "capture.rig_target: there is no object 'nobody'"),
        ({"rig_fov_deg": 180.0}, "capture.rig_fov_deg"),
    ],
)
def test_a_wrong_setting_is_named(service, blender, scene, tmp_path, change, message):
    with pytest.raises(errors.ConfigError, match=message):
        capture(service, blender, tmp_path / "set", **change)
    assert list(tmp_path.iterdir()) == []


# The operator


def test_the_operator_captures_like_the_service(service, blender, scene, tmp_path, capfd):
    arguments = {**SMALL, "frame_step": 4, "t_max": 0.5, "objects": "ANIMATED", "rig": "NONE"}
    assert blender.ops.r5dgs.capture_dataset(directory=str(tmp_path / "a"), **arguments) == {"FINISHED"}
    lines = [json.loads(line) for line in capfd.readouterr().out.splitlines() if line.startswith("{")]
    capture(service, blender, tmp_path / "b", rig="NONE")
    files = [sorted(p.relative_to(tmp_path / x) for p in (tmp_path / x).rglob("*") if p.is_file()) for x in "ab"]
    assert files[0] == files[1]
    for name in files[0]:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    pictures = [name for name in files[0] if name.suffix == ".png" and name.parts[0] != "object_mask"]
    assert [line["done"] for line in lines] == list(range(1, len(pictures) + 1))


def test_the_operator_reports_user_errors(blender, scene, tmp_path):
    with pytest.raises(RuntimeError, match="capture.observed"):
        blender.ops.r5dgs.capture_dataset(directory=str(tmp_path / "a"), rig="NONE", observed="nobody")
    with pytest.raises(RuntimeError, match="expected a folder"):
        blender.ops.r5dgs.capture_dataset()


def test_a_capture_that_blender_cancels_leaves_nothing(service, blender, scene, tmp_path):
    """Blender cancels if the file or window is closed. bpy has no window, so the test calls the operator's method."""
    operator = importlib.import_module("r5dgs.operators.capture_dataset").R5DGS_OT_capture_dataset
    before = fingerprint(blender)
    steps = service.capture.steps(blender.context, settings_for(service, tmp_path / "set", rig="ARC"))
    next(steps)
    removed = []
    manager = SimpleNamespace(event_timer_remove=removed.append, progress_end=lambda: removed.append("progress"))
    context = SimpleNamespace(window_manager=manager, workspace=None)
    methods = {name: getattr(operator, name) for name in ("cancel", "_end")}
    rendering = type("Operator", (), {**methods, "_steps": steps, "_timer": "timer"})()
    rendering.cancel(context)
    assert fingerprint(blender) == before and list(tmp_path.iterdir()) == []
    assert removed == ["timer", "progress"]
    choosing = type("Operator", (), methods)()  # its file browser is closed before the capture starts
    choosing.cancel(context)
    assert removed == ["timer", "progress"]


def test_the_operator_has_the_defaults_of_the_settings(service, blender):
    properties = blender.ops.r5dgs.capture_dataset.get_rna_type().properties
    for field in dataclasses.fields(service.settings.CaptureSettings):
        name = field.name.removesuffix("_deg")
        default = getattr(properties[name], "default", None)
        if name not in ("directory", "frame_start", "frame_end"):
            expected = math.radians(field.default) if name != field.name else field.default
            assert default == pytest.approx(expected), name


# The bundled example


@pytest.mark.slow
def test_the_bundled_data_set_matches_its_script(service, blender, tmp_path):
    folder = Path(__file__).resolve().parents[3] / "examples"
    spec = importlib.util.spec_from_file_location("build_tabletop", folder / "build_tabletop.py")
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    script.build_tabletop()
    settings = dataclasses.replace(script.tabletop_settings(service.capture, tmp_path / "set"), samples=16)
    settings = dataclasses.replace(settings, denoise=False, frame_step=60, t_max=0.0, test_views=1, rig_novel=0)
    service.capture.capture(blender.context, settings)
    rebuilt, bundled = dataset.read(tmp_path / "set"), dataset.read(folder / "tabletop")
    assert rebuilt.object_names == bundled.object_names
    both = bundled.ground_truth.matrices[:, [0, -1]], rebuilt.ground_truth.matrices[:, [0, -1]]
    np.testing.assert_allclose(both[0], both[1], atol=1e-5)
    stored = {(view.camera.name, view.t): view for view in (*bundled.train, *bundled.test)}
    assert len(rebuilt.train) == 10 and len(rebuilt.test) == 1
    for view in (*rebuilt.train, *rebuilt.test):
        other = stored[view.camera.name, view.t]
        np.testing.assert_allclose(view.camera.T_cam_world, other.camera.T_cam_world, atol=1e-5)
        assert (dataset.load_mask(view) != dataset.load_mask(other)).mean() < 2e-3
        difference = dataset.load_image(view) - dataset.load_image(other)
        assert math.sqrt(np.square(difference).mean()) < 0.03  # the noise of 16 samples
