"""Exported PLY files contain the visible Gaussians, as the core's pictures and other readers confirm."""

import dataclasses
import importlib

import numpy as np
import pytest

from r5dgs_core.cli.commands import export as export_command
from r5dgs_core.formats import ply
from r5dgs_core.playback import scene_player
from r5dgs_core.render import posed_scene, scene_renderer
from r5dgs_core.scene import cameras, scene_file, spherical_harmonics
from r5dgs_core.scene.instance import Instance
from r5dgs_core.scene.splats import Splats
from tests.support import motions, scenes

pytest.importorskip("bpy", reason="bpy is not installed; it comes with the extra 'test' on Python 3.11")

from mathutils import Matrix, Quaternion  # noqa: E402  (bpy brings it)

WORLD = cameras.WORLD_TO_BLENDER["colmap"]
WORLD_4 = np.block([[WORLD, np.zeros((3, 1))], [np.zeros((1, 3)), np.ones((1, 1))]])


@pytest.fixture
def scene(tmp_path):
    made = scenes.make_scene(n=300, objects=3, sh_degree=3, seed=4, world_convention="colmap")
    return scene_file.read(scene_file.write(made, tmp_path / "scene.r5dgs"))


@pytest.fixture
def loaded(blender, scene, tmp_path):
    return motions.load_again(blender, tmp_path / "scene.r5dgs")


@pytest.fixture
def gaussians(blender):
    return importlib.import_module("r5dgs.r5dgs_addon.export.gaussians")


def export(bpy, path, **options):
    assert bpy.ops.r5dgs.export_ply(filepath=str(path), **options) == {"FINISHED"}
    return ply.read(path)


def cloud(collection, name):
    return next(o for o in collection.all_objects if o.name == name and o.r5dgs.role == "CLOUD")


def turn_about(obj, turn):
    """A rotation and a scale about an object's pivot."""
    pivot = Matrix.Translation(obj.r5dgs.pivot)
    return pivot @ turn @ Matrix.Scale(1.6, 4) @ pivot.inverted()


def edit(bpy, collection):
    """Move, turn and scale one object, mirror another, hide a third. The anchor of the first still moves it."""
    mug, apple, car = (cloud(collection, name) for name in ("mug", "red apple", "toy car"))
    turn = Quaternion((0.6, 0.3, -0.5, 0.4)).normalized().to_matrix().to_4x4()
    mug.matrix_local = Matrix.Translation((0.1, -0.2, 0.1)) @ mug.matrix_local @ turn_about(mug, turn)
    apple.scale = (-1, 1, 1)
    car.hide_set(True)
    bpy.context.view_layer.update()
    return mug, apple, car


def render(splats, scene, camera, backend="reference"):
    """The core's picture of the Gaussians of a file, over the scene's sky."""
    posed = posed_scene.PosedScene(
        splats.means, splats.quats, splats.log_scales, splats.opacity_logits, splats.sh,
        np.zeros(len(splats.means), np.int32), np.eye(3)[None], np.zeros(len(splats.means), np.int64), None,
    )  # fmt: skip
    background = spherical_harmonics.dc_to_rgb(scene.background_sh[0])
    picture = scene_renderer.render_frame(scene, posed, camera, background=background, backend=backend)
    return np.clip(picture.color, 0, 1)


def psnr(a, b):
    return -10 * np.log10(((a - b) ** 2).mean())


def shown(scene, collection, camera):
    """The core's picture of the edited scene, computed with maps of the bind state."""
    instances = [
        Instance(o.r5dgs.start, o.r5dgs.count, np.array(o.matrix_world, np.float64), world=WORLD_4)
        for o in collection.all_objects
        if o.r5dgs.role == "CLOUD" and o.visible_get()
    ]
    background = spherical_harmonics.dc_to_rgb(scene.background_sh[0])
    pose = posed_scene.pose_instances(scene, instances)
    return np.clip(scene_renderer.render_frame(scene, pose, camera, background=background).color, 0, 1)


def in_blender(camera):
    world = np.eye(4)
    world[:3, :3] = WORLD
    return dataclasses.replace(camera, T_cam_world=camera.T_cam_world @ np.linalg.inv(world))


def select(splats, rows):
    """Some of the Gaussians of a file."""
    parts = {field.name: getattr(splats, field.name) for field in dataclasses.fields(splats)}
    return Splats(**{name: None if values is None else values[rows] for name, values in parts.items()})


def test_exported_gaussians_keep_translation_rotation_scale_and_mirroring(blender, scene, loaded, tmp_path):
    blender.context.scene.frame_set(43)
    edit(blender, loaded)
    camera = in_blender(scene.cameras[0])
    splats = export(blender, tmp_path / "a.ply")
    assert splats.sh.shape[1] == 16
    wanted = shown(scene, loaded, camera)
    assert psnr(render(splats, scene, camera), wanted) > 50
    without = select(splats, splats.object_ids != 1)
    assert psnr(render(without, scene, camera), wanted) < 35  # the edit is visible
    blender.context.scene.frame_set(30)
    assert psnr(render(splats, scene, camera), shown(scene, loaded, camera)) < 35  # the file is that of frame 43


@pytest.fixture
def previewed(blender, scene, loaded, monkeypatch):
    """An object of the edited scene, and a function that gives a camera and the worker's preview. [72, 96, 3]"""
    monkeypatch.delenv("R5DGS_PYTHON", raising=False)
    blender.context.scene.frame_set(43)
    mug, _, _ = edit(blender, loaded)
    camera, view = in_blender(scene.cameras[0]), blender.context.scene

    def preview():
        view.camera.data.sensor_fit = "HORIZONTAL"
        view.camera.data.lens = camera.intrinsics[0, 0] * view.camera.data.sensor_width / camera.width
        view.camera.matrix_world = Matrix(cameras.cam_world_to_opengl(camera.T_cam_world).tolist())
        view.render.resolution_x, view.render.resolution_y, view.render.resolution_percentage = 96, 72, 100
        blender.context.view_layer.update()
        assert blender.ops.r5dgs.preview() == {"FINISHED"}
        pixels = np.empty(4 * 96 * 72, np.float32)
        blender.data.images["R5DGS Preview"].pixels.foreach_get(pixels)
        return camera, pixels.reshape(72, 96, 4)[::-1, :, :3]

    return mug, preview


def test_a_moved_turned_scaled_and_tinted_object_looks_as_in_the_preview(blender, scene, previewed, tmp_path):
    mug, preview = previewed
    mug.r5dgs_look.tint = (0.4, 1.3, 0.8)
    camera, shown_there = preview()
    assert psnr(render(export(blender, tmp_path / "a.ply"), scene, camera), shown_there) > 40
    mug.r5dgs_look.tint = (1, 1, 1)
    assert psnr(render(export(blender, tmp_path / "b.ply"), scene, camera), shown_there) < 40


def test_exported_ply_read_by_trimesh_matches_the_preview(blender, scene, previewed, tmp_path):
    trimesh = pytest.importorskip("trimesh", reason="trimesh is not installed; it comes with the extra 'test'")
    camera, shown_there = previewed[1]()
    assert blender.ops.r5dgs.export_ply(filepath=str(tmp_path / "a.ply")) == {"FINISHED"}
    columns = trimesh.load(tmp_path / "a.ply").metadata["_ply_raw"]["vertex"]["data"]

    def column(*names):
        return np.stack([np.asarray(columns[name], np.float32).ravel() for name in names], axis=-1)

    rest = column(*(f"f_rest_{k}" for k in range(45))).reshape(-1, 3, 15).swapaxes(1, 2)
    sh = np.concatenate([column("f_dc_0", "f_dc_1", "f_dc_2")[:, None], rest], axis=1)
    sigmas, turns = column(*(f"scale_{k}" for k in range(3))), column(*(f"rot_{k}" for k in range(4)))
    theirs = Splats(column("x", "y", "z"), turns, sigmas, column("opacity")[:, 0], sh)
    assert psnr(render(theirs, scene, camera), shown_there) > 40
    flat = dataclasses.replace(theirs, sh=sh[:, :1])
    assert psnr(render(flat, scene, camera), shown_there) < 40  # the harmonics are visible


def test_an_unedited_scene_matches_playback(blender, scene, loaded, tmp_path):
    blender.context.scene.frame_set(13, subframe=0.5)
    splats = export(blender, tmp_path / "a.ply", axes="FILE")
    frame = scene_player.Player(scene).frame(12.5 / 60)
    np.testing.assert_allclose(np.sort(splats.means, axis=0), np.sort(frame.means, axis=0), atol=1e-5 * scene.extent)
    wanted = np.clip(
        scene_renderer.render_frame(
            scene, frame, scene.cameras[0], background=spherical_harmonics.dc_to_rgb(scene.background_sh[0])
        ).color, 0, 1,
    )  # fmt: skip
    assert psnr(render(splats, scene, scene.cameras[0]), wanted) > 50


def test_exact_mode_exports_deformed_gaussians(blender, scene, tmp_path):
    rows, knots = np.array([120, 260], np.int32), len(scene.tracks.times)
    offsets = np.full((2, knots, 3), 0.5, np.float32) * np.linspace(1, 0, knots)[None, :, None].astype(np.float32)
    bent = scene.with_arrays(
        residual_rows=rows,
        residual_offsets=offsets,
        residual_log_scales=0 * offsets,
        residual_quats=np.tile(np.float32([1, 0, 0, 0]), (2, knots, 1)),
    )
    scene_file.write(bent, tmp_path / "bent.r5dgs")
    blender.ops.r5dgs.load_scene(filepath=str(tmp_path / "bent.r5dgs"), bend=False)
    blender.context.scene.frame_set(13)
    straight = export(blender, tmp_path / "a.ply", axes="FILE")
    assert blender.ops.r5dgs.exact_mode() == {"FINISHED"}
    found = export(blender, tmp_path / "b.ply", axes="FILE")
    assert (np.abs(found.means - straight.means).max(-1) > 1e-3).sum() == 2
    wanted = scene_player.Player(scene_file.read(tmp_path / "bent.r5dgs")).frame(12 / 60).means
    np.testing.assert_allclose(np.sort(found.means, axis=0), np.sort(wanted, axis=0), atol=1e-5 * scene.extent)


def test_a_tint_is_baked_into_the_colours(blender, loaded, tmp_path):
    before = export(blender, tmp_path / "a.ply")
    mug = cloud(loaded, "mug")
    mug.r5dgs_look.tint = (0.5, 1.0, 0.25)
    after = export(blender, tmp_path / "b.ply")
    rows = after.object_ids == mug.r5dgs.object_id
    colour = spherical_harmonics.dc_to_rgb
    np.testing.assert_allclose(colour(after.sh[rows, 0]), colour(before.sh[rows, 0]) * (0.5, 1, 0.25), atol=1e-6)
    np.testing.assert_array_equal(after.sh[~rows], before.sh[~rows])


def test_only_selected_objects_are_exported_by_cloud_or_by_anchor(blender, scene, loaded, tmp_path):
    blender.ops.object.select_all(action="DESELECT")
    lemon = cloud(loaded, "mug")
    for handle in (lemon, lemon.parent):
        handle.select_set(True)
        found = export(blender, tmp_path / "a.ply", which="SELECTED")
        assert set(found.object_ids) == {lemon.r5dgs.object_id}
        assert len(found.means) == scene.object(lemon.r5dgs.object_id).count
        handle.select_set(False)
    with pytest.raises(RuntimeError, match="select"):
        blender.ops.r5dgs.export_ply(filepath=str(tmp_path / "none.ply"), which="SELECTED")
    assert not (tmp_path / "none.ply").exists()


def test_a_range_writes_a_numbered_file_per_frame_and_keeps_the_current_frame(blender, scene, loaded, tmp_path):
    view = blender.context.scene
    view.frame_start, view.frame_end = 5, 9
    view.frame_set(30, subframe=0.25)
    assert blender.ops.r5dgs.export_ply(filepath=str(tmp_path / "a.ply"), frames="RANGE", frame_step=2) == {"FINISHED"}
    assert sorted(p.name for p in tmp_path.glob("*.ply")) == ["a_0005.ply", "a_0007.ply", "a_0009.ply"]
    assert (view.frame_current, view.frame_subframe) == (30, 0.25)
    wanted = scene_player.Player(scene).frame(6 / 60).means @ WORLD.T
    found = ply.read(tmp_path / "a_0007.ply").means
    np.testing.assert_allclose(np.sort(found, axis=0), np.sort(wanted, axis=0), atol=1e-5 * scene.extent)


def test_instances_of_a_collection_are_exported_at_their_own_place(blender, scene, loaded, tmp_path):
    home = next(child for child in loaded.children if child.name == "mug")
    handle = blender.data.objects.new("copy", None)
    handle.instance_type, handle.instance_collection, handle.location = "COLLECTION", home, (0, 0, 5)
    blender.context.scene.collection.objects.link(handle)
    blender.context.view_layer.update()
    found = export(blender, tmp_path / "a.ply")
    count = scene.object(1).count
    assert len(found.means) == len(scene.gaussians.means) + count
    mugs = np.sort(found.means[found.object_ids == 1][:, 2])
    np.testing.assert_allclose(mugs[count:], mugs[:count] + 5, atol=1e-4)


def test_stopping_keeps_finished_files(blender, loaded, gaussians, tmp_path):
    view = blender.context.scene
    view.frame_start, view.frame_end = 1, 5
    steps = gaussians.ply_steps(blender.context, tmp_path / "a.ply", "VISIBLE", axes="BLENDER", plain=False, every=True)
    for _ in range(3):
        next(steps)
    steps.close()
    assert view.frame_current == 1
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a_0001.ply", "a_0002.ply", "scene.r5dgs"]
    assert len(ply.read(tmp_path / "a_0002.ply").means) == 300


@pytest.mark.parametrize("axes", ["BLENDER", "FILE", "COLMAP", "OPENGL"])
def test_axes_rotate_all_gaussians_and_plain_files_have_no_ids(blender, scene, loaded, axes, tmp_path):
    blender.context.scene.frame_set(46)  # t_max: the bind state
    found = export(blender, tmp_path / "a.ply", axes=axes, plain=True)
    assert found.object_ids is None and found.identities is None
    turned = {"BLENDER": WORLD, "FILE": np.eye(3), "COLMAP": np.eye(3)}
    turned["OPENGL"] = cameras.WORLD_TO_BLENDER["opengl"].T @ WORLD
    wanted = scene.gaussians.means @ turned[axes].T
    np.testing.assert_allclose(np.sort(found.means, axis=0), np.sort(wanted, axis=0), atol=1e-5)


def test_without_the_scene_file_the_points_in_blender_are_exported(blender, loaded, tmp_path, capsys):
    first = export(blender, tmp_path / "a.ply")
    (tmp_path / "scene.r5dgs").unlink()
    second = export(blender, tmp_path / "b.ply")
    assert "Taken from the points in Blender" in capsys.readouterr().out
    for name in ("means", "log_scales"):
        np.testing.assert_allclose(getattr(second, name), getattr(first, name), atol=2e-6, err_msg=name)
    np.testing.assert_array_equal(second.object_ids, first.object_ids)
    assert second.identities is None


def test_other_libraries_read_the_columns(blender, loaded, tmp_path):
    trimesh = pytest.importorskip("trimesh", reason="trimesh is not installed; it comes with the extra 'test'")
    ours = export(blender, tmp_path / "a.ply")
    theirs = trimesh.load(tmp_path / "a.ply")
    np.testing.assert_array_equal(np.asarray(theirs.vertices, np.float32), ours.means)
    raw = theirs.metadata["_ply_raw"]["vertex"]["data"]
    np.testing.assert_array_equal(raw["opacity"].ravel(), ours.opacity_logits)
    np.testing.assert_array_equal(raw["obj_id"].ravel(), ours.object_ids)
    for c in range(3):
        np.testing.assert_array_equal(raw[f"f_rest_{c * 15 + 4}"].ravel(), ours.sh[:, 5, c])
    rest = np.stack([raw[f"rot_{i}"].ravel() for i in range(4)], -1)
    np.testing.assert_allclose(rest, ours.quats, atol=1e-6)


def test_inexact_transforms_of_the_export_are_reported(blender, loaded, tmp_path, capsys):
    cloud(loaded, "mug").scale = (1, 2, 1)
    cloud(loaded, "red apple").scale = (0, 0, 0)  # nothing visible, so nothing to export
    blender.context.view_layer.update()
    assert 2 not in export(blender, tmp_path / "a.ply").object_ids
    said = capsys.readouterr().out
    assert "mug: scaled non-uniformly" in said
    assert "red apple" not in said


def test_a_missing_folder_is_an_error_and_writes_no_file(blender, loaded, tmp_path):
    with pytest.raises(RuntimeError, match=r"a\.ply.*cannot be written"):
        blender.ops.r5dgs.export_ply(filepath=str(tmp_path / "none" / "a.ply"))
    assert not (tmp_path / "none").exists()


def test_ply_export_is_disabled_without_a_scene(blender):
    assert not blender.ops.r5dgs.export_ply.poll()


@pytest.mark.parametrize("operator", ["export_ply", "export_scene"])
def test_a_path_that_names_no_file_is_refused_and_none_is_written_beside_it(blender, loaded, operator, tmp_path):
    (tmp_path / "folder").mkdir()
    before = sorted(tmp_path.iterdir())
    for path in ("", "//", f"{tmp_path / 'folder'}/"):
        with pytest.raises(RuntimeError, match="export: expected a .* file, got .*; give it a name"):
            getattr(blender.ops.r5dgs, operator)(filepath=path)
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.parametrize("frame", [1, 30, 46, 60])
def test_the_command_writes_the_gaussians_that_blender_exports(blender, loaded, tmp_path, frame):
    blender.context.scene.frame_set(frame)
    theirs = export(blender, tmp_path / "blender.ply", axes="FILE")
    (path,) = export_command.run_export(
        tmp_path / "scene.r5dgs", "ply", tmp_path / "command.ply", times=((frame - 1) / loaded.r5dgs.frames_per_unit,)
    )
    ours = ply.read(path)
    assert len(ours.means) == len(theirs.means)
    first, second = (np.lexsort((s.opacity_logits, s.object_ids)) for s in (ours, theirs))
    for name in ("object_ids", "opacity_logits", "identities"):
        np.testing.assert_array_equal(getattr(ours, name)[first], getattr(theirs, name)[second])
    for name in ("means", "log_scales", "sh"):
        np.testing.assert_allclose(getattr(ours, name)[first], getattr(theirs, name)[second], atol=2e-4, err_msg=name)
    same = np.abs((ours.quats[first] * theirs.quats[second]).sum(-1))
    np.testing.assert_allclose(same, 1, atol=1e-5)
