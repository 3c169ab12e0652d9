"""Selection, deletion and assignment of single Gaussians in Blender, and what export and renders make of them."""

import numpy as np
import pytest

from r5dgs_core.playback import scene_player
from r5dgs_core.scene import scene_file
from tests.support import motions, tiny_datasets


@pytest.fixture
def scene(scene_path):
    return scene_file.read(scene_path)


def cloud_of(collection, object_id):
    """Largest cloud of an object."""
    found = [one for one in motions.clouds(collection) if one.r5dgs.object_id == object_id]
    return max(found, key=lambda one: len(one.data.points))


def rows(cloud):
    """Rows of the points of a cloud in the scene file."""
    found = np.empty(len(cloud.data.points), np.int32)
    cloud.data.attributes["gaussian"].data.foreach_get("value", found)
    return found


def all_rows(collection):
    return np.sort(np.concatenate([rows(cloud) for cloud in motions.clouds(collection)]))


def mark(cloud, chosen):
    points = motions.addon("clean_up.selected_points")
    points.store(cloud.data, np.asarray(chosen))


def count(collection):
    return motions.addon("clean_up.selected_points").count(collection)


def exported(bpy, path):
    assert bpy.ops.r5dgs.export_scene(filepath=str(path)) == {"FINISHED"}
    return scene_file.read(path)


def test_floaters_are_those_of_the_criteria(blender, loaded, scene):
    state = loaded.r5dgs_clean_up
    opacities = 1 / (1 + np.exp(-scene.gaussians.opacity_logits.astype(np.float64)))
    state.by_size = state.by_isolation = state.by_distance = False
    state.opacity = float(np.quantile(opacities, 0.3))
    assert blender.ops.r5dgs.select_floaters() == {"FINISHED"}
    assert count(loaded) == (opacities < state.opacity).sum() > 0
    state.live = True
    state.opacity = float(np.quantile(opacities, 0.1))
    assert count(loaded) == (opacities < state.opacity).sum() > 0
    state.by_opacity, state.by_distance, state.distance = False, True, 130.0
    expected = 0
    for object_id in np.unique(scene.gaussians.object_ids):
        means = scene.gaussians.means[scene.gaussians.object_ids == object_id].astype(np.float64)
        arms = np.linalg.norm(means - np.median(means, axis=0), axis=1)
        expected += (arms > 1.3 * np.quantile(arms, 0.9)).sum()
    assert count(loaded) == expected > 0


def test_criteria_of_selected_objects_leave_the_others(blender, loaded):
    state = loaded.r5dgs_clean_up
    mug = cloud_of(loaded, 1)
    motions.choose(blender, mug)
    state.scope, state.opacity = "SELECTED", 1.0
    blender.ops.r5dgs.select_floaters()
    own = [one for one in motions.clouds(loaded) if one.r5dgs.object_id == 1]
    assert count(loaded) == sum(len(one.data.points) for one in own)


def test_the_crop_box_selects_outside_and_inside(blender, loaded):
    state = loaded.r5dgs_clean_up
    state.by_opacity = state.by_size = state.by_isolation = state.by_distance = False
    assert blender.ops.r5dgs.add_crop_box() == {"FINISHED"}
    box = state.box
    box.scale = np.array(box.scale) * 0.5
    box.rotation_euler = (0.3, 0.2, 0.5)
    blender.context.view_layer.update()
    inside = 0
    for cloud in motions.clouds(loaded):
        own = np.linalg.inv(motions.matrix(blender, box))
        places = motions.points(blender, cloud) @ own[:3, :3].T + own[:3, 3]
        inside += (np.abs(places) <= 1).all(1).sum()
    blender.ops.r5dgs.select_floaters()
    total = len(all_rows(loaded))
    assert 0 < count(loaded) == total - inside < total
    state.side = "INSIDE"
    blender.ops.r5dgs.select_floaters()
    assert count(loaded) == inside
    box.scale = (0, 1, 1)
    with pytest.raises(RuntimeError, match="R5DGS Crop Box.*scale of 0"):
        blender.ops.r5dgs.select_floaters()


def test_a_missing_box_is_reported_in_the_live_selection_too(blender, loaded):
    loaded.r5dgs_clean_up.by_box = True
    with pytest.raises(RuntimeError, match="Add Crop Box"):
        blender.ops.r5dgs.select_floaters()
    loaded.r5dgs_clean_up.live = True
    assert "Add Crop Box" in loaded.r5dgs_clean_up.problem
    loaded.r5dgs_clean_up.by_box = False
    assert not loaded.r5dgs_clean_up.problem


def test_deleted_gaussians_are_gone_in_the_export_and_the_others_unchanged(blender, loaded, scene, tmp_path):
    mug = cloud_of(loaded, 1)
    gone = rows(mug)[::3]
    mark(mug, np.isin(rows(mug), gone))
    assert blender.ops.r5dgs.delete_gaussians() == {"FINISHED"}
    kept = np.setdiff1d(np.arange(len(scene.gaussians.means)), gone)
    np.testing.assert_array_equal(all_rows(loaded), kept)
    found = exported(blender, tmp_path / "fewer.r5dgs")
    assert len(found.gaussians.means) == len(kept)
    for t in (0.2, 0.9):
        motions.go_to(blender, loaded, t)
        np.testing.assert_allclose(
            np.sort(scene_player.Player(found).frame(t).means, axis=0),
            np.sort(scene_player.Player(scene).frame(t).means[kept], axis=0), atol=1e-5 * scene.extent,
        )  # fmt: skip
    edits = motions.addon("scene.evaluated_points")
    edit = edits.of(mug, blender.context.evaluated_depsgraph_get(), loaded.r5dgs.gaussians).edit
    assert set(edit.arrays()) == {"rows"}  # values still come from the file


def test_a_cloud_whose_gaussians_are_all_deleted_is_removed(blender, loaded, tmp_path):
    clouds = [one for one in motions.clouds(loaded) if one.r5dgs.object_id == 2]
    names = [(one.name, one.data.name) for one in clouds]
    for cloud in clouds:
        mark(cloud, np.ones(len(cloud.data.points), bool))
    blender.ops.r5dgs.delete_gaussians()
    assert not any(name in blender.data.objects or data in blender.data.pointclouds for name, data in names)
    assert 2 not in exported(blender, tmp_path / "without.r5dgs").gaussians.object_ids


def test_undo_and_redo_of_every_step(blender, loaded):
    name = loaded.name
    total = len(all_rows(loaded))

    def state():
        collection = blender.data.collections[name]
        ids = {one.r5dgs.object_id for one in motions.clouds(collection) if " from " in one.name}
        return len(all_rows(collection)), count(collection), collection.r5dgs_clean_up.box is not None, ids

    def active():
        motions.choose(blender, cloud_of(blender.data.collections[name], 1))

    steps = (
        lambda: blender.ops.r5dgs.select_floaters(),
        lambda: blender.ops.r5dgs.select_gaussians(action="INVERT"),
        lambda: blender.ops.r5dgs.add_crop_box(),
        lambda: (active(), blender.ops.r5dgs.assign_gaussians()),
        lambda: blender.ops.r5dgs.select_floaters(mode="ADD"),
        lambda: blender.ops.r5dgs.delete_gaussians(),
    )
    loaded.r5dgs_clean_up.opacity = 0.4
    blender.ops.ed.undo_push(message="loaded")
    states = [state()]
    for number, step in enumerate(steps):
        step()
        blender.ops.ed.undo_push(message=f"step {number}")
        states.append(state())
    assert len(set(map(str, states))) == len(states) and states[-1][0] < total
    for expected in reversed(states[:-1]):
        blender.ops.ed.undo()
        assert state() == expected
    for expected in states[1:]:
        blender.ops.ed.redo()
        assert state() == expected


@pytest.mark.parametrize("t", [0.2, tiny_datasets.T_MAX])
def test_assigned_gaussians_stay_in_place_and_move_with_their_object(blender, loaded, scene, tmp_path, t):
    motions.go_to(blender, loaded, t)
    background, mug = cloud_of(loaded, 0), cloud_of(loaded, 1)
    taken = rows(background)[5:60:2]
    before = motions.points(blender, background)[5:60:2]
    mark(background, np.isin(rows(background), taken))
    motions.choose(blender, mug)
    assert blender.ops.r5dgs.assign_gaussians() == {"FINISHED"}
    part = next(one for one in motions.clouds(loaded) if one.name.startswith(f"{mug.name} from "))
    np.testing.assert_array_equal(rows(part), taken)
    np.testing.assert_allclose(motions.points(blender, part), before, atol=1e-5)
    np.testing.assert_array_equal(all_rows(loaded), np.arange(len(scene.gaussians.means)))
    assert part.parent == mug.parent and part.r5dgs.object_id == 1
    now = motions.matrix(blender, mug.parent)
    motions.go_to(blender, loaded, 0.5)
    later = motions.matrix(blender, mug.parent)
    moved = later @ np.linalg.inv(now)
    expected = before @ moved[:3, :3].T + moved[:3, 3]
    np.testing.assert_allclose(motions.points(blender, part), expected, atol=1e-5)
    found = exported(blender, tmp_path / "assigned.r5dgs")
    assert (found.gaussians.object_ids == 1).sum() == (scene.gaussians.object_ids == 1).sum() + len(taken)
    assert len(found.objects) == len(scene.objects)
    world = scene_player.Player(found).frame(0.5).means
    own = np.flatnonzero(found.gaussians.object_ids == 1)
    assert all(np.linalg.norm(world[own] - place, axis=1).min() < 1e-4 for place in to_file(loaded, expected))


def to_file(collection, places):
    """Points of Blender's world in the world of the file."""
    back = np.linalg.inv(np.array(collection.r5dgs.root.matrix_world, np.float64))
    return places @ back[:3, :3].T + back[:3, 3]


def test_assigning_twice_and_back_makes_no_new_object(blender, loaded, scene, tmp_path):
    motions.go_to(blender, loaded, tiny_datasets.T_MAX)
    background, mug = cloud_of(loaded, 0), cloud_of(loaded, 1)
    for wanted in (slice(0, 10), slice(0, 7)):
        chosen = np.zeros(len(background.data.points), bool)
        chosen[wanted] = True
        mark(background, chosen)
        motions.choose(blender, mug)
        blender.ops.r5dgs.assign_gaussians()
    part = next(one for one in motions.clouds(loaded) if " from " in one.name)
    mark(part, np.arange(len(part.data.points)) < 4)
    motions.choose(blender, background)
    blender.ops.r5dgs.assign_gaussians()
    found = exported(blender, tmp_path / "back.r5dgs")
    assert [item.id for item in found.objects] == [item.id for item in scene.objects]
    ids, before = found.gaussians.object_ids, scene.gaussians.object_ids
    assert (ids == 1).sum() == (before == 1).sum() + 13 and (ids == 0).sum() == (before == 0).sum() - 13


def test_gaussians_that_bend_go_on_bending_after_others_were_deleted(blender, tmp_path):
    bending = tiny_datasets.breathing(tiny_datasets.make_truth(), 0.3)
    scene = scene_file.read(scene_file.write(bending, tmp_path / "bending.r5dgs"))
    collection = motions.load(blender, tmp_path / "bending.r5dgs")
    motions.go_to(blender, collection, 0.2)
    for cloud in motions.clouds(collection):
        mark(cloud, np.arange(len(cloud.data.points)) % 3 == 0)
    blender.ops.r5dgs.delete_gaussians()
    for t in (0.3, 0.61, 0.2):
        motions.go_to(blender, collection, t)
        expected = scene_player.Player(scene).frame(t).means
        for cloud in motions.clouds(collection):
            np.testing.assert_allclose(
                motions.points(blender, cloud), expected[rows(cloud)], atol=1e-5 * scene.extent
            )  # fmt: skip


def test_points_that_modifiers_change_are_refused_by_name(blender, loaded):
    mug = cloud_of(loaded, 1)
    mug.modifiers.new("Bend", "NODES")
    with pytest.raises(RuntimeError, match=f"{mug.name}: the modifier 'Bend' changes its points"):
        blender.ops.r5dgs.select_gaussians(action="ALL")
    assert count(loaded) == 0


def test_copies_of_an_object_share_selection_and_deletion(blender, loaded):
    mug = cloud_of(loaded, 1)
    motions.choose(blender, mug)
    blender.ops.r5dgs.duplicate_object()
    users = mug.data.users
    mark(mug, np.arange(len(mug.data.points)) < 5)
    before = len(mug.data.points)
    blender.ops.r5dgs.delete_gaussians()
    assert len(mug.data.points) == before - 5 and mug.data.users == users == 2


def test_delete_and_assign_need_a_selection(blender, loaded):
    for name in ("delete_gaussians", "assign_gaussians"):
        with pytest.raises(RuntimeError, match="Select Gaussians first"):
            getattr(blender.ops.r5dgs, name)()


@pytest.mark.parametrize("kind", ["PERSP", "ORTHO"])
def test_a_stroke_selects_what_the_camera_shows_inside(blender, loaded, kind):
    from bpy_extras import object_utils

    bpy, strokes = blender, motions.addon("clean_up.strokes")
    camera = bpy.data.objects.new("eye", bpy.data.cameras.new("eye"))
    bpy.context.collection.objects.link(camera)
    camera.location, camera.rotation_euler = (0.3, -7.0, 1.0), (1.45, 0.0, 0.05)
    camera.data.type, camera.data.ortho_scale = kind, 6.0
    render = bpy.context.scene.render
    render.resolution_x, render.resolution_y, render.resolution_percentage = 320, 240, 100
    bpy.context.view_layer.update()
    depsgraph = bpy.context.evaluated_depsgraph_get()
    projection = np.array(camera.calc_matrix_camera(depsgraph, x=320, y=240))
    view = strokes.StrokeView(projection @ np.linalg.inv(np.array(camera.matrix_world)), 320, 240)
    path = np.array([(100, 80), (240, 70), (230, 180), (150, 190)], float)
    for hidden in (None, cloud_of(loaded, 2)):
        if hidden is not None:
            hidden.hide_set(True)
        expected = 0
        for cloud in motions.clouds(loaded):
            if cloud == hidden:
                continue
            for place in motions.points(bpy, cloud):
                seen = object_utils.world_to_camera_view(bpy.context.scene, camera, bpy_vector(place))
                expected += seen.z > 0 and inside((seen.x * 320, seen.y * 240), path)
        through = strokes.Stroke(path, None, False)
        assert strokes.select(bpy.context, loaded, view, through, "SET") == expected > 20
        front = strokes.select(bpy.context, loaded, view, strokes.Stroke(path, None, True), "SET")
        assert 0 < front <= expected
    brush = strokes.Stroke(path[[0, 2]], 12.0, False)
    assert strokes.select(bpy.context, loaded, view, brush, "SUBTRACT") < front
    alone = strokes.select(bpy.context, loaded, view, brush, "SET")
    assert strokes.select(bpy.context, loaded, view, strokes.Stroke(path, None, True), "ADD") > alone > 5


def bpy_vector(place):
    from mathutils import Vector

    return Vector(place.tolist())


def inside(point, path):
    found = False
    for (x0, y0), (x1, y1) in zip(path, np.roll(path, -1, axis=0), strict=True):
        if (y0 > point[1]) != (y1 > point[1]):
            found ^= bool(point[0] < x0 + (point[1] - y0) * (x1 - x0) / (y1 - y0))
    return found
