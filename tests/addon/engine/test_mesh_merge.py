"""Merge with Meshes: F12 shows meshes by Cycles among the Gaussians, and every change can be undone."""

import numpy as np
import pytest

from r5dgs_core.data import images
from r5dgs_core.scene import scene_file
from tests.support import motions, scenes

pytest.importorskip("bpy", reason="bpy is not installed; it comes with the extra 'test' on Python 3.11")
SIZE = 96, 72


@pytest.fixture
def scene(blender, tmp_path, monkeypatch):
    """Blender's scene with Gaussians and a red wall that glows, seen by one camera."""
    monkeypatch.delenv("R5DGS_PYTHON", raising=False)
    for obj in list(blender.data.objects):
        if obj.type != "CAMERA":
            blender.data.objects.remove(obj)
    path = scene_file.write(scenes.make_scene(n=600, objects=3, seed=4), tmp_path / "scene.r5dgs")
    blender.ops.r5dgs.load_scene(filepath=str(path))
    scene = blender.context.scene
    scene.frame_set(46)
    scene.camera = blender.data.objects["Camera"]
    scene.camera.location, scene.camera.rotation_euler = (0, -5, 1), (1.4, 0, 0)
    render = scene.render
    render.resolution_x, render.resolution_y = SIZE
    render.resolution_percentage, render.dither_intensity = 100, 0
    scene.view_settings.view_transform = "Standard"
    mesh = blender.data.meshes.new("wall")
    mesh.from_pydata([(-0.7, 0.1, -9), (0.7, 0.1, -9), (0.7, 0.1, 9), (-0.7, 0.1, 9)], [], [(0, 1, 2, 3)])
    material = blender.data.materials.new("red")
    material.use_nodes = True
    shader = material.node_tree.nodes["Principled BSDF"]
    shader.inputs["Base Color"].default_value = (0, 0, 0, 1)
    shader.inputs["Emission Color"].default_value, shader.inputs["Emission Strength"].default_value = (1, 0, 0, 1), 1
    mesh.materials.append(material)
    scene.collection.objects.link(blender.data.objects.new("wall", mesh))
    blender.context.view_layer.update()
    return scene


def merge(blender):
    assert blender.ops.r5dgs.merge_with_meshes() == {"FINISHED"}
    meshes = blender.context.scene.r5dgs_render.meshes
    meshes.cycles.samples, meshes.cycles.use_denoising = 16, False
    return meshes


def picture(blender, path):
    scene = blender.context.scene
    scene.render.filepath, scene.render.image_settings.file_format = str(path), "PNG"
    assert blender.ops.render.render(write_still=True) == {"FINISHED"}
    return images.read(path)[..., :3]


def expected(blender, scene, tmp_path):
    """Pictures without the wall, and of the Gaussians in front of it."""
    wall = blender.data.objects["wall"]
    wall.hide_render = True
    without = picture(blender, tmp_path / "without.png")
    wall.hide_render = False
    return without


def test_f12_shows_the_nearer_of_gaussians_and_meshes_with_soft_edges(blender, scene, tmp_path):
    blender.ops.r5dgs.use_engine()
    without = expected(blender, scene, tmp_path)
    merge(blender)
    found = picture(blender, tmp_path / "merged.png")
    red = np.array([1.0, 0, 0])
    is_red = np.abs(found - red).max(-1) < 0.1  # the world is reflected
    is_kept = np.abs(found - without).max(-1) < 0.02
    columns = np.flatnonzero(is_red.mean(0) > 0.2)
    assert len(columns) > 8, "the wall is not visible"
    inside = slice(columns[0] + 2, columns[-1] - 1)
    outside = np.r_[0 : columns[0] - 6, columns[-1] + 7 : SIZE[0]]
    assert is_kept[:, outside].mean() > 0.999  # nothing changes beside the wall
    front = is_kept[:, inside] & ~is_red[:, inside]
    assert is_red[:, inside].mean() > 0.3 and front.sum() > 20
    edge = found[:, columns[0] - 2 : columns[0] + 1, 0]
    assert ((edge > 0.05) & (edge < 0.98)).any()


def test_the_merge_survives_saving_and_renders_animations(blender, scene, tmp_path):
    merge(blender)
    before = picture(blender, tmp_path / "before.png")
    blender.ops.wm.save_as_mainfile(filepath=str(tmp_path / "merged.blend"))
    blender.ops.wm.read_homefile(app_template="")
    blender.ops.wm.open_mainfile(filepath=str(tmp_path / "merged.blend"))
    np.testing.assert_array_equal(picture(blender, tmp_path / "after.png"), before)
    scene = blender.context.scene
    scene.frame_start, scene.frame_end = 46, 47
    scene.render.filepath = str(tmp_path / "frame")
    blender.ops.render.render(animation=True)
    np.testing.assert_array_equal(images.read(tmp_path / "frame0046.png")[..., :3], before)
    assert (images.read(tmp_path / "frame0047.png")[..., :3] != before).any()


def test_settings_that_change_after_the_click_apply_to_the_meshes(blender, scene, tmp_path):
    meshes = merge(blender)
    scene.render.resolution_x = 64
    other = blender.data.objects.new("other", scene.camera.data)
    scene.collection.objects.link(other)
    scene.timeline_markers.new("cut", frame=50).camera = other
    picture(blender, tmp_path / "small.png")
    assert meshes.render.resolution_x == 64 and [one.camera for one in meshes.timeline_markers] == [other]


def traces(blender):
    tree = motions.addon("compat").compositor(blender.context.scene)
    nodes = [] if tree is None else [node.name for node in tree.nodes]
    links = [] if tree is None else [(a.from_node.name, a.to_node.name) for a in tree.links]
    return sorted(one.name for one in blender.data.scenes), sorted(nodes), sorted(links)


def test_stop_merging_and_undo_remove_everything(blender, scene):
    blender.ops.r5dgs.use_engine()
    compat = motions.addon("compat")
    tree = compat.make_compositor(scene)
    blur = tree.nodes.new("CompositorNodeBlur")  # a user's own node stays in its place
    layers = tree.nodes.get("Render Layers") or tree.nodes.new("CompositorNodeRLayers")
    tree.links.new(layers.outputs["Image"], blur.inputs["Image"])
    tree.links.new(blur.outputs[0], compat.compositor_output(tree))
    blender.ops.ed.undo_push(message="before")
    before = traces(blender)
    blender.ops.r5dgs.merge_with_meshes()
    blender.ops.ed.undo_push(message="merged")
    after = traces(blender)
    assert ("R5DGS Merge", "Blur") in after[2] and ("Render Layers", "Blur") not in after[2]
    blender.ops.ed.undo()
    assert traces(blender) == before and blender.context.scene.r5dgs_render.meshes is None
    blender.ops.ed.redo()
    assert traces(blender) == after and blender.context.scene.r5dgs_render.meshes is not None
    assert blender.ops.r5dgs.merge_with_meshes() == {"FINISHED"}  # again: replaced, not doubled
    assert traces(blender) == after
    blender.ops.r5dgs.stop_merging()
    assert traces(blender) == before
    assert not [group for group in blender.data.node_groups if group.name.startswith("R5DGS Merge")]
    assert not blender.ops.r5dgs.stop_merging.poll()


def test_a_mesh_that_was_added_later_is_named(blender, scene):
    import importlib

    notes = importlib.import_module("r5dgs.r5dgs_addon.engine.render_notes")
    merge(blender)
    assert not notes.of(scene)
    scene.collection.objects.link(blender.data.objects.new("late", blender.data.meshes["wall"]))
    assert [note for note in notes.of(scene) if note.startswith("late: not merged")]
    merge(blender)
    assert not notes.of(scene)
