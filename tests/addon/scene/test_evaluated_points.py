"""Clouds are drawn and exported as Blender evaluates them: after nodes, edits of points and Apply Transform."""

import importlib

import numpy as np
import pytest

from r5dgs_core.data import images
from r5dgs_core.formats import ply
from r5dgs_core.playback import affine_transform
from r5dgs_core.render import posed_scene, scene_renderer
from r5dgs_core.scene import scene_file
from tests.support import motions, scenes

pytest.importorskip("bpy", reason="bpy is not installed; it comes with the extra 'test' on Python 3.11")

from mathutils import Euler, Matrix  # noqa: E402  (bpy brings it)


@pytest.fixture
def scene(tmp_path):
    made = scenes.make_scene(n=400, objects=3, sh_degree=2, seed=4, world_convention="colmap")
    return scene_file.read(scene_file.write(made, tmp_path / "scene.r5dgs"))


@pytest.fixture
def loaded(blender, scene, tmp_path):
    motions.load_again(blender, tmp_path / "scene.r5dgs")
    blender.context.scene.frame_set(40)
    return next(c for c in blender.data.collections if c.r5dgs.is_scene)


@pytest.fixture
def mug(loaded):
    """Cloud that its anchor has moved and rotated."""
    return next(o for o in loaded.all_objects if o.name == "mug" and o.r5dgs.role == "CLOUD")


@pytest.fixture
def visible():
    return importlib.import_module("r5dgs.r5dgs_addon.engine.visible_clouds")


@pytest.fixture
def cloud_points():
    return importlib.import_module("r5dgs.r5dgs_addon.scene.evaluated_points")


def nodes(bpy, obj, build):
    """A geometry nodes modifier; ``build`` links a tree's input to its output."""
    tree = bpy.data.node_groups.new("edit", "GeometryNodeTree")
    for in_out in ("INPUT", "OUTPUT"):
        tree.interface.new_socket("Geometry", in_out=in_out, socket_type="NodeSocketGeometry")
    build(tree, tree.nodes.new("NodeGroupInput").outputs[0], tree.nodes.new("NodeGroupOutput").inputs[0])
    modifier = obj.modifiers.new("edit", "NODES")
    modifier.node_group = tree
    return modifier


def chain(tree, source, *steps):
    """Nodes one after the other by kind and settings. Returns the last output."""
    for kind, settings in steps:
        node = tree.nodes.new(kind)
        tree.links.new(source, node.inputs[0])
        for name, value in settings.items():
            if hasattr(value, "links"):
                tree.links.new(value, node.inputs[name])
            else:
                node.inputs[name].default_value = value
        source = node.outputs[0]
    return source


def lowered(tree, source, target):
    """Set Position, the same way for all."""
    tree.links.new(chain(tree, source, ("GeometryNodeSetPosition", {"Offset": (0.3, -0.2, 0.1)})), target)


def bent(tree, source, target):
    """Set Position by noise: every point moves differently."""
    noise = tree.nodes.new("ShaderNodeTexNoise")
    noise.inputs["Scale"].default_value = 7.0
    vector = next(one for one in noise.outputs if one.name == "Color")
    tree.links.new(chain(tree, source, ("GeometryNodeSetPosition", {"Offset": vector})), target)


def halved(tree, source, target):
    """Delete Geometry of every other point."""
    index, odd = tree.nodes.new("GeometryNodeInputIndex"), tree.nodes.new("ShaderNodeMath")
    odd.operation = "MODULO"
    odd.inputs[1].default_value = 2.0
    tree.links.new(index.outputs[0], odd.inputs[0])
    tree.links.new(chain(tree, source, ("GeometryNodeDeleteGeometry", {"Selection": odd.outputs[0]})), target)


def turned(tree, source, target):
    """Transform Geometry."""
    node = tree.nodes.new("GeometryNodeTransform")
    node.inputs["Translation"].default_value = (0.1, 0.2, 0.3)
    node.inputs["Rotation"].default_value = (0.4, 0.5, 0.6)
    node.inputs["Scale"].default_value = (1.2, 1.2, 1.2)
    tree.links.new(source, node.inputs[0])
    tree.links.new(node.outputs[0], target)


def doubled(tree, source, target):
    """Join Geometry of the points and a turned copy of them, and of a point and a cube that are new."""
    node, join = tree.nodes.new("GeometryNodeTransform"), tree.nodes.new("GeometryNodeJoinGeometry")
    node.inputs["Translation"].default_value = (0.5, 0.2, 0.3)
    node.inputs["Rotation"].default_value = (0.4, 0.5, 0.6)
    tree.links.new(source, node.inputs[0])
    new = [tree.nodes.new(kind) for kind in ("GeometryNodePoints", "GeometryNodeMeshCube")]
    for made in (source, node.outputs[0], *(one.outputs[0] for one in new)):
        tree.links.new(made, join.inputs[0])
    tree.links.new(join.outputs[0], target)


def swaying(tree, source, target):
    """Set Position by the frame."""
    time, scaled = tree.nodes.new("GeometryNodeInputSceneTime"), tree.nodes.new("ShaderNodeCombineXYZ")
    tree.links.new(time.outputs["Frame"], scaled.inputs[0])
    tree.links.new(chain(tree, source, ("GeometryNodeSetPosition", {"Offset": scaled.outputs[0]})), target)


def viewport(bpy, obj):
    """Positions of a cloud's points as the viewport draws them, Blender's world, and their rows. [n, 3], [n]"""
    evaluated = obj.evaluated_get(bpy.context.evaluated_depsgraph_get())
    count = len(evaluated.data.points)
    points, rows = np.empty(3 * count, np.float32), np.empty(count, np.int32)
    evaluated.data.attributes["position"].data.foreach_get("vector", points)
    evaluated.data.attributes["gaussian"].data.foreach_get("value", rows)
    matrix = np.array(evaluated.matrix_world, np.float64)
    return points.reshape(-1, 3) @ matrix[:3, :3].T + matrix[:3, 3], rows


def export(bpy, folder, obj):
    """The Gaussians of an object that are exported."""
    for other in bpy.context.selected_objects:
        other.select_set(False)
    obj.select_set(True)
    assert bpy.ops.r5dgs.export_ply(filepath=str(folder / "a.ply"), which="SELECTED") == {"FINISHED"}
    return ply.read(folder / "a.ply")


def picture_of(splats, scene, view):
    """The core's picture of the Gaussians of a file. [H, W, 3]"""
    count = len(splats.means)
    posed = posed_scene.PosedScene(
        splats.means, splats.quats, splats.log_scales, splats.opacity_logits, splats.sh,
        np.zeros(count, np.int32), np.eye(3)[None], np.zeros(count, np.int64), None,
    )  # fmt: skip
    return scene_renderer.render_frame(scene, posed, view, background=None).color


def psnr(a, b):
    return -10 * np.log10(max(float(np.square(np.asarray(a, np.float64) - b).mean()), 1e-12))


@pytest.fixture
def rendered(blender, scene, loaded):
    """Function that returns the worker's image of the visible scene, and the camera."""
    picture, views = (
        importlib.import_module(f"r5dgs.r5dgs_addon.{name}")
        for name in ("engine.render_request", "engine.view_cameras")
    )
    data = blender.data.cameras.new("view")
    eye = blender.data.objects.new("view", data)
    blender.context.scene.collection.objects.link(eye)
    center = np.array(loaded.r5dgs.root.matrix_world)[:3, :3] @ scene.gaussians.means.mean(0)
    eye.location = center + np.array([0.0, -1.6, 0.6]) * scene.extent
    eye.rotation_euler = Euler((np.pi / 2 - 0.35, 0, 0))
    blender.context.scene.camera = eye
    blender.context.scene.render.resolution_x, blender.context.scene.render.resolution_y = 96, 72
    blender.context.scene.render.resolution_percentage = 100

    def take():
        depsgraph = blender.context.evaluated_depsgraph_get()
        seen = picture.shown(depsgraph, lambda points: views.of_camera(depsgraph, points))
        result, arrays = picture.render(seen, ("alpha",), sky=False)
        return arrays["color"], seen.camera, result

    return take


EDITS = (lowered, bent, halved, turned, doubled)


@pytest.mark.parametrize("build", EDITS)
def test_geometry_nodes_move_and_delete_drawn_and_exported_gaussians(
    blender, scene, loaded, mug, rendered, tmp_path, build
):
    before, _, _ = rendered()
    nodes(blender, mug, build)
    points, rows = viewport(blender, mug)
    splats = export(blender, tmp_path, mug)
    if build is doubled:  # one point is new, either the first or the last
        assert len(points) == 2 * mug.r5dgs.count + 1 and len(splats.means) == 2 * mug.r5dgs.count
        kept = slice(1, None) if np.allclose(points[1], splats.means[0], atol=1e-5) else slice(0, -1)
        points = points[kept]
    np.testing.assert_allclose(splats.means, points, atol=1e-5)
    after, camera, _ = rendered()
    assert psnr(before, after) < 40  # the edit is visible
    blender.ops.r5dgs.export_ply(filepath=str(tmp_path / "all.ply"), which="VISIBLE")
    assert psnr(picture_of(ply.read(tmp_path / "all.ply"), scene, camera), after) > 50


def test_a_cloud_without_edits_uses_the_scenes_own_rows(blender, loaded, visible):
    _, found = visible.instances(blender.context.evaluated_depsgraph_get())
    assert found and all(one.edit is None and one.count == len(one.object.data.points) for one in found)


def test_shapes_and_harmonics_turn_with_transform_geometry(blender, scene, mug, tmp_path):
    nodes(blender, mug, turned)
    turn = Matrix.LocRotScale((0.1, 0.2, 0.3), Euler((0.4, 0.5, 0.6)), (1.2, 1.2, 1.2))
    matrix = np.array(mug.matrix_world, np.float64) @ np.array(turn, np.float64)
    world = np.array(mug.parent.parent.matrix_world, np.float64)
    expected = affine_transform.place(scene, mug.r5dgs.start, mug.r5dgs.count, matrix, world=world)
    splats = export(blender, tmp_path, mug)
    np.testing.assert_allclose(splats.log_scales, expected.log_scales, atol=1e-4)
    np.testing.assert_allclose(np.abs((splats.quats * expected.quats).sum(-1)), 1, atol=1e-4)
    np.testing.assert_allclose(splats.sh, expected.sh, atol=1e-3)


@pytest.mark.parametrize("scale", [(1.5, 1.5, 1.5), (1.0, 2.0, 0.7), (-1.0, 1.0, 1.0)])
def test_apply_transform_keeps_the_picture(blender, loaded, mug, rendered, tmp_path, scale):
    for other in blender.context.selected_objects:
        other.select_set(False)
    mug.location, mug.rotation_euler, mug.scale = (0.3, -0.2, 0.1), (0.5, 0.6, -0.7), scale
    blender.context.view_layer.update()
    before, _, _ = rendered()
    splats = export(blender, tmp_path, mug)
    blender.context.view_layer.objects.active = mug
    assert blender.ops.object.transform_apply(location=True, rotation=True, scale=True) == {"FINISHED"}
    assert tuple(mug.scale) == (1, 1, 1) and tuple(mug.location) == (0, 0, 0)
    after, _, _ = rendered()
    assert psnr(before, after) > 55
    again = export(blender, tmp_path, mug)
    np.testing.assert_allclose(again.means, splats.means, atol=1e-5)
    np.testing.assert_allclose(again.log_scales, splats.log_scales, atol=1e-4)
    np.testing.assert_allclose(again.sh, splats.sh, atol=1e-3)


def test_edited_points_are_drawn_where_they_are_and_undone_with_the_edit(blender, mug, rendered, tmp_path):
    before, _, _ = rendered()
    places = [tuple(point.co) for point in mug.data.points]
    for point in list(mug.data.points)[::2]:
        point.co = (point.co[0] + 0.4, point.co[1], point.co[2])
    points, _ = viewport(blender, mug)
    np.testing.assert_allclose(export(blender, tmp_path, mug).means, points, atol=1e-5)
    assert psnr(before, rendered()[0]) < 40
    for point, place in zip(mug.data.points, places, strict=True):
        point.co = place
    np.testing.assert_array_equal(rendered()[0], before)


def test_edited_attributes_reshape_recolour_and_fade(blender, mug, rendered, tmp_path):
    count = mug.r5dgs.count
    scales, base = np.empty(3 * count, np.float32), np.empty(4 * count, np.float32)
    mug.data.attributes["scale"].data.foreach_get("vector", scales)
    mug.data.attributes["radiance:base"].data.foreach_get("color", base)
    base = base.reshape(-1, 4) * np.float32([1, 0.2, 0.2, 0.5])
    mug.data.attributes["scale"].data.foreach_set("vector", 0.5 * scales)
    mug.data.attributes["radiance:base"].data.foreach_set("color", base.ravel())
    mug.data.update_tag()
    splats = export(blender, tmp_path, mug)
    world = np.cbrt(np.linalg.det(np.array(mug.matrix_world, np.float64)[:3, :3]))
    np.testing.assert_allclose(
        np.sort(np.exp(splats.log_scales)), np.sort(0.5 * world * scales.reshape(-1, 3)), rtol=1e-4
    )
    np.testing.assert_allclose(1 / (1 + np.exp(-splats.opacity_logits)), base[:, 3], rtol=1e-4)


def test_an_animated_modifier_is_followed_frame_by_frame(blender, mug, visible):
    nodes(blender, mug, swaying)
    shifts = []
    for frame, sub in ((40, 0.0), (40, 0.5), (41, 0.0)):
        blender.context.scene.frame_set(frame, subframe=sub)
        _, found = visible.instances(blender.context.evaluated_depsgraph_get())
        one = next(one for one in found if one.object == mug)
        shifts.append(float(one.edit.points.means[0, 0]))
    np.testing.assert_allclose(np.diff(shifts), 0.5, atol=1e-4)


def test_ellipsoids_leave_nodes_and_points_as_they_are(blender, loaded, mug, tmp_path, visible):
    blender.ops.r5dgs.set_display(display="ELLIPSOIDS")
    _, found = visible.instances(blender.context.evaluated_depsgraph_get())
    assert found and all(one.edit is None for one in found)
    modifier = nodes(blender, mug, lowered)
    with blender.context.temp_override(object=mug, active_object=mug):
        blender.ops.object.modifier_move_to_index(modifier=modifier.name, index=0)
    points, _ = viewport(blender, mug)
    np.testing.assert_allclose(export(blender, tmp_path, mug).means, points, atol=1e-5)


def test_edits_survive_saving_and_loading(blender, mug, rendered, tmp_path):
    mug.data.points[0].co = (9, 9, 9)
    for point in list(mug.data.points)[::2]:
        point.co = (point.co[0] + 0.4, point.co[1], point.co[2])
    before, _, _ = rendered()
    blender.ops.wm.save_as_mainfile(filepath=str(tmp_path / "edited.blend"))
    blender.ops.wm.open_mainfile(filepath=str(tmp_path / "edited.blend"))
    np.testing.assert_array_equal(rendered()[0], before)


def test_points_that_cannot_be_drawn_are_reported(blender, loaded, mug, cloud_points, visible, tmp_path, capfd):
    nodes(blender, mug, doubled)
    visible.instances(blender.context.evaluated_depsgraph_get())
    said = " | ".join(cloud_points.notes(loaded))
    assert "1 point without a Gaussian" in said and "mesh made by its modifiers" in said
    export(blender, tmp_path, mug)
    assert "mesh made by its modifiers" in capfd.readouterr().out


def test_undrawable_points_of_a_linked_scene_are_reported_at_its_instance(blender, mug, visible, tmp_path):
    nodes(blender, mug, doubled)
    library = str(tmp_path / "library.blend")
    blender.ops.wm.save_as_mainfile(filepath=library)
    blender.ops.wm.read_homefile(app_template="")
    with blender.data.libraries.load(library, link=True) as (source, target):
        target.collections = [name for name in source.collections if name.startswith("R5DGS")]
    instancer = blender.data.objects.new("instancer", None)
    instancer.instance_type, instancer.instance_collection = "COLLECTION", target.collections[0]
    blender.context.scene.collection.objects.link(instancer)
    visible.instances(blender.context.evaluated_depsgraph_get())
    said = importlib.import_module("r5dgs.r5dgs_addon.engine.render_notes").of(blender.context.scene)
    assert any("1 point without a Gaussian" in note for note in said)


def test_unrealized_instances_and_radii_are_named(blender, loaded, mug, cloud_points, visible):
    def instanced(tree, source, target):
        tree.links.new(chain(tree, source, ("GeometryNodeGeometryToInstance", {})), target)

    modifier = nodes(blender, mug, instanced)
    visible.instances(blender.context.evaluated_depsgraph_get())
    assert any("Realize Instances" in note for note in cloud_points.notes(loaded))
    mug.modifiers.remove(modifier)
    visible.instances(blender.context.evaluated_depsgraph_get())
    assert cloud_points.notes(loaded) == []
    mug.data.points[0].radius = 3.0
    visible.instances(blender.context.evaluated_depsgraph_get())
    assert any("radius" in note for note in cloud_points.notes(loaded))


def test_unchanged_points_are_compared_once(blender, mug, visible, cloud_points, monkeypatch):
    clouds, counted = importlib.import_module("r5dgs.r5dgs_addon.scene.point_clouds"), []
    plain = clouds.fingerprint
    monkeypatch.setattr(clouds, "fingerprint", lambda values: counted.append(1) or plain(values))
    nodes(blender, mug, lowered)
    visible.instances(blender.context.evaluated_depsgraph_get())
    assert counted
    counted.clear()
    for _ in range(3):
        mug.location.x += 0.1
        visible.instances(blender.context.evaluated_depsgraph_get())
    assert not counted
    mug.data.points[0].co = (1, 2, 3)
    visible.instances(blender.context.evaluated_depsgraph_get())
    assert counted


def test_an_edited_scene_contains_points_changed_by_nodes_and_edits(blender, loaded, mug, rendered, tmp_path, capfd):
    apple = next(o for o in loaded.all_objects if o.name == "red apple" and o.r5dgs.role == "CLOUD")
    nodes(blender, mug, doubled)
    nodes(blender, apple, halved)
    before, _, _ = rendered()
    path = tmp_path / "edited.r5dgs"
    assert blender.ops.r5dgs.export_scene(filepath=str(path)) == {"FINISHED"}
    assert "1 point without a Gaussian" in capfd.readouterr().out
    written = scene_file.read(path)
    assert written.object(1).count == 2 * mug.r5dgs.count and written.object(2).count == apple.r5dgs.count // 2
    for obj in list(loaded.all_objects):
        blender.data.objects.remove(obj)
    blender.data.collections.remove(loaded)
    blender.ops.r5dgs.load_scene(filepath=str(path), fit_timeline=False)
    blender.context.scene.frame_set(40)
    assert psnr(before, rendered()[0]) > 50


def test_apply_transform_leaves_the_numbers_of_the_edited_scene(blender, scene, loaded, mug, tmp_path):
    mug.location, mug.rotation_euler = (0.3, -0.2, 0.1), (0.5, 0.6, -0.7)
    blender.ops.r5dgs.export_scene(filepath=str(tmp_path / "before.r5dgs"))
    for other in blender.context.selected_objects:
        other.select_set(False)
    mug.select_set(True)
    blender.context.view_layer.objects.active = mug
    blender.ops.object.transform_apply(location=True, rotation=True, scale=True)
    blender.ops.r5dgs.export_scene(filepath=str(tmp_path / "after.r5dgs"))
    before, after = (scene_file.read(tmp_path / name) for name in ("before.r5dgs", "after.r5dgs"))
    for name in ("means", "quats", "log_scales", "sh", "shading", "track_poses"):
        np.testing.assert_allclose(after.arrays()[name], before.arrays()[name], atol=2e-4, err_msg=name)


def test_animated_node_points_are_reported_as_exported_at_their_last_frame(blender, mug, tmp_path, capfd):
    nodes(blender, mug, swaying)
    blender.ops.r5dgs.export_scene(filepath=str(tmp_path / "a.r5dgs"))
    assert "mug: points that modifiers animate" in capfd.readouterr().out


@pytest.fixture
def engine(blender, rendered, monkeypatch):
    monkeypatch.delenv("R5DGS_PYTHON", raising=False)
    blender.ops.r5dgs.use_engine()
    return rendered


def render(bpy, folder, name="out", **arguments):
    """Picture that F12 saves, 8 bits per channel divided by 255. [H, W, 3]"""
    settings = bpy.context.scene.render
    settings.filepath, settings.dither_intensity = str(folder / name), 0.0
    settings.image_settings.file_format, settings.image_settings.color_mode = "PNG", "RGB"
    assert bpy.ops.render.render(**(arguments or {"write_still": True})) == {"FINISHED"}
    return images.read(settings.filepath + ".png") if not arguments else None


@pytest.mark.parametrize("build", (bent, halved))
def test_f12_matches_the_preview_of_the_evaluated_cloud(blender, mug, engine, tmp_path, build):
    blender.context.scene.r5dgs_render.sky = False
    before = render(blender, tmp_path, "before")
    nodes(blender, mug, build)
    after = render(blender, tmp_path, "after")
    assert psnr(before, after) < 40 and psnr(after, np.clip(engine()[0], 0, 1)) > 45


def test_f12_draws_points_that_a_script_changed_without_an_update(blender, mug, engine, tmp_path):
    before = render(blender, tmp_path, "before")
    points = np.empty(3 * mug.r5dgs.count, np.float32)
    mug.data.attributes["position"].data.foreach_get("vector", points)
    mug.data.attributes["position"].data.foreach_set("vector", points + np.float32(0.3))
    assert psnr(before, render(blender, tmp_path, "after")) < 40


def test_an_animation_follows_nodes_and_reports_ignored_parts_once(blender, loaded, mug, engine, tmp_path, capfd):
    for obj in loaded.all_objects:  # what rests
        obj.animation_data_clear()
    scene = blender.context.scene
    nodes(blender, mug, swaying)
    scene.frame_start, scene.frame_end = 1, 3
    mug.data.points[0].radius = 2.0
    render(blender, tmp_path, "frame_", animation=True)
    first, second, third = (images.read(tmp_path / f"frame_000{frame}.png") for frame in (1, 2, 3))
    assert psnr(first, second) < 40 and psnr(second, third) < 40
    said = capfd.readouterr().out
    assert said.count("the radius of points") == 1
