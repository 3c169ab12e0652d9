"""Parts of an object in Blender: their anchors hang on each other, and play as in the core."""

import importlib
import types

import numpy as np
import pytest

from r5dgs_core.playback import scene_player
from r5dgs_core.scene import scene_file
from tests.support import arms

pytest.importorskip("bpy", reason="bpy is not installed; it comes with the extra 'test' on Python 3.11")

FRAMES = (1.0, 4.4, 17.0, 31.7, 46.0, 52.5, 61.0)


@pytest.fixture(params=["hinge", "ball", "slider"])
def scene_path(request, tmp_path):
    return scene_file.write(arms.make_arm(request.param), tmp_path / "arm.r5dgs")


@pytest.fixture
def scene(scene_path):
    return scene_file.read(scene_path)


@pytest.fixture
def addon(blender):
    """Modules of the add-on by their last names."""
    names = ("motion.duplicate_delete", "motion.extrapolate", "scene.object_names", "export.scene")
    return types.SimpleNamespace(
        **{name.replace(".", "_"): importlib.import_module(f"r5dgs.r5dgs_addon.{name}") for name in names}
    )


def one_of(collection, role, motion_id):
    return next(o for o in collection.all_objects if (o.r5dgs.role, o.r5dgs.motion_id) == (role, motion_id))


def anchor_of(collection, motion_id):
    return one_of(collection, "ANCHOR", motion_id)


def shown(blender, collection, scene, motion_id, frame):
    """Positions of a group's Gaussians in the world as Blender shows them."""
    blender.context.scene.frame_set(int(frame), subframe=frame % 1)
    blender.context.view_layer.update()
    cloud = one_of(collection, "CLOUD", motion_id)
    matrix = np.array(cloud.matrix_world)
    rows = slice(cloud.r5dgs.start, cloud.r5dgs.start + cloud.r5dgs.count)
    return scene.gaussians.means[rows] @ matrix[:3, :3].T + matrix[:3, 3], rows


def test_a_part_hangs_on_the_anchor_of_its_parent_and_plays_as_in_the_core(blender, loaded, scene, addon):
    collection = loaded
    assert anchor_of(collection, 2).parent == anchor_of(collection, 1)
    for frame in FRAMES:
        expected = scene_player.Player(scene).frame((frame - 1) / scene.frames_per_unit).means
        for motion_id in (1, 2):
            points, rows = shown(blender, collection, scene, motion_id, frame)
            np.testing.assert_allclose(points, expected[rows], atol=2e-5 * scene.extent)


def test_the_object_is_one_for_names_and_selection(blender, loaded, addon):
    collection = loaded
    clouds = addon.scene_object_names.clouds(collection, 1)
    assert {cloud.r5dgs.motion_id for cloud in clouds} == {1, 2}
    names = {cloud.name for cloud in clouds}
    assert len(names) == 2 and any("part" in name for name in names)
    assert len({entry.object_id for entry in collection.r5dgs.table if entry.object_id == 1}) == 1


def test_moving_the_parent_moves_the_part(blender, loaded, scene, addon):
    collection = loaded
    before = shown(blender, collection, scene, 2, 20.0)[0]
    anchor_of(collection, 1).delta_location = (1.0, 0.0, 0.0)
    np.testing.assert_allclose(shown(blender, collection, scene, 2, 20.0)[0], before + [1, 0, 0], atol=1e-5)


def test_extrapolating_again_without_edits_changes_nothing(blender, loaded, scene, addon):
    collection = loaded
    before = shown(blender, collection, scene, 2, 61.0)[0]
    addon.motion_extrapolate.re_extrapolate([anchor_of(collection, 2)])
    np.testing.assert_allclose(shown(blender, collection, scene, 2, 61.0)[0], before, atol=2e-5 * scene.extent)
    addon.motion_extrapolate.reload([anchor_of(collection, 2)], scene)
    np.testing.assert_allclose(shown(blender, collection, scene, 2, 61.0)[0], before, atol=2e-5 * scene.extent)


def test_copies_and_deletions_take_the_parts_along(blender, loaded, scene, addon):
    collection = loaded
    upper, lower = (anchor_of(collection, row) for row in (1, 2))
    copies = addon.motion_duplicate_delete.duplicate(blender.context, [upper], (0.0, 2.0, 0.0), shadows=False)
    assert len(copies) == 2 and copies[1].parent == copies[0] and lower.parent == upper
    blender.context.view_layer.update()
    for old, new in zip((upper, lower), copies, strict=True):
        moved = np.array(new.matrix_world)[:3, 3] - np.array(old.matrix_world)[:3, 3]
        np.testing.assert_allclose(moved, [0, 2, 0], atol=1e-5)
    removed, names = addon.motion_duplicate_delete.delete(blender.context, [upper], shadows=False)
    assert len(names) == 2 and removed == 4


def test_an_unedited_arm_is_exported_as_it_was(blender, loaded, scene, scene_path, addon, tmp_path):
    out = tmp_path / "again.r5dgs"
    assert blender.ops.r5dgs.export_scene(filepath=str(out)) == {"FINISHED"}
    assert out.read_bytes() == scene_path.read_bytes()


def test_a_moved_arm_keeps_its_joint(blender, loaded, scene, addon, tmp_path):
    root = anchor_of(loaded, 1)
    root.delta_location = (0.5, 0.0, 0.0)
    out = tmp_path / "moved.r5dgs"
    assert blender.ops.r5dgs.export_scene(filepath=str(out)) == {"FINISHED"}
    moved = scene_file.read(out)
    assert moved.groups[2].parent == 1
    np.testing.assert_allclose(moved.groups[2].joint.point, scene.groups[2].joint.point + [0.5, 0, 0], atol=1e-5)
    assert_moved(scene, moved, lambda points: points + [0.5, 0, 0])


def test_an_arm_under_a_moved_and_turned_parent_keeps_its_joint(blender, loaded, scene, addon, tmp_path):
    holder = blender.data.objects.new("holder", None)
    loaded.objects.link(holder)
    holder.matrix_world = ((0, -2, 0, 0.3), (2, 0, 0, 0), (0, 0, 2, 0.1), (0, 0, 0, 1))
    anchor_of(loaded, 1).parent = holder
    blender.context.view_layer.update()
    matrix = np.array(holder.matrix_world)
    out = tmp_path / "turned.r5dgs"
    assert blender.ops.r5dgs.export_scene(filepath=str(out)) == {"FINISHED"}
    moved = scene_file.read(out)
    assert moved.groups[2].joint is not None and moved.groups[2].joint.kind == scene.groups[2].joint.kind
    assert_moved(scene, moved, lambda points: points @ matrix[:3, :3].T + matrix[:3, 3])


def assert_moved(scene, moved, place):
    rows = np.isin(scene.gaussians.motion_ids, (1, 2))
    for t in (0.0, 0.41, 0.75, 0.95):
        expected = place(scene_player.Player(scene).frame(t).means[rows])
        np.testing.assert_allclose(scene_player.Player(moved).frame(t).means[rows], expected, atol=5e-5)


def test_an_edited_motion_of_a_part_loses_its_joint(blender, loaded, scene, addon, tmp_path):
    part = anchor_of(loaded, 2)
    part.r5dgs_motion.kind = "static"
    addon.motion_extrapolate.re_extrapolate([part])
    out = tmp_path / "edited.r5dgs"
    assert blender.ops.r5dgs.export_scene(filepath=str(out)) == {"FINISHED"}
    edited = scene_file.read(out)
    assert edited.groups[2].joint is None and edited.groups[2].parent is None
