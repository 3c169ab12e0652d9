"""Blender's own importer of OpenUSD plays the Xforms of our files as playback does, and has the same cameras."""

import numpy as np
import pytest

from r5dgs_core.formats import registry, usd
from r5dgs_core.motion import rotations
from r5dgs_core.playback.scene_player import Player
from r5dgs_core.scene import cameras
from tests.support import scenes

pytest.importorskip("bpy", reason="bpy is not installed; it comes with the extra 'test' on Python 3.11")
pytest.importorskip("pxr", reason="usd-core is not installed; it comes with the extra 'usd'")

CLOSE = 3e-5  # of the scene's extent; samples are within 1e-5
FRAMES = (1, 12, 30.5, 60, 78)


@pytest.fixture
def scene():
    return scenes.make_scene(n=120, objects=3, sh_degree=1, seed=2, world_convention="colmap")


@pytest.fixture
def imported(blender, scene, tmp_path):
    """Blender's scene after the import of our file."""
    (path,) = usd.export(scene, tmp_path / "scene.usd", registry.Options((0.0,), until=1.4))
    assert blender.ops.wm.usd_import(filepath=str(path)) == {"FINISHED"}
    return blender.context.scene


def test_anchors_move_as_in_playback(blender, scene, imported):
    player, up = Player(scene), cameras.WORLD_TO_BLENDER[scene.world_convention]
    bodies = [group for group in scene.groups if group.role == "body"]
    names = {item.id: item.name.replace(" ", "_") for item in scene.objects}
    moved = 0.0
    for frame in FRAMES:
        imported.frame_set(int(frame), subframe=frame % 1)
        turns, moves = player.group_poses((frame - 1) / scene.frames_per_unit)
        depsgraph = blender.context.evaluated_depsgraph_get()
        for group in bodies:
            matrix = np.array(blender.data.objects[names[group.object_id]].evaluated_get(depsgraph).matrix_world)
            wanted = up @ (group.home + moves[group.id])
            np.testing.assert_allclose(matrix[:3, 3], wanted, atol=CLOSE * scene.extent)
            turned = up @ rotations.quats_to_rotmats(turns[group.id])
            np.testing.assert_allclose(matrix[:3, :3], turned, atol=2e-3)
            moved = max(moved, float(np.abs(moves[group.id]).max()))
    assert moved > 0.05 * scene.extent and len(bodies) == 3


def test_cameras_have_their_poses_and_lenses(blender, scene, imported):
    up = cameras.WORLD_TO_BLENDER[scene.world_convention]
    found = [obj for obj in blender.data.objects if obj.type == "CAMERA" and obj.parent is not None]
    assert len(found) == len(scene.cameras) > 0
    for camera in scene.cameras:
        pose = cameras.cam_world_to_opengl(camera.T_cam_world)
        place = up @ pose[:3, 3]
        shown = min(found, key=lambda obj: np.linalg.norm(np.array(obj.matrix_world)[:3, 3] - place))
        matrix = np.array(shown.matrix_world)
        np.testing.assert_allclose(matrix[:3, 3], place, atol=1e-5 * scene.extent)
        np.testing.assert_allclose(matrix[:3, :3], up @ pose[:3, :3], atol=1e-5)
        assert shown.data.lens / shown.data.sensor_width == pytest.approx(
            camera.intrinsics[0, 0] / camera.width, rel=1e-4
        )
