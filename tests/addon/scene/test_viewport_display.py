"""Display of Gaussians in viewports: splats, points, or ellipsoids with their size, orientation and opacity."""

import numpy as np
import pytest

from r5dgs_core.motion import rotations
from r5dgs_core.playback import scene_player
from r5dgs_core.scene import scene_file
from tests.support import motions, scenes

SIGMAS = 1.5


@pytest.fixture
def scene_path(tmp_path):
    return scene_file.write(scenes.make_scene(n=120, objects=2), tmp_path / "scene.r5dgs")


def instances(bpy):
    """World matrices of all ellipsoids, sorted by their centres. [N, 4, 4]"""
    depsgraph = bpy.context.evaluated_depsgraph_get()
    found = [np.array(i.matrix_world) for i in depsgraph.object_instances if i.is_instance]
    return np.array(sorted(found, key=lambda matrix: tuple(matrix[:3, 3].round(4)))).reshape(-1, 4, 4)


def expected(scene, t):
    """The same from playback: rotation times standard deviations."""
    frame = scene_player.Player(scene).frame(t)
    turned = rotations.quats_to_rotmats(frame.quats.astype(np.float64)) * np.exp(frame.log_scales)[:, None, :]
    order = sorted(range(len(turned)), key=lambda row: tuple(frame.means[row].astype(float).round(4)))
    return turned[order], frame.means[order]


@pytest.mark.parametrize("t", [0.3, scenes.T_MAX, 0.9])
def test_ellipsoids_are_the_gaussians_wherever_they_move(blender, scene_path, t):
    scene = scene_file.read(scene_path)
    blender.ops.wm.read_homefile(app_template="", use_empty=True)
    assert blender.ops.r5dgs.load_scene(filepath=str(scene_path), display="ELLIPSOIDS") == {"FINISHED"}
    frame = 1 + 60 * t
    blender.context.scene.frame_set(int(frame), subframe=frame % 1)
    found = instances(blender)
    matrices, means = expected(scene, t)
    np.testing.assert_allclose(found[:, :3, 3], means, atol=1e-4)
    np.testing.assert_allclose(found[:, :3, :3], matrices, atol=1e-4)


def test_an_ellipsoid_has_one_and_a_half_standard_deviations_and_the_opacity(blender, scene_path):
    blender.ops.r5dgs.load_scene(filepath=str(scene_path), display="ELLIPSOIDS")
    (tree,) = blender.data.node_groups
    sphere = next(node for node in tree.nodes if node.bl_idname == "GeometryNodeMeshIcoSphere")
    assert sphere.inputs["Radius"].default_value == SIGMAS
    painted = next(node for node in tree.nodes if node.bl_idname == "GeometryNodeSetMaterial")
    material = painted.inputs["Material"].default_value
    (source,) = (node for node in material.node_tree.nodes if node.bl_idname == "ShaderNodeAttribute")
    assert (source.attribute_type, source.attribute_name) == ("INSTANCER", "display_color")
    assert {link.to_node.bl_idname for link in source.outputs["Alpha"].links} == {"ShaderNodeMixShader"}


def test_the_display_can_be_changed_and_leaves_nothing_behind(blender, scene_path):
    blender.ops.r5dgs.load_scene(filepath=str(scene_path), display="POINTS")
    collection = next(c for c in blender.data.collections if c.r5dgs.is_scene)
    before = {kind: len(getattr(blender.data, kind)) for kind in ("materials", "node_groups", "objects", "pointclouds")}
    clouds = [obj for obj in collection.all_objects if obj.r5dgs.role == "CLOUD"]
    assert collection.r5dgs.display == "POINTS" and not any(cloud.modifiers for cloud in clouds)
    for display in ("ELLIPSOIDS", "ELLIPSOIDS", "SPLATS", "SPLATS"):  # twice: nothing is created a second time
        assert blender.ops.r5dgs.set_display(display=display) == {"FINISHED"}
        assert collection.r5dgs.display == display and {len(cloud.modifiers) for cloud in clouds} == {1}
        assert len(blender.data.node_groups) == before["node_groups"] + 1
    blender.ops.r5dgs.set_display(display="POINTS")
    assert not any(cloud.modifiers for cloud in clouds)
    assert {kind: len(getattr(blender.data, kind)) for kind in before} == before


def test_splats_hide_their_points_in_viewports_only(blender, scene_path):
    blender.ops.r5dgs.load_scene(filepath=str(scene_path))
    cloud = next(obj for obj in blender.data.objects if obj.r5dgs.role == "CLOUD")
    shown = cloud.evaluated_get(blender.context.evaluated_depsgraph_get()).data
    assert len(shown.points) == len(cloud.data.points) and {point.radius for point in shown.points} == {0.0}
    assert min(point.radius for point in cloud.data.points) > 0 and not cloud.modifiers[0].show_render


def test_splats_cover_the_lines_of_their_objects(blender, scene_path):
    blender.ops.r5dgs.load_scene(filepath=str(scene_path))
    parts = [obj for obj in blender.data.objects if obj.r5dgs.role != "NONE"]
    assert parts and all(part.show_in_front for part in parts)
    blender.ops.r5dgs.set_display(display="POINTS")
    assert not any(part.show_in_front for part in parts)


def test_what_blender_draws_as_splats_is_left_to_it(blender, scene_path, monkeypatch):
    monkeypatch.setattr(motions.addon("compat"), "is_gaussian_splat", lambda cloud: cloud.name == "mug")
    blender.ops.r5dgs.load_scene(filepath=str(scene_path))
    clouds = {obj.name: obj for obj in blender.data.objects if obj.r5dgs.role == "CLOUD"}
    assert not clouds["mug"].modifiers and clouds["red apple"].modifiers
    monkeypatch.setattr(motions.addon("compat"), "is_gaussian_splat", lambda cloud: True)
    assert motions.addon("splats.visible_splats").shown(blender.context.evaluated_depsgraph_get()) is None


def test_one_undo_reverts_the_display_and_redo_restores_it(blender, scene_path):
    def display():
        collection = next(c for c in blender.data.collections if c.r5dgs.is_scene)
        clouds = [obj for obj in collection.all_objects if obj.r5dgs.role == "CLOUD"]
        return collection.r5dgs.display, {len(cloud.modifiers) for cloud in clouds}, len(blender.data.node_groups)

    blender.ops.r5dgs.load_scene(filepath=str(scene_path))
    blender.ops.ed.undo_push(message="Load Scene")
    blender.ops.r5dgs.set_display(display="ELLIPSOIDS")
    blender.ops.ed.undo_push(message="Set Display")
    assert display() == ("ELLIPSOIDS", {1}, 1)
    blender.ops.ed.undo()
    assert display() == ("SPLATS", {1}, 1)
    blender.ops.ed.redo()
    assert display() == ("ELLIPSOIDS", {1}, 1)


def test_without_a_scene_there_is_no_display_to_set(blender):
    with pytest.raises(RuntimeError, match="Load an R5DGS scene first"):
        blender.ops.r5dgs.set_display(display="POINTS")
