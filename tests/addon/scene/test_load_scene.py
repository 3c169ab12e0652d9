"""A loaded scene is the core's playback, made of ordinary Blender objects."""

import dataclasses
import importlib
from pathlib import Path

import numpy as np
import pytest

from r5dgs_core import errors
from r5dgs_core.motion import models, se3
from r5dgs_core.playback import scene_player
from r5dgs_core.scene import scene_file
from tests.support import motions, scenes

KINDS = ("collections", "objects", "pointclouds", "actions", "materials", "node_groups")


@pytest.fixture
def scene_path(tmp_path):
    return scene_file.write(scenes.make_scene(n=400, objects=5, sh_degree=1, seed=1), tmp_path / "synthetic.r5dgs")


def drawn_scenes():
    """`tests.support.tiny_datasets`, which draws with torch; a Blender may lack that."""
    pytest.importorskip("torch", reason="torch is not installed here")
    return importlib.import_module("tests.support.tiny_datasets")


def anchor_of(collection, name):
    cloud = next(obj for obj in motions.clouds(collection) if obj.name.split(".")[0] == name)
    return cloud.parent


def attribute(cloud, name, field, width):
    values = np.empty(width * len(cloud.data.points), np.float32)
    cloud.data.attributes[name].data.foreach_get(field, values)
    return values.reshape(-1, width)


TIMES = (0.0, 0.013, 0.22, 0.3334, 0.61, 0.7499, scenes.T_MAX, 0.7507, 0.8, 0.9111, 1.0)


@pytest.mark.parametrize("convention", ["blender", "colmap", "opengl"])
def test_points_match_playback_at_any_time(blender, tmp_path, convention):
    scene = scenes.make_scene(n=300, objects=5, world_convention=convention)
    path = scene_file.write(scene, tmp_path / "scene.r5dgs")
    motions.assert_plays_like_the_core(blender, motions.load(blender, path), scene_file.read(path), TIMES)


def test_loading_warns_of_deformation_that_it_does_not_play(blender, tmp_path, capfd):
    datasets = drawn_scenes()
    scene = datasets.make_truth()
    bending = datasets.breathing(scene, 0.3)
    for name, wanted in (("rigid", scene), ("bending", bending)):
        path = scene_file.write(wanted, tmp_path / f"{name}.r5dgs")
        motions.load(blender, path)
        assert "Gaussians bend" not in capfd.readouterr().out
        motions.load(blender, path, bend=False)
        warned = f"{len(bending.residuals.rows)} Gaussians bend" in capfd.readouterr().out
        assert warned == (name == "bending")


def test_frame_mapping_and_later_horizon_keep_playback(blender, scene_path):
    collection = motions.load(blender, scene_path, frame_zero=-7.5, t_end=1.6)
    motions.assert_plays_like_the_core(blender, collection, scene_file.read(scene_path), (*TIMES, 1.333, 1.6))


def test_far_from_the_origin_playback_still_holds(blender, tmp_path):
    scene = scenes.make_scene(n=300, objects=3)
    shift = np.array([40.0, -25.0, 3.0])
    groups = tuple(dataclasses.replace(g, pivot=g.pivot + shift) for g in scene.groups)
    far = dataclasses.replace(
        scene.with_arrays(means=(scene.gaussians.means + shift).astype(np.float32)), groups=groups
    )
    path = scene_file.write(far, tmp_path / "far.r5dgs")
    motions.assert_plays_like_the_core(blender, motions.load(blender, path), scene_file.read(path), TIMES)


def test_noisy_tracks_get_one_key_per_knot_and_play_exactly(blender, tmp_path):
    scene = scenes.make_scene(n=200, objects=2)
    rng = np.random.default_rng(5)
    poses = scene.tracks.poses.copy()
    poses[1:, :-1] += rng.normal(scale=2e-3, size=poses[1:, :-1].shape)
    poses[..., :4] /= np.linalg.norm(poses[..., :4], axis=-1, keepdims=True)
    path = scene_file.write(scene.with_arrays(track_poses=poses), tmp_path / "noisy.r5dgs")
    scene = scene_file.read(path)
    collection = motions.load(blender, path)
    motions.assert_plays_like_the_core(blender, collection, scene, TIMES)
    frames = [round(p.co[0], 3) for p in curves_of(anchor_of(collection, "mug"))[("location", 0)].keyframe_points]
    assert set(np.round(1 + 60 * scene.tracks.times, 3).astype(np.float32)) <= set(np.float32(frames))


def test_the_collection_tree_is_the_table(blender, scene_path):
    scene = scene_file.read(scene_path)
    collection = motions.load(blender, scene_path)
    assert collection.name == "R5DGS synthetic"
    assert {child.name for child in collection.children} == {"Cameras", *(item.name for item in scene.objects)}
    for item in scene.objects:
        inside = list(collection.children[item.name].objects)
        cloud = next(obj for obj in inside if obj.name == item.name)
        assert cloud.type == "POINTCLOUD" and cloud.parent in inside
        assert cloud.parent.type == "EMPTY" and cloud.parent.parent == collection.r5dgs.root
        assert len(inside) == 2
    (fringe,) = collection.children["background"].children
    assert fringe.name == "background fringe"
    assert {obj.name for obj in fringe.objects} == {"mug shadow anchor", "mug shadow"}
    assert sum(len(obj.data.points) for obj in motions.clouds(collection)) == len(scene.gaussians.means)
    assert [entry.name for entry in collection.r5dgs.table] == [item.name for item in scene.objects]


def test_points_carry_the_files_gaussians_under_the_native_names(blender, scene_path):
    scene = scene_file.read(scene_path)
    for obj in motions.clouds(motions.load(blender, scene_path)):
        rows = slice(obj.r5dgs.start, obj.r5dgs.start + obj.r5dgs.count)
        np.testing.assert_array_equal(attribute(obj, "position", "vector", 3), scene.gaussians.means[rows])
        np.testing.assert_allclose(
            attribute(obj, "scale", "vector", 3), np.exp(scene.gaussians.log_scales[rows]), rtol=1e-6
        )
        np.testing.assert_array_equal(attribute(obj, "rotation", "value", 4), scene.gaussians.quats[rows])
        base = attribute(obj, "radiance:base", "color", 4)
        np.testing.assert_array_equal(base[:, :3], scene.gaussians.sh[rows, 0])
        np.testing.assert_allclose(base[:, 3], 1 / (1 + np.exp(-scene.gaussians.opacity_logits[rows])), rtol=1e-5)
        np.testing.assert_array_equal(attribute(obj, "radiance:sh_2", "vector", 3), scene.gaussians.sh[rows, 3])
        assert "radiance:sh_3" not in obj.data.attributes and "color" not in obj.data.attributes
        ids = np.empty(obj.r5dgs.count, np.int32)
        obj.data.attributes["object_id"].data.foreach_get("value", ids)
        np.testing.assert_array_equal(ids, scene.gaussians.object_ids[rows])
        obj.data.attributes["gaussian"].data.foreach_get("value", ids)
        np.testing.assert_array_equal(ids, np.arange(rows.start, rows.stop))


def test_loading_leaves_no_temporary_data(blender, scene_path):
    before = len(blender.data.objects), len(blender.data.pointclouds)
    collection = motions.load(blender, scene_path)
    assert len(blender.data.scenes) == 1 and [tree.name for tree in blender.data.node_groups] == ["R5DGS Splats"]
    assert len(blender.data.objects) == before[0] + len(collection.all_objects)
    assert len(blender.data.pointclouds) == before[1] + len(motions.clouds(collection))


@pytest.mark.parametrize("degree, kept", [("0", 0), ("1", 3), ("2", 8), ("3", 15), ("ALL", 15)])
def test_only_harmonics_up_to_the_chosen_degree_are_stored(blender, tmp_path, degree, kept):
    scene = scenes.make_scene(n=5000, objects=2, sh_degree=3)
    path = scene_file.write(scene, tmp_path / "scene.r5dgs")
    stored = scene_file.read(path)
    for obj in motions.clouds(motions.load(blender, path, sh_degree=degree)):
        names = {a.name for a in obj.data.attributes if a.name.startswith("radiance:sh_")}
        assert names == {f"radiance:sh_{k}" for k in range(kept)}
        for k in range(kept):
            rows = slice(obj.r5dgs.start, obj.r5dgs.start + obj.r5dgs.count)
            found = attribute(obj, f"radiance:sh_{k}", "vector", 3)
            np.testing.assert_array_equal(found, stored.gaussians.sh[rows, k + 1])


def curves_of(anchor):
    compat = importlib.import_module("r5dgs.r5dgs_addon.compat")
    return {(fcurve.data_path, fcurve.array_index): fcurve for fcurve in compat.fcurves(anchor)}


def test_keys_past_t_max_are_of_another_type_and_t_max_has_a_key(blender, scene_path):
    collection = motions.load(blender, scene_path)
    frame_of_t_max = 1 + 60 * scenes.T_MAX
    for fcurve in curves_of(anchor_of(collection, "mug")).values():
        frames = np.array([point.co[0] for point in fcurve.keyframe_points])
        assert np.isclose(frames, frame_of_t_max).any()
        assert (frames > frame_of_t_max + 1e-3).any()
        for point in fcurve.keyframe_points:
            later = point.co[0] > frame_of_t_max + 1e-3
            assert point.type == ("EXTREME" if later else "KEYFRAME")
            assert point.interpolation == "BEZIER" and point.handle_left_type == "FREE"


def test_only_moving_objects_have_curves(blender, scene_path):
    collection = motions.load(blender, scene_path)
    assert not curves_of(anchor_of(collection, "background"))
    assert not curves_of(anchor_of(collection, "wooden block"))
    assert {path for path, _ in curves_of(anchor_of(collection, "red apple"))} == {"location"}  # it slides
    assert {path for path, _ in curves_of(anchor_of(collection, "mug shadow"))} == {"location"}
    assert {path for path, _ in curves_of(anchor_of(collection, "mug"))} == {"location", "rotation_quaternion"}


def test_a_uniform_translation_has_two_keys(blender, tmp_path):
    truth = drawn_scenes().make_truth()
    slide = models.MotionModel("translation", velocity=[0.9, 0.35, 0.0], radius=0.5)
    poses = truth.tracks.poses.copy()
    poses[:, :, :] = [1.0, 0, 0, 0, 0, 0, 0]
    poses[1, :, 4:] = slide.velocity * (truth.tracks.times - truth.t_max)[:, None]
    still = dataclasses.replace(truth.groups[2], model=models.STATIC)
    groups = (truth.groups[0], dataclasses.replace(truth.groups[1], model=slide), still)
    sliding = dataclasses.replace(truth.with_arrays(track_poses=poses), groups=groups)
    collection = motions.load(blender, scene_file.write(sliding, tmp_path / "sliding.r5dgs"))
    curves = curves_of(anchor_of(collection, "brick"))
    assert {path for path, _ in curves} == {"location"}
    assert [len(curves["location", axis].keyframe_points) for axis in range(3)] == [2, 2, 1]  # it does not rise
    assert not curves_of(anchor_of(collection, "ball"))
    motions.assert_plays_like_the_core(blender, collection, sliding, np.linspace(0.0, 1.0, 9))


def test_a_larger_tolerance_gives_fewer_keys_within_the_tolerance(blender, scene_path):
    scene = scene_file.read(scene_path)
    counts = {}
    for tolerance in (3e-6, 1e-3):
        collection = motions.load(blender, scene_path, key_tolerance=tolerance)
        counts[tolerance] = sum(
            len(fcurve.keyframe_points)
            for obj in collection.all_objects
            if obj.r5dgs.role == "ANCHOR"
            for fcurve in curves_of(obj).values()
        )
        for t in TIMES:
            motions.go_to(blender, collection, t)
            points = motions.all_points(blender, collection, len(scene.gaussians.means))
            distance = np.linalg.norm(points - scene_player.Player(scene).frame(t).means, axis=-1)
            assert distance.max() <= (tolerance + 2e-6) * scene.extent
    assert counts[1e-3] < 0.7 * counts[3e-6]


def test_the_timeline_is_fitted_and_t_max_marked(blender, scene_path):
    motions.load(blender, scene_path)
    scene = blender.context.scene
    assert (scene.frame_start, scene.frame_end) == (1, 61)
    assert [(marker.name, marker.frame) for marker in scene.timeline_markers] == [("t_max", 46)]


def test_the_timeline_is_kept_on_request(blender, scene_path):
    scene = blender.context.scene
    before = (scene.frame_start, scene.frame_end)
    motions.load(blender, scene_path, fit_timeline=False)
    assert (scene.frame_start, scene.frame_end) == before and not scene.timeline_markers


def test_moving_an_anchors_parent_moves_its_points(blender, scene_path):
    collection = motions.load(blender, scene_path)
    motions.go_to(blender, collection, 0.4)
    n = collection.r5dgs.gaussians
    before = motions.all_points(blender, collection, n)
    collection.r5dgs.root.location = (1, 2, 3)
    blender.context.view_layer.update()
    np.testing.assert_allclose(motions.all_points(blender, collection, n), before + [1, 2, 3], atol=1e-5)


def test_saving_reloading_and_scrubbing_keeps_everything(blender, scene_path, tmp_path):
    scene = scene_file.read(scene_path)
    motions.load(blender, scene_path)
    blend = tmp_path / "deeper" / "saved.blend"
    blend.parent.mkdir()
    blender.ops.wm.save_as_mainfile(filepath=str(blend))
    blender.ops.wm.read_homefile(app_template="")
    blender.ops.wm.open_mainfile(filepath=str(blend))
    collection = next(c for c in blender.data.collections if c.r5dgs.is_scene)
    motions.assert_plays_like_the_core(blender, collection, scene, TIMES)
    assert collection.r5dgs.filepath == "//../synthetic.r5dgs"
    assert [alias.name for alias in collection.r5dgs.table["mug"].aliases] == ["cup"]


def open_path(bpy):
    collection = next(c for c in bpy.data.collections if c.r5dgs.is_scene)
    return Path(bpy.path.abspath(collection.r5dgs.filepath))


def test_a_saved_copy_and_the_open_file_both_find_the_scene(blender, scene_path, tmp_path):
    motions.load(blender, scene_path)
    near, far = tmp_path / "near.blend", tmp_path / "deep" / "er" / "copy.blend"
    far.parent.mkdir(parents=True)
    blender.ops.wm.save_as_mainfile(filepath=str(far), copy=True)  # from a file that was never saved
    assert open_path(blender) == scene_path
    blender.ops.wm.save_as_mainfile(filepath=str(near))
    blender.ops.wm.save_as_mainfile(filepath=str(far), copy=True)
    assert open_path(blender) == scene_path
    blender.ops.wm.save_mainfile()
    for blend in (near, far):
        blender.ops.wm.open_mainfile(filepath=str(blend))
        assert open_path(blender).resolve() == scene_path.resolve(), blend


def test_a_save_that_failed_changes_no_path(blender, scene_path, tmp_path):
    collection = motions.load(blender, scene_path)
    blender.ops.wm.save_as_mainfile(filepath=str(tmp_path / "open.blend"))
    with pytest.raises(RuntimeError):
        blender.ops.wm.save_as_mainfile(filepath=str(tmp_path / "absent" / "open.blend"))
    assert collection.r5dgs.filepath == "//synthetic.r5dgs"


def test_one_undo_removes_the_whole_scene_and_redo_restores_it(blender, scene_path):
    blender.ops.ed.undo_push(message="before")
    names = {kind: {data.name for data in getattr(blender.data, kind)} for kind in KINDS}
    range_before = blender.context.scene.frame_end
    motions.load(blender, scene_path)
    blender.ops.ed.undo_push(message="Load Scene")  # the window does this after an operator of the user
    blender.ops.ed.undo()
    assert {kind: {data.name for data in getattr(blender.data, kind)} for kind in KINDS} == names
    assert blender.context.scene.frame_end == range_before
    blender.ops.ed.redo()
    collection = next(c for c in blender.data.collections if c.r5dgs.is_scene)
    motions.assert_plays_like_the_core(blender, collection, scene_file.read(scene_path), (0.3, 0.9))


def test_two_loads_are_independent(blender, scene_path):
    first, second = motions.load(blender, scene_path), motions.load(blender, scene_path)
    scene = scene_file.read(scene_path)
    for obj in list(first.all_objects):
        blender.data.objects.remove(obj)
    motions.assert_plays_like_the_core(blender, second, scene, (0.3, 0.9))


def damaged(path, tmp_path, kind):
    data = path.read_bytes()
    bad = tmp_path / f"{kind}.r5dgs"
    if kind == "truncated":
        bad.write_bytes(data[: len(data) // 2])
    elif kind == "foreign":
        bad.write_bytes(b"ply\nformat ascii 1.0\n")
    elif kind == "empty":
        bad.write_bytes(b"")
    return bad


@pytest.mark.parametrize("kind", ["truncated", "foreign", "empty", "missing"])
def test_bad_files_are_refused_by_name_and_leave_nothing_behind(blender, scene_path, tmp_path, kind):
    before = {name: set(getattr(blender.data, name)) for name in KINDS}
    with pytest.raises(RuntimeError, match=f"{kind}.r5dgs"):
        blender.ops.r5dgs.load_scene(filepath=str(damaged(scene_path, tmp_path, kind)))
    assert {name: set(getattr(blender.data, name)) for name in KINDS} == before


def test_an_error_half_way_leaves_nothing_behind(blender, scene_path, monkeypatch):
    clouds_module = importlib.import_module("r5dgs.r5dgs_addon.scene.point_clouds")
    fill, filled = clouds_module.fill, []

    def fill_three(*arguments):
        if len(filled) == 3:
            raise errors.SceneFileError("synthetic.r5dgs: broken on purpose")
        filled.append(fill(*arguments))

    monkeypatch.setattr(clouds_module, "fill", fill_three)
    before = {name: {data.session_uid for data in getattr(blender.data, name)} for name in KINDS}
    with pytest.raises(RuntimeError, match="broken on purpose"):
        blender.ops.r5dgs.load_scene(filepath=str(scene_path))
    assert {name: {data.session_uid for data in getattr(blender.data, name)} for name in KINDS} == before
    assert not blender.context.scene.timeline_markers


def test_the_light_is_left_alone_a_scene_renders_in_its_own_colours(blender, scene_path, tmp_path):
    collection = motions.load(blender, scene_path)
    material = motions.clouds(collection)[0].data.materials[0]
    kinds = {node.bl_idname for node in material.node_tree.nodes}
    assert kinds == {"ShaderNodeAttribute", "ShaderNodeEmission", "ShaderNodeOutputMaterial"}
    shown = attribute(motions.clouds(collection)[1], "display_color", "color", 4)
    assert shown.min() >= 0 and shown.max() <= 1


def test_registering_twice_in_a_row_is_clean(blender, extension):
    for _ in range(2):
        extension.unregister()
        assert "load_scene" not in dir(blender.ops.r5dgs)
        assert not hasattr(blender.types.Object, "r5dgs")
        extension.register()
    assert "load_scene" in dir(blender.ops.r5dgs)


def test_an_anchor_stays_with_its_own_object_if_others_move_with_it(blender, tmp_path):
    scene = scenes.make_scene(n=400, objects=3)
    motion_ids, object_ids = scene.gaussians.motion_ids.copy(), scene.gaussians.object_ids.copy()
    floor = np.flatnonzero((object_ids == 0) & (motion_ids == 0))
    motion_ids[floor[-5:]] = 2  # labelled background, moving with the apple
    motion_ids[np.flatnonzero(object_ids == 3)[-4:]] = 0  # of the car, standing still
    order = np.lexsort((motion_ids, object_ids))
    fields = ("means", "quats", "log_scales", "opacity_logits", "sh", "identities", "shading")
    arrays = {name: scene.arrays()[name][order] for name in fields}
    scene = scene.with_arrays(**arrays, motion_ids=motion_ids[order], object_ids=object_ids[order])
    path = scene_file.write(scene, tmp_path / "mixed.r5dgs")
    collection = motions.load(blender, path)
    motions.assert_plays_like_the_core(blender, collection, scene_file.read(path), (0.2, 0.9))
    by_name = {obj.name: obj for obj in collection.all_objects}
    assert by_name["red apple anchor"].users_collection[0].name == "red apple"
    assert by_name["background with red apple"].parent == by_name["red apple anchor"] == by_name["red apple"].parent
    assert by_name["toy car still"].parent == by_name["toy car still anchor"]
    assert by_name["toy car"].parent == by_name["toy car anchor"]


def wild_scene(path, model, bodies=1, **changes):
    """A file of bodies that all go on by one motion past t_max."""
    scene = scenes.make_scene(n=20 * bodies + 40, objects=bodies, shadows=False, shading=False, identities=False)
    groups = (scene.groups[0], *(dataclasses.replace(group, model=model) for group in scene.groups[1:]))
    table = [dataclasses.replace(item, name=f"{item.name} {item.id}", aliases=()) for item in scene.objects]
    return scene_file.write(dataclasses.replace(scene, groups=groups, objects=tuple(table), **changes), path)


TILTING = models.MotionModel(
    "world_twist", velocity=[1, 0, 0], angular_velocity=[1e4, 0, 2], angular_acceleration=[0, 1.5, 0], radius=0.3
)


@pytest.mark.default_cases("1-60.0", "1-1000000.0", "1-1e-06")
@pytest.mark.parametrize("bodies, frames_per_unit", [(1, 60.0), (1, 1e6), (1, 1e-6), (100, 60.0)])
def test_a_small_file_never_blocks_blender(blender, tmp_path, monkeypatch, capfd, bodies, frames_per_unit):
    path = wild_scene(tmp_path / "wild.r5dgs", TILTING, bodies, frames_per_unit=frames_per_unit)
    steps, exp = [0], se3.exp

    def counted(w, v):
        steps[0] += w.size // 3
        return exp(w, v)

    monkeypatch.setattr(se3, "exp", counted)
    loaded = motions.load(blender, path)
    assert steps[0] < 1 << 24
    anchors = [obj for obj in loaded.all_objects if obj.r5dgs.role == "ANCHOR" and obj.r5dgs.motion_id]
    keys = max(len(curve.keyframe_points) for anchor in anchors for curve in motions.curves(anchor).values())
    assert keys <= (1 << 15) + len(scenes.TIMES)
    assert all(anchor.r5dgs_motion.too_fast for anchor in anchors) == (frames_per_unit < 1e6)
    said = capfd.readouterr().out
    assert ("because the motion is too fast" in said) == (frames_per_unit < 1e6)
    assert ("and 95 more" in said) == (bodies == 100)


def test_frames_past_the_last_one_of_blender_are_refused_by_name(blender, tmp_path):
    path = wild_scene(tmp_path / "wild.r5dgs", models.STATIC, frames_per_unit=1e9)
    with pytest.raises(RuntimeError, match=r"observed times: expected frames up to 1,048,574.*found 7.5e\+08"):
        blender.ops.r5dgs.load_scene(filepath=str(path))
    path = wild_scene(tmp_path / "wild.r5dgs", models.STATIC, frames_per_unit=1.2e6)
    with pytest.raises(RuntimeError, match="extrapolated times: .*choose an earlier end"):
        blender.ops.r5dgs.load_scene(filepath=str(path))
    assert not blender.data.objects.get("synthetic root")
