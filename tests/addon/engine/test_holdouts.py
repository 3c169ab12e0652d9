"""Hold-outs cut holes as in Cycles, and objects invisible to cameras are not drawn."""

import numpy as np
import pytest

from r5dgs_core.data import images
from r5dgs_core.playback import scene_player
from r5dgs_core.render import scene_renderer

pytest.importorskip("bpy", reason="bpy is not installed; it comes with the extra 'test' on Python 3.11")
pytest.importorskip("torch", reason="torch is not installed in this Python, which runs the worker here")

from tests.addon.engine.test_engine import (  # noqa: E402  (needs torch)
    NOTHING,
    assert_almost_all_close,
    go_to,
    loaded,
    psnr,
    render_passes,
    scene,
)

__all__ = ("loaded", "scene")  # fixtures


@pytest.fixture
def passes(blender, loaded, scene, tmp_path):
    """A function that renders all passes at t_max."""
    layer = blender.context.view_layer
    layer.use_pass_z = layer.use_pass_object_index = True
    go_to(blender, scene.t_max)
    return lambda: render_passes(blender, tmp_path)


def cloud(collection, name):
    return next(o for o in collection.all_objects if o.name == name and o.r5dgs.role == "CLOUD")


def shares(scene, rows):
    """Share of each pixel that some Gaussians cover, and the depth of the others at t_max. [H, W] each"""
    pose, camera = scene_player.Player(scene).frame(scene.t_max), scene.cameras[0]
    held = np.zeros(len(scene.gaussians.means), np.float32)
    held[rows] = 1
    z = pose.means @ camera.T_cam_world[2, :3] + camera.T_cam_world[2, 3]
    features = np.stack([held, (1 - held) * z], axis=-1)
    found = scene_renderer.render_frame(scene, pose, camera, features=features)
    share, depth = found.features.transpose(2, 0, 1)
    kept = found.alpha - share
    return share, depth / np.maximum(kept, 1e-6), kept


def rows_of(obj):
    return slice(obj.r5dgs.start, obj.r5dgs.start + obj.r5dgs.count)


@pytest.mark.parametrize("transparent", [False, True])
def test_a_hold_out_cuts_alpha_colour_depth_and_index(blender, loaded, scene, passes, transparent):
    blender.context.scene.render.film_transparent = transparent
    mug = cloud(loaded, "mug")
    before = passes()
    mug.is_holdout = True
    after = passes()
    share, depth, kept = shares(scene, rows_of(mug))
    assert share.max() > 0.9
    assert_almost_all_close(after.combined[..., 3], kept if transparent else 1 - share, 2e-3)
    hidden = share > 0.99
    assert hidden.any() and np.abs(after.combined[hidden]).max() < 0.05
    assert (after.depth[hidden] == np.float32(NOTHING)).all() and (after.index[hidden] == 0).all()
    sure = kept > 0.6
    assert (np.abs(after.depth[sure] / depth[sure] - 1) > 1e-3).mean() < 1e-2
    away = share < 1e-4
    assert (np.abs(after.combined[away] - before.combined[away]) > 2e-3).mean() < 1e-2


@pytest.mark.parametrize("flag", ["holdout", "indirect_only"])
def test_collections_hold_out_and_hide_as_their_objects_do(blender, loaded, passes, flag):
    mug = cloud(loaded, "mug")
    name = "is_holdout" if flag == "holdout" else "visible_camera"
    setattr(mug, name, flag == "holdout")
    expected = passes()
    setattr(mug, name, flag != "holdout")
    own = mug.users_collection[0]
    layers = blender.context.view_layer.layer_collection.children[loaded.name].children
    setattr(layers[own.name], flag, True)
    for other in list(own.all_objects):
        if other != mug and other.r5dgs.role == "CLOUD":
            other.hide_render = True
    found = passes()
    for other in list(own.all_objects):
        other.hide_render = False
    np.testing.assert_allclose(found.combined, expected.combined, atol=1e-5)


def test_objects_invisible_to_cameras_are_not_drawn(blender, loaded, passes):
    mug = cloud(loaded, "mug")
    before = passes()
    mug.visible_camera = False
    unseen = passes()
    mug.visible_camera, mug.hide_render = True, True
    hidden = passes()
    assert psnr(before.combined, unseen.combined) < 40
    np.testing.assert_allclose(unseen.combined, hidden.combined, atol=1e-5)


@pytest.mark.parametrize(("name", "value"), [("is_holdout", True), ("visible_camera", False)])
def test_an_animation_follows_keyed_hold_outs_and_visibility(blender, loaded, passes, tmp_path, name, value):
    blender.context.scene.frame_start, blender.context.scene.frame_end = 1, 2
    for obj in loaded.all_objects:  # what rests
        obj.animation_data_clear()
    mug, settings = cloud(loaded, "mug"), blender.context.scene.render
    for frame, at in ((1, value), (2, not value)):
        setattr(mug, name, at)
        mug.keyframe_insert(name, frame=frame)
    settings.filepath, settings.image_settings.file_format = str(tmp_path / "frame_"), "PNG"
    assert blender.ops.render.render(animation=True) == {"FINISHED"}
    first, second = (images.read(tmp_path / f"frame_000{frame}.png") for frame in (1, 2))
    assert psnr(first, second) < 40


def test_cycles_leaves_alpha_and_depth_empty_in_a_hold_out(blender, tmp_path):
    """Check in Cycles itself the rule that the engine follows."""
    scene = blender.context.scene
    scene.render.engine, scene.render.film_transparent = "CYCLES", False
    scene.cycles.samples, scene.cycles.use_denoising, scene.view_layers[0].use_pass_z = 1, False, True
    scene.render.resolution_x = scene.render.resolution_y = 16
    scene.render.resolution_percentage = 100
    blender.data.objects["Cube"].is_holdout = True
    found = render_passes(blender, tmp_path)
    middle = found.combined[8, 8]
    assert np.abs(middle).max() < 1e-6 and found.combined[0, 0, 3] == 1
    assert found.depth[8, 8] > 1e9


def test_holdout_meshes_are_named(blender, loaded, passes, capfd):
    blender.ops.mesh.primitive_cube_add()
    blender.context.object.is_holdout = True
    passes()
    assert "only hold-out point clouds cut Gaussians" in capfd.readouterr().out
