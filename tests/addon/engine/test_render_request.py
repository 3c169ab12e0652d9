"""A render request holds every loaded scene, as evaluated by the depsgraph, and works for any camera."""

import dataclasses
import importlib

import numpy as np
import pytest

from r5dgs_core.data import images
from r5dgs_core.playback import scene_player
from r5dgs_core.render import incremental_renderer, scene_renderer
from r5dgs_core.scene import cameras, scene_file
from r5dgs_core.scene.instance import Instance
from tests.support import motions, scenes, tiny_datasets

pytest.importorskip("bpy", reason="bpy is not installed; it comes with the extra 'test' on Python 3.11")

from mathutils import Matrix  # noqa: E402  (bpy brings it)

from tests.addon.engine.test_preview import go_to, place_camera, psnr  # noqa: E402

W = cameras.WORLD_TO_BLENDER["colmap"]


@pytest.fixture
def picture(blender, monkeypatch):
    monkeypatch.delenv("R5DGS_PYTHON", raising=False)
    return importlib.import_module("r5dgs.r5dgs_addon.engine.render_request")


@pytest.fixture
def load(blender, tmp_path):
    """Loads a synthetic scene. Returns its collection and the content of its file."""

    def loaded(name, **options):
        made = dataclasses.replace(scenes.make_scene(world_convention="colmap", **options), name=name)
        path = scene_file.write(made, tmp_path / f"{name}.r5dgs")
        return motions.load_again(blender, path), scene_file.read(path)

    return loaded


@pytest.fixture
def kitchen(blender, load):
    """A scene at its last observed time, where anchor and parent inverse cancel, before its own camera."""
    collection, scene = load("kitchen", n=400, objects=3, sh_degree=2, seed=4)
    place_camera(blender, collection, scene.cameras[0])
    go_to(blender, scene.t_max)
    return collection, scene


def shown(bpy, picture):
    return picture.shown(bpy.context.evaluated_depsgraph_get())


def drawn(bpy, picture, **options):
    seen = shown(bpy, picture)
    return seen, picture.render(seen, **options)[1]


def affine(linear, translation=(0, 0, 0)):
    result = np.eye(4)
    result[:3, :3], result[:3, 3] = linear, translation
    return result


def everything(scene, matrix, number=0):
    """All clouds of a scene, with world and bind state moved by a matrix; both give the same positions at t_max."""
    return Instance(0, len(scene.gaussians.means), matrix, number, matrix)


def core_color(several, instances, camera, sky=None):
    return incremental_renderer.IncrementalRenderer(several).render(instances, camera, sky=sky).color


def test_two_loaded_scenes_are_both_in_the_picture(blender, picture, load, kitchen):
    first, scene = kitchen
    second, other = load("shed", n=300, objects=2, sh_degree=0, seed=7)
    second.r5dgs.root.location = (0.2, 0.1, 0.3)
    go_to(blender, scene.t_max)
    seen, arrays = drawn(blender, picture, want=("owners",))
    moved = affine(W, (0.2, 0.1, 0.3))
    expected = core_color(
        [scene, other],
        [everything(scene, affine(W)), everything(other, moved, 1)],
        seen.camera,
        incremental_renderer.Sky(0, affine(W)),
    )
    assert seen.scenes == (first, second)
    assert psnr(arrays["color"], expected) > 45
    owners = {seen.instances[i].collection for i in np.unique(arrays["owners"]) if i >= 0}
    assert owners == {first, second}


def test_a_scene_loaded_twice_is_drawn_twice(blender, picture, kitchen):
    first, scene = kitchen
    assert blender.ops.r5dgs.load_scene(filepath=str(picture.scene_path(first))) == {"FINISHED"}
    second = next(c for c in blender.data.collections if c.r5dgs.is_scene and c != first)
    second.r5dgs.root.location = (0.4, 0.0, 0.1)
    go_to(blender, scene.t_max)
    seen, arrays = drawn(blender, picture)
    both = [everything(scene, affine(W)), everything(scene, affine(W, (0.4, 0.0, 0.1)))]
    assert seen.scenes == (first, second)
    assert psnr(arrays["color"], core_color(scene, both, seen.camera, incremental_renderer.Sky(0, affine(W)))) > 45


def test_exact_mode_renders_deformed_gaussians(blender, picture, load, tmp_path):
    made = tiny_datasets.breathing(tiny_datasets.make_truth(), 0.4)
    path = scene_file.write(made, tmp_path / "balloon.r5dgs")
    collection = motions.load(blender, path, bend=False)
    place_camera(blender, collection, made.cameras[0], made.world_convention)
    scene, t = scene_file.read(path), 0.2
    blender.context.scene.frame_set(int(1 + scene.frames_per_unit * t))
    expected = scene_renderer.render_frame(scene, scene_player.Player(scene).frame(t), scene.cameras[0]).color
    stiff = drawn(blender, picture)[1]["color"]
    collection.r5dgs_exact.enabled = True
    exact = drawn(blender, picture)[1]["color"]
    assert psnr(exact, expected) > 45 and psnr(stiff, expected) < 40


def test_an_invisible_scene_needs_no_file(blender, picture, load, kitchen):
    first, scene = kitchen
    hidden, _ = load("shed", n=300, objects=2, seed=7)
    picture.scene_path(hidden).unlink()
    with pytest.raises(RuntimeError, match="shed.r5dgs.*Scene File"):
        blender.ops.r5dgs.preview()
    for obj in hidden.all_objects:
        obj.hide_set(True)
    assert shown(blender, picture).scenes == (first,)
    assert blender.ops.r5dgs.preview() == {"FINISHED"}


def test_a_completely_hidden_scene_leaves_its_sky(blender, picture, kitchen):
    collection, scene = kitchen
    for obj in collection.all_objects:
        obj.hide_set(True)
    seen, arrays = drawn(blender, picture)
    assert seen.instances == () and seen.scenes == (collection,)
    assert psnr(arrays["color"], core_color(scene, [], seen.camera, incremental_renderer.Sky(0, affine(W)))) > 60


def test_an_instanced_collection_is_drawn_at_its_instance(blender, picture, kitchen):
    collection, scene = kitchen
    instancer = blender.data.objects.new("copy", None)
    instancer.instance_type, instancer.instance_collection = "COLLECTION", collection
    instancer.matrix_world = Matrix.Translation((0.3, -0.2, 0.1)) @ Matrix.Rotation(0.6, 4, "Z") @ Matrix.Scale(0.8, 4)
    blender.context.scene.collection.objects.link(instancer)
    blender.context.view_layer.update()
    copy = np.array(instancer.matrix_world) @ affine(W)
    seen, arrays = drawn(blender, picture)
    both = [everything(scene, affine(W)), everything(scene, copy)]
    assert psnr(arrays["color"], core_color(scene, both, seen.camera, incremental_renderer.Sky(0, affine(W)))) > 45
    # Excluded from the view layer, the scene is visible only through its instance.
    blender.context.view_layer.layer_collection.children[collection.name].exclude = True
    seen, arrays = drawn(blender, picture)
    assert {one.parent for one in seen.instances} == {instancer}
    assert psnr(arrays["color"], core_color(scene, both[1:], seen.camera, incremental_renderer.Sky(0, affine(W)))) > 45


def test_objects_of_hidden_collections_are_not_rendered(blender, picture, kitchen):
    collection, _ = kitchen
    layer = blender.context.view_layer.layer_collection.children[collection.name]
    layer.children["mug"].exclude = True
    layer.children["red apple"].hide_viewport = True
    names = {one.object.name for one in shown(blender, picture).instances}
    assert "toy car" in names and not {"mug", "red apple"} & names
    layer.exclude = True
    assert shown(blender, picture).instances == shown(blender, picture).scenes == ()


def test_a_copy_outside_its_collection_belongs_to_its_scene(blender, picture, kitchen):
    collection, scene = kitchen
    apple = collection.all_objects["red apple"]
    copy = apple.copy()
    blender.context.scene.collection.objects.link(copy)
    copy.matrix_basis = Matrix.Translation((0.0, 0.0, 0.4))
    seen, arrays = drawn(blender, picture)
    extra = Instance(apple.r5dgs.start, apple.r5dgs.count, affine(W) @ affine(np.eye(3), (0, 0, 0.4)), 0, affine(W))
    expected = core_color(
        scene, [everything(scene, affine(W)), extra], seen.camera, incremental_renderer.Sky(0, affine(W))
    )
    assert psnr(arrays["color"], expected) > 45


def test_a_root_may_be_scaled_by_axis_and_mirrored(blender, picture, kitchen):
    collection, scene = kitchen
    root = collection.r5dgs.root
    root.scale = (1.0, -0.7, 1.3)
    blender.context.view_layer.update()
    seen, arrays = drawn(blender, picture)
    matrix = affine(np.array(root.matrix_world)[:3, :3])
    expected = core_color(scene, [everything(scene, matrix)], seen.camera, incremental_renderer.Sky(0, matrix))
    assert psnr(arrays["color"], expected) > 45


def test_a_root_that_is_scaled_to_nothing_shows_nothing(blender, picture, kitchen):
    kitchen[0].r5dgs.root.scale = (0, 0, 0)
    seen, arrays = drawn(blender, picture, sky=False)
    assert seen.instances == () and arrays["color"].max() == 0


def test_a_tint_recolours_a_cloud(blender, picture, kitchen):
    collection, scene = kitchen
    mug = collection.all_objects["mug"]
    mug.r5dgs_look.tint = (0.2, 1.0, 0.5)
    seen, arrays = drawn(blender, picture, sky=False)
    instances = []
    for obj in collection.all_objects:
        if obj.r5dgs.role == "CLOUD":
            tint = (0.2, 1.0, 0.5) if obj == mug else None
            instances.append(Instance(obj.r5dgs.start, obj.r5dgs.count, affine(W), 0, affine(W), tint))
    assert psnr(arrays["color"], core_color(scene, instances, seen.camera)) > 45


def test_points_that_were_deleted_are_not_drawn(blender, picture, kitchen):
    collection, scene = kitchen
    mug = collection.all_objects["mug"]
    start, count = mug.r5dgs.start, mug.r5dgs.count
    keep = np.ones(count, bool)
    keep[3:9] = keep[-5:] = False
    mug.data = without(blender, mug.data, np.arange(start, start + count)[keep])
    seen, arrays = drawn(blender, picture, sky=False)
    rows = np.setdiff1d(np.arange(len(scene.gaussians.means)), np.arange(start, start + count)[~keep])
    cuts = np.flatnonzero(np.diff(rows) != 1) + 1
    parts = [Instance(int(part[0]), len(part), affine(W), 0, affine(W)) for part in np.split(rows, cuts)]
    assert psnr(arrays["color"], core_color(scene, parts, seen.camera)) > 45


def test_points_without_required_attributes_are_refused(blender, picture, kitchen):
    mug = kitchen[0].all_objects["mug"]
    mug.data = without(blender, mug.data, np.arange(5), named=False)
    with pytest.raises(RuntimeError, match="mug: expected its .* points, found 5.*load the scene again"):
        blender.ops.r5dgs.preview()


def without(bpy, old, rows, named=True):
    """Cloud with the points of some rows, as if the others were deleted."""
    compat = importlib.import_module("r5dgs.r5dgs_addon.compat")
    clouds = importlib.import_module("r5dgs.r5dgs_addon.scene.point_clouds")
    (cloud,) = compat.new_point_clouds([len(rows)])
    fields = {
        "FLOAT": ("value", 1),
        "FLOAT_VECTOR": ("vector", 3),
        "FLOAT_COLOR": ("color", 4),
        "QUATERNION": ("value", 4),
    }
    own = clouds.read(clouds.attribute(old, clouds.ROW, "INT"), "value", 1, np.int32)[:, 0]
    kept = np.isin(own, rows) if named else np.arange(len(own)) < len(rows)
    for one in old.attributes:
        field, width, dtype = (
            *fields.get(one.data_type, ("value", 1)),
            np.int32 if one.data_type == "INT" else np.float32,
        )
        if named or one.name != clouds.ROW:
            made = cloud.attributes.get(one.name) or cloud.attributes.new(one.name, one.data_type, "POINT")
            made.data.foreach_set(field, clouds.read(one, field, width, dtype)[kept].ravel())
    return cloud


@pytest.mark.parametrize("border", [(0.0, 1.0, 0.0, 1.0), (0.21, 0.73, 0.1, 0.58), (0.5, 0.5, 0.9, 1.0)])
def test_a_border_cuts_the_picture(blender, picture, kitchen, border):
    whole = drawn(blender, picture)[1]["color"]
    render = blender.context.scene.render
    render.use_border = True
    render.border_min_x, render.border_max_x, render.border_min_y, render.border_max_y = border
    part = drawn(blender, picture)[1]["color"]
    height, width = whole.shape[:2]
    left, right, bottom, top = (int(b * size) for b, size in zip(border, (width, width, height, height), strict=True))
    expected = whole[height - top : height - bottom, left : max(right, left + 1)]
    assert part.shape == expected.shape and psnr(part, expected) > 45


def orthographic(bpy, scale):
    data = bpy.context.scene.camera.data
    data.type, data.ortho_scale, data.shift_x, data.shift_y = "ORTHO", scale, 0.07, -0.04


def test_an_orthographic_camera_projects_in_parallel(blender, picture, kitchen):
    from bpy_extras.object_utils import world_to_camera_view

    _, scene = kitchen
    orthographic(blender, 3.0)
    blender.context.scene.render.resolution_x = 800
    blender.context.scene.render.resolution_y = 600
    seen = shown(blender, picture)
    points = scene_points(scene)[::7]
    pixels, depth = cameras.project(seen.camera, points)
    camera = blender.context.scene.camera
    for point, pixel, z in zip(points, pixels, depth, strict=True):
        x, y, distance = world_to_camera_view(blender.context.scene, camera, Matrix.Translation(point).translation)
        np.testing.assert_allclose(pixel, [x * 800, (1 - y) * 600], atol=0.1)
        assert z - seen.view.distance == pytest.approx(distance, abs=1e-4)


def test_an_orthographic_picture_has_depths_from_its_camera_and_nothing_behind_it(blender, picture, kitchen):
    camera = blender.context.scene.camera
    orthographic(blender, 3.0)
    seen, arrays = drawn(blender, picture, want=("depth", "alpha"))
    solid = arrays["alpha"] > 0.9
    assert solid.any() and arrays["color"].shape == (seen.camera.height, seen.camera.width, 3)
    corners = scene_points(kitchen[1])
    forward = -np.array(camera.matrix_world)[:3, 2]
    depths = (corners - np.array(camera.matrix_world)[:3, 3]) @ forward
    assert depths.min() - 0.01 < arrays["depth"][solid].min() <= arrays["depth"][solid].max() < depths.max() + 0.01
    # The camera moves until everything is behind it.
    camera.matrix_world = Matrix.Translation(forward * float(depths.max() + 0.1)) @ camera.matrix_world
    assert drawn(blender, picture, want=("alpha",))[1]["alpha"].max() == 0


def scene_points(scene):
    return scene.gaussians.means.astype(np.float64) @ W.T


def test_a_region_that_looks_through_a_camera_has_the_cameras_view(blender, picture, kitchen):
    """Uses a stand-in for a window's region, because bpy has none."""
    import types

    views = importlib.import_module("r5dgs.r5dgs_addon.engine.view_cameras")
    visible = importlib.import_module("r5dgs.r5dgs_addon.engine.visible_clouds")
    scene, camera = blender.context.scene, blender.context.scene.camera
    depsgraph = blender.context.evaluated_depsgraph_get()
    _, found = visible.instances(depsgraph)
    for kind in ("PERSP", "ORTHO"):
        camera.data.type = kind
        depsgraph = blender.context.evaluated_depsgraph_get()
        expected = views.of_camera(depsgraph, visible.points(found))
        width, height = views.size_of(scene)
        projection = camera.calc_matrix_camera(depsgraph, x=width, y=height)
        region = types.SimpleNamespace(width=width, height=height)
        region_3d = types.SimpleNamespace(
            view_matrix=camera.matrix_world.inverted(), window_matrix=projection, is_perspective=kind == "PERSP"
        )
        view = views.of_region(region, region_3d, visible.points(found))
        np.testing.assert_allclose(view.camera.intrinsics, expected.camera.intrinsics, rtol=1e-5, atol=1e-3)
        np.testing.assert_allclose(view.camera.T_cam_world, expected.camera.T_cam_world, rtol=1e-5, atol=1e-5)
        assert view.near is None and (view.distance == 0) == (kind == "PERSP")


def test_the_previews_image_saves_its_own_bytes_under_every_view(blender, picture, tmp_path):
    color = np.random.default_rng(0).integers(0, 256, (20, 30, 3)) / 255
    image = picture.write_image(picture.IMAGE, color)
    assert not image.use_view_as_render
    image.file_format = "PNG"
    for view in ("AgX", "Filmic", "Standard"):
        blender.context.scene.view_settings.view_transform = view
        image.save(filepath=str(tmp_path / f"{view}.png"))
        np.testing.assert_allclose(images.read(tmp_path / f"{view}.png")[..., :3], color, atol=1e-6)
