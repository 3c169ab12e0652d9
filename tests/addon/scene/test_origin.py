"""A far origin of a scene: shown near Blender's origin, saved with the .blend, added again on export."""

import dataclasses
import importlib

import numpy as np
import pytest

from r5dgs_core.data import colmap_model, transforms
from r5dgs_core.formats import ply
from r5dgs_core.motion import models
from r5dgs_core.playback import scene_player
from r5dgs_core.scene import scene_file
from tests.addon.engine.test_preview import core_picture, go_to, place_camera, preview, psnr
from tests.support import layouts, scenes

pytest.importorskip("bpy", reason="bpy is not installed; it comes with the extra 'test' on Python 3.11")

ORIGIN = np.array([5e6 + 0.125, -1.25e8, 3.0])
TEXT = "(5000000.125, -125000000, 3)"


@pytest.fixture
def scene_path(tmp_path):
    made = scenes.make_scene(n=300, objects=3, seed=4, world_convention="colmap")
    return scene_file.write(made.with_arrays(origin=ORIGIN), tmp_path / "scene.r5dgs")


@pytest.fixture
def loaded_scenes(blender):
    return importlib.import_module("r5dgs.r5dgs_addon.scene.loaded_scenes")


@pytest.fixture
def view(blender, loaded, scene_path):
    """Blender camera at the position of the scene's first camera."""
    return place_camera(blender, loaded, scene_file.read(scene_path).cameras[0])


def test_a_far_scene_is_shown_near_blenders_origin(blender, loaded, scene_path, loaded_scenes):
    scene = scene_file.read(scene_path)
    root = loaded.r5dgs.root
    assert np.abs(np.array(root.matrix_world)[:3, 3]).max() == 0
    assert loaded_scenes.origin(loaded).tolist() == ORIGIN.tolist()
    clouds = sorted(loaded_scenes.members(loaded, "CLOUD"), key=lambda obj: obj.r5dgs.start)
    points = np.concatenate([points_of(obj) for obj in clouds])
    np.testing.assert_array_equal(points, scene.gaussians.means)


def points_of(obj):
    points = np.empty(3 * len(obj.data.points), np.float32)
    obj.data.attributes["position"].data.foreach_get("vector", points)
    return points.reshape(-1, 3)


def test_the_origin_is_kept_by_the_blend_to_the_bit(blender, loaded, loaded_scenes, tmp_path):
    blender.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    blender.ops.wm.open_mainfile(filepath=str(tmp_path / "a.blend"))
    collection = next(c for c in blender.data.collections if c.r5dgs.is_scene)
    assert loaded_scenes.origin(collection).tolist() == ORIGIN.tolist()


@pytest.mark.parametrize("value", ["here", [1.0, 2.0], [1.0, float("nan"), 2.0], 3])
def test_a_broken_property_counts_as_none(loaded, loaded_scenes, value):
    del loaded.r5dgs.root[
        loaded_scenes.ORIGIN
    ]  # Blender 4.3 loses memory if a property with a description changes its type
    loaded.r5dgs.root[loaded_scenes.ORIGIN] = value
    assert loaded_scenes.origin(loaded).tolist() == [0, 0, 0]


def test_the_panel_shows_the_origin_in_one_line(blender, loaded, loaded_scenes):
    panel = importlib.import_module("r5dgs.r5dgs_addon.panels.scene").R5DGS_PT_scene
    assert f"Relative to {TEXT}" in layouts.draw(blender, panel)
    del loaded.r5dgs.root[loaded_scenes.ORIGIN]
    assert not [line for line in layouts.draw(blender, panel) if "Relative" in line]


def test_the_preview_of_a_far_scene_is_the_cores_picture(blender, loaded, view, scene_path):
    scene = scene_file.read(scene_path)
    for t in (0.2, 0.95):
        go_to(blender, t)
        assert psnr(preview(blender), core_picture(scene, scene_player.Player(scene).frame(t))) > 45


def test_exported_cameras_of_the_file_are_those_of_the_data_sets_world(blender, view, scene_path, tmp_path):
    own = scene_file.read(scene_path).cameras[0]
    options = {"frames": "CURRENT", "axes": "FILE"}
    assert blender.ops.r5dgs.export_cameras(directory=str(tmp_path / "nerf"), **options) == {"FINISHED"}
    entry = transforms.read(tmp_path / "nerf" / "transforms.json")[0][0]
    np.testing.assert_allclose(entry.matrix[:3, 3] - ORIGIN, own.center, atol=1e-5)
    assert blender.ops.r5dgs.export_cameras(directory=str(tmp_path), format="COLMAP", **options) == {"FINISHED"}
    T_cam_world = colmap_model.read(tmp_path / "sparse" / "0").images[0].T_cam_world
    np.testing.assert_allclose(-T_cam_world[:3, :3].T @ T_cam_world[:3, 3] - ORIGIN, own.center, atol=1e-5)


def test_exported_cameras_in_other_axes_are_relative_to_the_origin_with_a_report(blender, view, tmp_path, capfd):
    options = {"directory": str(tmp_path), "frames": "CURRENT", "axes": "BLENDER"}
    assert blender.ops.r5dgs.export_cameras(**options) == {"FINISHED"}
    entry = transforms.read(tmp_path / "transforms.json")[0][0]
    np.testing.assert_allclose(entry.matrix[:3, 3], view.matrix_world.translation, atol=1e-5)
    assert f"relative to {TEXT}" in "".join(capfd.readouterr())


def test_an_exported_ply_is_relative_to_the_origin_and_stores_it(blender, loaded, scene_path, tmp_path, capfd):
    scene, path = scene_file.read(scene_path), tmp_path / "out.ply"
    go_to(blender, scene.t_max)
    assert blender.ops.r5dgs.export_ply(filepath=str(path), axes="FILE") == {"FINISHED"}
    np.testing.assert_allclose(np.sort(ply.read(path).means, 0), np.sort(scene.gaussians.means, 0), atol=1e-5)
    assert b"\ncomment origin 5000000.125 -125000000.0 3.0\n" in path.read_bytes()
    assert f"relative to {TEXT}" in "".join(capfd.readouterr())
    assert blender.ops.r5dgs.export_ply(filepath=str(path), axes="COLMAP") == {"FINISHED"}
    assert b"comment origin" not in path.read_bytes()


def test_an_edited_scene_keeps_the_origin(blender, loaded, scene_path, tmp_path):
    cloud = next(o for o in loaded.all_objects if o.name == "mug" and o.r5dgs.role == "CLOUD")
    cloud.location.x += 0.5
    assert blender.ops.r5dgs.export_scene(filepath=str(tmp_path / "edited.r5dgs")) == {"FINISHED"}
    edited, scene = scene_file.read(tmp_path / "edited.r5dgs"), scene_file.read(scene_path)
    assert edited.origin.tolist() == ORIGIN.tolist()
    assert (
        np.abs(
            edited.gaussians.means[edited.gaussians.object_ids == 1]
            - scene.gaussians.means[scene.gaussians.object_ids == 1]
        ).max()
        > 0.4
    )
    np.testing.assert_array_equal(edited.cameras[0].T_cam_world, scene.cameras[0].T_cam_world)


def shrunk(scene, factor):
    """A still scene in another unit."""
    still = scene.with_arrays(track_times=scene.tracks.times[-1:], track_poses=scene.tracks.poses[:, -1:])
    small = [dataclasses.replace(g, pivot=factor * g.pivot, model=models.STATIC, follows=None) for g in still.groups]
    return dataclasses.replace(
        still.with_arrays(
            means=(factor * still.gaussians.means).astype(np.float32),
            log_scales=(still.gaussians.log_scales + np.log(factor)).astype(np.float32),
        ),
        groups=tuple(small),
    )


def test_a_scene_too_small_for_blenders_curves_is_refused_with_the_remedy(blender, tmp_path):
    scene = scenes.make_scene(n=100)
    path = scene_file.write(shrunk(scene, 1e-12), tmp_path / "small.r5dgs")
    with pytest.raises(RuntimeError, match=r"small.r5dgs: expected a scene of 0.0001 units.*by 1e\+12 and train again"):
        blender.ops.r5dgs.load_scene(filepath=str(path))
    assert not blender.data.pointclouds and not [c for c in blender.data.collections if c.r5dgs.is_scene]
    path = scene_file.write(shrunk(scene, 1e-4), tmp_path / "enough.r5dgs")
    assert blender.ops.r5dgs.load_scene(filepath=str(path)) == {"FINISHED"}
