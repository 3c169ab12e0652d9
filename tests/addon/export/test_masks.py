"""Masks and index images show the object that is in front according to the core."""

import json

import numpy as np
import OpenImageIO as oiio
import pytest

from r5dgs_core.data import images
from r5dgs_core.playback import scene_player
from r5dgs_core.render import scene_renderer
from r5dgs_core.scene import cameras, scene_file
from tests.support import motions, scenes

pytest.importorskip("bpy", reason="bpy is not installed; it comes with the extra 'test' on Python 3.11")

from mathutils import Matrix  # noqa: E402  (bpy brings it)


@pytest.fixture
def scene(tmp_path):
    made = scenes.make_scene(n=400, objects=3, seed=4)
    return scene_file.read(scene_file.write(made, tmp_path / "scene.r5dgs"))


@pytest.fixture
def loaded(blender, scene, tmp_path, monkeypatch):
    monkeypatch.delenv("R5DGS_PYTHON", raising=False)
    motions.load_again(blender, tmp_path / "scene.r5dgs")
    camera, view = scene.cameras[0], blender.context.scene
    view.camera.data.sensor_fit = "HORIZONTAL"
    view.camera.data.lens = camera.intrinsics[0, 0] * view.camera.data.sensor_width / camera.width
    view.camera.matrix_world = Matrix(cameras.cam_world_to_opengl(camera.T_cam_world).tolist())
    view.render.resolution_x, view.render.resolution_y, view.render.resolution_percentage = 96, 72, 100
    view.render.use_border = True  # masks are of the whole picture
    view.render.border_max_x = 0.5
    view.frame_start, view.frame_end = 10, 11
    return next(c for c in blender.data.collections if c.r5dgs.is_scene)


def channels(path):
    source = oiio.ImageInput.open(str(path))
    pixels = source.read_image("float")
    found = {name: pixels[..., k] for k, name in enumerate(source.spec().channelnames)}
    source.close()
    return found


def truth(scene, frame):
    return scene_renderer.render_frame(
        scene, scene_player.Player(scene).frame((frame - 1) / 60), scene.cameras[0], background=None
    )


def test_masks_and_index_of_a_range_match_the_core(blender, scene, loaded, tmp_path):
    assert blender.ops.r5dgs.export_masks(directory=str(tmp_path / "out"), format="BOTH") == {"FINISHED"}
    folder = tmp_path / "out"
    assert json.loads((folder / "objects.json").read_text()) == {
        str(item.id): item.name for item in scene.objects if item.id > 0
    }
    for frame in (10, 11):
        mask = images.read_png(folder / "object_mask" / "images" / f"frame_{frame:04d}.png")
        assert mask.dtype == np.uint8 and mask.shape[:2] == (72, 96)
        wanted = truth(scene, frame)
        alpha = wanted.alpha
        ids = np.where(alpha >= 0.5, np.maximum(wanted.ids, 0), 0)
        assert set(np.unique(mask)) == {0, 1, 2, 3}
        assert (mask[..., 0] == ids).mean() > 0.98  # of a pixel, the cloud with the largest share against the object's
        found = channels(folder / "object_index" / f"frame_{frame:04d}.exr")
        np.testing.assert_array_equal(found["R5DGS.IndexOB.X"], mask[..., 0])
        np.testing.assert_allclose(found["R5DGS.Alpha.V"], alpha, atol=1e-3)
        solid = alpha > 0.6
        np.testing.assert_allclose(found["R5DGS.Depth.Z"][solid], wanted.depth[solid], rtol=1e-3)


def test_blender_reads_the_index_as_passes_of_a_layer(blender, loaded, tmp_path):
    options = {"directory": str(tmp_path / "out"), "format": "EXR", "frames": "CURRENT"}
    assert blender.ops.r5dgs.export_masks(**options) == {"FINISHED"}
    path = next((tmp_path / "out" / "object_index").iterdir())
    assert not (tmp_path / "out" / "object_mask").exists()
    node = blender.data.node_groups.new("tree", "CompositorNodeTree").nodes.new("CompositorNodeImage")
    node.image = blender.data.images.load(str(path))
    assert node.has_layers
    assert {output.name for output in node.outputs} == {"IndexOB", "Depth", "Alpha"}


def test_large_pass_indices_make_masks_of_16_bits(blender, loaded, tmp_path):
    mug = next(o for o in loaded.all_objects if o.r5dgs.role == "CLOUD" and o.name == "mug")
    mug.pass_index = 700
    blender.context.view_layer.update()
    options = {"directory": str(tmp_path / "out"), "frames": "CURRENT"}
    assert blender.ops.r5dgs.export_masks(**options) == {"FINISHED"}
    mask = images.read_png(next((tmp_path / "out" / "object_mask" / "images").iterdir()))
    assert mask.dtype == np.uint16 and 700 in mask and 1 not in mask
    assert json.loads((tmp_path / "out" / "objects.json").read_text())["700"] == "mug"


def test_a_worker_failure_is_an_error_and_writes_no_file(blender, loaded, tmp_path, monkeypatch):
    monkeypatch.setenv("R5DGS_PYTHON", str(tmp_path / "no-python"))
    with pytest.raises(RuntimeError, match="no-python"):
        blender.ops.r5dgs.export_masks(directory=str(tmp_path / "out"))
    assert not (tmp_path / "out").exists()
