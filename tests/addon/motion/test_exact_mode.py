"""Exact Mode plays residual motion, from loading on, and leaves no traces when disabled."""

import importlib

import numpy as np
import pytest

from r5dgs_core.formats import ply
from r5dgs_core.motion import rotations
from r5dgs_core.playback import scene_player
from r5dgs_core.scene import scene_file
from tests.support import layouts, motions, tiny_datasets

TIMES = (0.0, 0.0437, 0.2, 0.3333, 0.61, tiny_datasets.T_MAX - 1e-4, tiny_datasets.T_MAX, 0.9)


@pytest.fixture
def scene_path(tmp_path):
    bending = tiny_datasets.breathing(tiny_datasets.make_truth(), 0.3)
    rng = np.random.default_rng(3)
    quats = rng.normal(scale=0.2, size=bending.residuals.quats.shape) + [1.0, 0, 0, 0]
    quats[:, -1] = [1.0, 0, 0, 0]
    turned = bending.with_arrays(residual_quats=rotations.normalize(quats).astype(np.float32))
    return scene_file.write(turned, tmp_path / "bending.r5dgs")


@pytest.fixture
def scene(scene_path):
    return scene_file.read(scene_path)


@pytest.fixture
def loaded(blender, scene_path):
    """The scene, loaded rigid."""
    return motions.load_again(blender, scene_path, bend=False)


def listeners():
    handlers = importlib.import_module("bpy").app.handlers
    every = handlers.frame_change_pre + handlers.frame_change_post
    return [f.__name__ for f in every if f.__module__.endswith("motion.exact_mode")]


def stored(cloud, name, field, width):
    values = np.empty(width * len(cloud.data.points), np.float32)
    cloud.data.attributes[name].data.foreach_get(field, values)
    return values.reshape(-1, width)


def state(collection):
    """Stored values of all points."""
    fields = (("position", "vector", 3), ("rotation", "value", 4), ("scale", "vector", 3))
    clouds = sorted((o for o in collection.all_objects if o.r5dgs.role == "CLOUD"), key=lambda o: o.name)
    return [stored(cloud, *field) for cloud in clouds for field in fields]


def assert_bends_like_the_core(bpy, collection, scene, times):
    motions.assert_plays_like_the_core(bpy, collection, scene, times)
    for t in times:
        motions.go_to(bpy, collection, t)
        frame = scene_player.Player(scene).frame(t)
        for cloud in (o for o in collection.all_objects if o.r5dgs.role == "CLOUD"):
            rows = slice(cloud.r5dgs.start, cloud.r5dgs.start + cloud.r5dgs.count)
            np.testing.assert_allclose(stored(cloud, "scale", "vector", 3), np.exp(frame.log_scales[rows]), rtol=1e-5)
            turn = rotations.rotmats_to_quats(motions.matrix(bpy, cloud)[:3, :3])
            quats = rotations.multiply(turn, stored(cloud, "rotation", "value", 4).astype(np.float64))
            off = rotations.angle_between(rotations.normalize(quats), frame.quats[rows].astype(np.float64))
            assert off.max() < 1e-3


def test_a_scene_that_bends_plays_like_the_core_when_loaded(blender, scene, scene_path):
    collection = motions.load(blender, scene_path)
    assert collection.r5dgs_exact.enabled and blender.context.scene.render.use_lock_interface
    assert_bends_like_the_core(blender, collection, scene, TIMES)


def test_keys_of_a_scene_that_bends_are_edited_as_those_of_others(blender, scene, scene_path, tmp_path):
    collection = motions.load(blender, scene_path)
    cloud = next(o for o in motions.clouds(collection) if o.r5dgs.start <= scene.residuals.rows[0])
    motions.go_to(blender, collection, 0.2)
    before, curve = motions.points(blender, cloud), next(iter(motions.curves(cloud.parent).values()), None)
    if curve is None:
        cloud.parent.keyframe_insert("location", index=0, frame=1)
        curve = motions.curves(cloud.parent)["location", 0]
    for key in curve.keyframe_points:
        for point in (key.co, key.handle_left, key.handle_right):
            point.y += 0.5
    motions.go_to(blender, collection, 0.5)
    motions.go_to(blender, collection, 0.2)
    moved = motions.points(blender, cloud) - before
    np.testing.assert_allclose(np.linalg.norm(moved, axis=-1), 0.5, atol=1e-4)
    np.testing.assert_allclose(exported(blender, cloud, tmp_path), motions.points(blender, cloud), atol=1e-5)


def test_a_cloud_without_residuals_is_not_read_at_frame_changes(blender, scene, scene_path, monkeypatch):
    collection = motions.load(blender, scene_path)
    points = motions.addon("motion.exact_points")
    own, read = points._rows, []
    monkeypatch.setattr(points, "_rows", lambda cloud: read.append(cloud.name) or own(cloud))
    for frame in (5, 9):
        blender.context.scene.frame_set(frame)
    bends = {c.data.name for c in motions.clouds(collection) if "bind_state:position" in c.data.attributes}
    assert bends and len(bends) < len(motions.clouds(collection)) and set(read) == bends
    rigid = next(c for c in motions.clouds(collection) if c.data.name not in bends)
    rigid.data.attributes["gaussian"].data[0].value = int(scene.residuals.rows[0])
    rigid.data.update_tag()
    blender.context.view_layer.update()
    motions.go_to(blender, collection, 0.2)
    assert "bind_state:position" in rigid.data.attributes


def test_exact_mode_can_be_off_without_handlers(blender, scene, loaded):
    assert not loaded.r5dgs_exact.enabled and not listeners()
    motions.go_to(blender, loaded, 0.2)
    with pytest.raises(AssertionError, match="t = 0.2"):
        motions.assert_plays_like_the_core(blender, loaded, scene, (0.2,))


def test_every_point_is_where_the_core_has_it_between_frames_too(blender, scene, loaded):
    assert blender.ops.r5dgs.exact_mode() == {"FINISHED"}
    assert len(listeners()) == 1 and blender.context.scene.render.use_lock_interface
    assert_bends_like_the_core(blender, loaded, scene, TIMES)


def test_switching_off_restores_every_bit(blender, loaded):
    motions.go_to(blender, loaded, 0.2)
    before = state(loaded)
    attributes = {o.name: set(o.data.attributes.keys()) for o in loaded.all_objects if o.type == "POINTCLOUD"}
    blender.ops.r5dgs.exact_mode(action="ON")
    bent = state(loaded)
    assert any((a != b).any() for a, b in zip(before, bent, strict=True))
    blender.ops.r5dgs.exact_mode(action="OFF")
    for a, b in zip(before, state(loaded), strict=True):
        np.testing.assert_array_equal(a, b)
    assert not listeners() and not blender.context.scene.render.use_lock_interface
    assert attributes == {o.name: set(o.data.attributes.keys()) for o in loaded.all_objects if o.type == "POINTCLOUD"}


def test_it_goes_on_after_saving_and_reloading_and_can_be_restored_without_the_file(
    blender, scene, scene_path, loaded, tmp_path
):
    before = state(loaded)
    blender.ops.r5dgs.exact_mode(action="ON")
    motions.go_to(blender, loaded, 0.3)
    blender.ops.wm.save_as_mainfile(filepath=str(tmp_path / "saved.blend"))
    blender.ops.wm.read_homefile(app_template="")
    assert not listeners()
    blender.ops.wm.open_mainfile(filepath=str(tmp_path / "saved.blend"))
    collection = next(c for c in blender.data.collections if c.r5dgs.is_scene)
    assert len(listeners()) == 1
    assert_bends_like_the_core(blender, collection, scene, (0.2, 0.61))
    scene_path.rename(tmp_path / "elsewhere.r5dgs")
    motions.go_to(blender, collection, 0.3)
    assert "bending.r5dgs" in collection.r5dgs_exact.problem
    blender.ops.r5dgs.exact_mode(action="OFF")
    for a, b in zip(before, state(collection), strict=True):
        np.testing.assert_array_equal(a, b)


def test_undo_and_redo_keep_points_and_listener_in_step(blender, scene, loaded):
    motions.go_to(blender, loaded, 0.2)
    blender.ops.ed.undo_push(message="before")
    blender.ops.ed.undo_push(message="before")
    name = loaded.name
    blender.ops.r5dgs.exact_mode(action="ON")
    blender.ops.ed.undo_push(message="Exact Mode")
    blender.ops.ed.undo()
    assert not listeners() and not blender.data.collections[name].r5dgs_exact.enabled
    blender.ops.ed.redo()
    assert len(listeners()) == 1
    assert_bends_like_the_core(blender, blender.data.collections[name], scene, (0.2, 0.3333))


def test_exact_mode_raises_for_a_rigid_scene(blender, tmp_path):
    motions.load(blender, scene_file.write(tiny_datasets.make_truth(), tmp_path / "rigid.r5dgs"))
    with pytest.raises(RuntimeError, match="all objects are rigid"):
        blender.ops.r5dgs.exact_mode()
    assert not listeners()


def test_deleted_points_leave_the_others_where_they_belong(blender, scene, loaded):
    cloud = next(o for o in loaded.all_objects if o.r5dgs.object_id == tiny_datasets.BALL and o.type == "POINTCLOUD")
    rows = np.flatnonzero(scene.gaussians.object_ids == tiny_datasets.BALL)
    keep = rows[::2]
    compat = motions.addon("compat")
    (fewer,) = compat.new_point_clouds([len(keep)])
    for name, kind, field, width in (
        ("position", "FLOAT_VECTOR", "vector", 3),
        ("rotation", "QUATERNION", "value", 4),
        ("scale", "FLOAT_VECTOR", "vector", 3),
    ):
        made = fewer.attributes.get(name) or fewer.attributes.new(name, kind, "POINT")
        made.data.foreach_set(field, stored(cloud, name, field, width)[::2].ravel())
    named = fewer.attributes.new("gaussian", "INT", "POINT")
    named.data.foreach_set("value", keep.astype(np.int32))
    cloud.data = fewer
    blender.ops.r5dgs.exact_mode(action="ON")
    motions.go_to(blender, loaded, 0.3)
    expected = scene_player.Player(scene).frame(0.3).means[keep]
    np.testing.assert_allclose(motions.points(blender, cloud), expected, atol=1e-5 * scene.extent)


@pytest.fixture
def bending(loaded, scene):
    """The cloud that bends."""
    every = (o for o in loaded.all_objects if o.r5dgs.role == "CLOUD")
    return next(o for o in every if o.r5dgs.start <= scene.residuals.rows[0] < o.r5dgs.start + o.r5dgs.count)


def seen(bpy, cloud):
    """World positions of the points in the viewport. [n, 3]"""
    evaluated = cloud.evaluated_get(bpy.context.evaluated_depsgraph_get())
    points = np.empty(3 * len(evaluated.data.points), np.float32)
    evaluated.data.attributes["position"].data.foreach_get("vector", points)
    matrix = np.array(evaluated.matrix_world, np.float64)
    return points.reshape(-1, 3) @ matrix[:3, :3].T + matrix[:3, 3]


def exported(bpy, cloud, folder):
    """Exported centres of a cloud, from the scene file. [n, 3]"""
    for other in bpy.context.selected_objects:
        other.select_set(False)
    cloud.select_set(True)
    bpy.ops.r5dgs.export_ply(filepath=str(folder / "a.ply"), which="SELECTED")
    return ply.read(folder / "a.ply").means


def apply_transform(bpy, cloud):
    for other in bpy.context.selected_objects:
        other.select_set(False)
    cloud.select_set(True)
    bpy.context.view_layer.objects.active = cloud
    assert bpy.ops.object.transform_apply(location=True, rotation=True, scale=True) == {"FINISHED"}


@pytest.mark.parametrize("first", (False, True))
def test_apply_transform_turns_what_bends_with_the_object(blender, loaded, bending, tmp_path, first):
    motions.go_to(blender, loaded, 0.2)
    if first:
        blender.ops.r5dgs.exact_mode(action="ON")
    bending.location, bending.rotation_euler, bending.scale = (0.3, -0.2, 0.1), (0.5, 0.6, -0.7), (1.2, 1.2, 1.2)
    blender.context.view_layer.update()
    before = exported(blender, bending, tmp_path)
    apply_transform(blender, bending)
    if not first:
        blender.ops.r5dgs.exact_mode(action="ON")
        assert np.abs(exported(blender, bending, tmp_path) - before).max() > 1e-3  # it did not bend before
    else:
        np.testing.assert_allclose(exported(blender, bending, tmp_path), before, atol=1e-5)
    np.testing.assert_allclose(exported(blender, bending, tmp_path), seen(blender, bending), atol=1e-5)
    motions.go_to(blender, loaded, 0.5)
    motions.go_to(blender, loaded, 0.2)
    np.testing.assert_allclose(exported(blender, bending, tmp_path), seen(blender, bending), atol=1e-5)
    if first:
        np.testing.assert_allclose(seen(blender, bending), before, atol=1e-5)


def test_edits_of_points_stay_at_other_frames_and_when_it_is_off(blender, loaded, bending, tmp_path):
    blender.ops.r5dgs.exact_mode(action="ON")
    motions.go_to(blender, loaded, 0.2)
    before = stored(bending, "position", "vector", 3)
    sizes = stored(bending, "scale", "vector", 3)
    for point in list(bending.data.points)[::3]:
        point.co = (point.co[0] + 0.5, point.co[1], point.co[2])
    bending.data.attributes["scale"].data[1].vector = (0.1, 0.2, 0.3)
    moved = before.copy()
    moved[::3, 0] += 0.5
    sizes[1] = (0.1, 0.2, 0.3)
    np.testing.assert_allclose(exported(blender, bending, tmp_path), seen(blender, bending), atol=1e-5)
    motions.go_to(blender, loaded, 0.5)
    motions.go_to(blender, loaded, 0.2)
    np.testing.assert_allclose(stored(bending, "position", "vector", 3), moved, atol=1e-6)
    np.testing.assert_allclose(stored(bending, "scale", "vector", 3), sizes, rtol=1e-5)
    motions.go_to(blender, loaded, tiny_datasets.T_MAX)
    there = stored(bending, "position", "vector", 3)
    blender.ops.r5dgs.exact_mode(action="OFF")
    np.testing.assert_allclose(stored(bending, "position", "vector", 3), there, atol=1e-6)
    np.testing.assert_allclose(exported(blender, bending, tmp_path), seen(blender, bending), atol=1e-5)


@pytest.mark.parametrize("link", [False, True])
def test_a_scene_that_bends_goes_on_bending_where_it_is_appended(blender, scene, scene_path, tmp_path, link):
    collection = motions.load(blender, scene_path)
    collection.asset_mark()
    motions.go_to(blender, collection, 0.3)
    name, blend = collection.name, tmp_path / "library.blend"
    blender.ops.wm.save_as_mainfile(filepath=str(blend))
    blender.ops.wm.read_homefile(app_template="")
    assert not listeners()
    bring = blender.ops.wm.link if link else blender.ops.wm.append
    bring(
        filepath=f"{blend}/Collection/{name}", directory=f"{blend}/Collection/", filename=name,
        instance_collections=link,
    )  # fmt: skip
    blender.context.view_layer.update()
    own = next(one for one in blender.data.collections if one.r5dgs.is_scene)
    assert own.r5dgs_exact.enabled and len(listeners()) == 1
    motions.go_to(blender, own, 0.2)
    drawn = motions.addon("engine.visible_clouds").instances(blender.context.evaluated_depsgraph_get())[1]
    assert drawn and all(one.t == pytest.approx(0.2, abs=1e-5) for one in drawn)
    if link:
        panel = importlib.import_module("r5dgs.r5dgs_addon.panels.motion").R5DGS_PT_all_motions
        assert any("Linked points do not bend" in line for line in layouts.draw(blender, panel))
    else:
        assert_bends_like_the_core(blender, own, scene, (0.2, 0.61))
