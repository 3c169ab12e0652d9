"""Gaussians and meshes are merged by depth in Blender's compositor."""

import importlib

import numpy as np
import pytest

from r5dgs_core.data import images
from r5dgs_core.scene import scene_file
from tests.support import motions, scenes

pytest.importorskip("bpy", reason="bpy is not installed; it comes with the extra 'test' on Python 3.11")
pytest.importorskip("torch", reason="torch is not installed in this Python, which runs the worker here")


def node_tree(bpy, scene):
    """Empty compositor of a scene and its output socket. From 5.0 on, the compositor is a node group."""
    if "compositing_node_group" in scene.bl_rna.properties:
        tree = scene.compositing_node_group = bpy.data.node_groups.new("merge", "CompositorNodeTree")
        tree.interface.new_socket("Image", in_out="OUTPUT", socket_type="NodeSocketColor")
        return tree, tree.nodes.new("NodeGroupOutput").inputs[0]
    scene.use_nodes = True
    scene.node_tree.nodes.clear()
    return scene.node_tree, scene.node_tree.nodes.new("CompositorNodeComposite").inputs["Image"]


@pytest.fixture
def merged(blender, tmp_path, monkeypatch):
    """Two Blender scenes of one camera, Gaussians by R5DGS and a wall by Cycles, and the first one's compositor."""
    monkeypatch.delenv("R5DGS_PYTHON", raising=False)
    gaussians = blender.context.scene
    for obj in list(blender.data.objects):
        if obj.type != "CAMERA":
            blender.data.objects.remove(obj)
    scene = scenes.make_scene(n=600, objects=3, seed=4)
    motions.load_again(blender, scene_file.write(scene, tmp_path / "scene.r5dgs"))
    blender.ops.r5dgs.use_engine()
    blender.ops.r5dgs.show_colors_as_trained()
    gaussians.frame_set(46)
    gaussians.camera = blender.data.objects["Camera"]
    gaussians.camera.location, gaussians.camera.rotation_euler = (0, -5, 1), (1.4, 0, 0)
    gaussians.view_layers[0].use_pass_z = True
    render = gaussians.render
    render.pixel_aspect_x = render.pixel_aspect_y = 1.0
    render.resolution_x, render.resolution_y, render.resolution_percentage, render.dither_intensity = 96, 72, 100, 0

    meshes = blender.data.scenes.new("meshes")
    meshes.collection.objects.link(gaussians.camera)
    meshes.camera = gaussians.camera
    mesh = blender.data.meshes.new("wall")
    mesh.from_pydata([(-9, 0.1, -9), (9, 0.1, -9), (9, 0.1, 9), (-9, 0.1, 9)], [], [(0, 1, 2, 3)])
    meshes.collection.objects.link(blender.data.objects.new("wall", mesh))
    meshes.view_layers[0].use_pass_z = True
    meshes.render.engine, meshes.cycles.samples, meshes.cycles.use_denoising = "CYCLES", 1, False
    meshes.render.resolution_x, meshes.render.resolution_y = 96, 72
    meshes.render.resolution_percentage = 100

    tree, output = node_tree(blender, gaussians)
    combine = tree.nodes.new("CompositorNodeZcombine")
    for index, source in enumerate((gaussians, meshes)):
        layers = tree.nodes.new("CompositorNodeRLayers")
        layers.scene, layers.layer = source, source.view_layers[0].name
        tree.links.new(layers.outputs["Image"], combine.inputs[2 * index])
        tree.links.new(layers.outputs["Depth"], combine.inputs[2 * index + 1])
    tree.links.new(combine.outputs[0], output)
    return gaussians


def test_the_nearer_of_gaussians_and_meshes_is_visible(blender, merged, tmp_path):
    picture = importlib.import_module("r5dgs.r5dgs_addon.engine.render_request")
    merged.render.filepath = str(tmp_path / "merged.png")
    merged.render.image_settings.file_format = "PNG"
    assert blender.ops.render.render(write_still=True) == {"FINISHED"}
    found = images.read(merged.render.filepath)[..., :3]
    _, arrays = picture.render(picture.shown(blender.context.evaluated_depsgraph_get()), ("depth", "alpha"))
    wall = 5.1 / np.cos(np.pi / 2 - 1.4)  # along the camera's axis, at the middle of the picture
    solid = arrays["alpha"] > 0.6
    nearer = solid & (arrays["depth"] < wall - 1)
    farther = solid & (arrays["depth"] > wall + 1)
    same = np.abs(found - np.clip(arrays["color"], 0, 1)).max(axis=-1) < 3 / 255
    assert nearer.sum() > 50 and farther.sum() > 50
    assert same[nearer].mean() > 0.8 and same[farther].mean() < 0.05  # the node softens borders
    behind = arrays["alpha"] < 0.4  # the sky is behind everything, and so behind the wall
    assert behind.sum() > 50 and same[behind].mean() < 0.05
