"""Undo and redo of every operator that changes the .blend."""

import importlib

import numpy as np
import pytest

from tests.support import motions

OPERATORS = {  # call of each; None if another module tests it
    "add_alias": lambda ops: ops.add_alias(word="tankard"),
    "add_crop_box": lambda ops: ops.add_crop_box(),
    "add_shadows": None,  # engine/test_mesh_shadows.py
    "assign_gaussians": None,  # clean_up/test_clean_up.py
    "bake_back": lambda ops: ops.bake_back(),
    "brush_gaussians": None,  # needs a window: tests/blender/check_window.py
    "delete_gaussians": None,  # clean_up/test_clean_up.py
    "delete_object": lambda ops: ops.delete_object(),
    "duplicate_object": lambda ops: ops.duplicate_object(),
    "exact_mode": None,  # motion/test_exact_mode.py
    "extrapolate_until": lambda ops: ops.extrapolate_until(t_end=1.4),
    "fit_timeline": lambda ops: ops.fit_timeline(),
    "hand_over": lambda ops: ops.hand_over(),
    "isolate": lambda ops: ops.isolate(),
    "lasso_gaussians": None,  # needs a window: tests/blender/check_window.py
    "load_scene": None,  # scene/test_load_scene.py
    "merge_with_meshes": None,  # engine/test_mesh_merge.py
    "pivot_to_cursor": lambda ops: ops.pivot_to_cursor(),
    "predict_contacts": None,  # motion/test_contact.py
    "re_extrapolate": lambda ops: ops.re_extrapolate(),
    "recolor": lambda ops: ops.recolor(tint=(0.2, 0.9, 0.1)),
    "remove_alias": lambda ops: ops.remove_alias(word="tankard"),
    "rename_object": lambda ops: ops.rename_object(new_name="cup"),
    "replace_motion": lambda ops: ops.replace_motion(),
    "reset_color": lambda ops: ops.reset_color(),
    "reset_motion": lambda ops: ops.reset_motion(),
    "retime": lambda ops: ops.retime(kind="REVERSE"),
    "select_by_prompt": lambda ops: ops.select_by_prompt(text="toy car"),
    "select_floaters": lambda ops: ops.select_floaters(),
    "select_gaussians": None,  # clean_up/test_clean_up.py
    "select_object": lambda ops: ops.select_object(object_id=2),
    "set_display": lambda ops: ops.set_display(display="POINTS"),
    "show_colors_as_trained": lambda ops: ops.show_colors_as_trained(),
    "show_confidence": lambda ops: ops.show_confidence(),
    "show_captured_images": None,  # scene/test_captured_cameras.py
    "simplify_keys": lambda ops: ops.simplify_keys(tolerance=0.05),
    "stop_merging": None,  # engine/test_mesh_merge.py
    "switch_contacts": None,  # motion/test_contact.py
    "unisolate": lambda ops: ops.unisolate(),
    "use_captured_camera": None,  # scene/test_captured_cameras.py
    "use_engine": lambda ops: ops.use_engine(),
    "view_as_trained": lambda ops: ops.view_as_trained(),
}


def _push(bpy):
    bpy.context.object.r5dgs_motion.velocity = (2.0, 1.0, 0.5)


def _select_two(bpy):
    motions.choose(bpy, bpy.data.objects["mug anchor"], bpy.data.objects["toy car anchor"])


PREPARATIONS = {  # state in which an operator has an effect
    "bake_back": lambda bpy: bpy.ops.r5dgs.hand_over(),
    "fit_timeline": lambda bpy: setattr(bpy.context.scene, "frame_end", 7),
    "re_extrapolate": _push,
    "remove_alias": lambda bpy: bpy.ops.r5dgs.add_alias(word="tankard"),
    "replace_motion": _select_two,
    "reset_color": lambda bpy: bpy.ops.r5dgs.recolor(tint=(0.2, 0.9, 0.1)),
    "reset_motion": _push,
    "show_colors_as_trained": lambda bpy: setattr(bpy.context.scene.view_settings, "exposure", 1.5),
    "unisolate": lambda bpy: bpy.ops.r5dgs.isolate(),
    "view_as_trained": lambda bpy: bpy.ops.r5dgs.set_display(display="POINTS"),
}


def value(item):
    """A property as something that can be compared and printed."""
    return (
        np.round(np.array(item, np.float64), 5).tolist()
        if hasattr(item, "__len__") and not isinstance(item, str)
        else item
    )


def snapshot(bpy):
    """Values that operators change: objects, their motion, looks, keys, points and selection, tables and settings."""
    found = {}
    for obj in bpy.data.objects:
        tint, motion = obj.r5dgs_look.tint, obj.r5dgs_motion
        curves = {
            name: [tuple(np.round(p.co, 4)) for p in c.keyframe_points] for name, c in motions.curves(obj).items()
        }
        tracks = [] if obj.animation_data is None else [track.name for track in obj.animation_data.nla_tracks]
        chosen = obj.type == "POINTCLOUD" and "r5dgs_selected" in obj.data.attributes
        found[obj.name] = (
            value(obj.matrix_basis), value(tint), motion.kind, value(motion.velocity), value(obj.r5dgs_pivot.point),
            sorted(map(str, curves.items())), tracks, chosen, [one.name for one in obj.modifiers],
            obj.select_get() if obj.name in bpy.context.view_layer.objects else None,
            obj.name in bpy.context.view_layer.objects and obj.visible_get(),
        )  # fmt: skip
    for one in (c for c in bpy.data.collections if c.r5dgs.is_scene):
        table = [(entry.name, [alias.name for alias in entry.aliases]) for entry in one.r5dgs.table]
        found[one.name] = one.r5dgs.display, round(one.r5dgs.t_end, 4), table
    scene = bpy.context.scene
    markers, view = [marker.frame for marker in scene.timeline_markers], scene.view_settings
    found["scene"] = scene.render.engine, scene.frame_end, markers, view.view_transform, view.exposure
    return found


@pytest.mark.parametrize("name", [name for name, call in OPERATORS.items() if call is not None])
def test_undo_and_redo_restore_everything(blender, loaded, mug, name):
    blender.context.scene.cursor.location = (0.3, 0.2, 0.1)
    if name in PREPARATIONS:
        PREPARATIONS[name](blender)
    blender.ops.ed.undo_push(message="loaded")
    before = snapshot(blender)
    assert OPERATORS[name](blender.ops.r5dgs) == {"FINISHED"}
    blender.ops.ed.undo_push(message=name)
    after = snapshot(blender)
    assert after != before
    blender.ops.ed.undo()
    assert snapshot(blender) == before
    blender.ops.ed.redo()
    assert snapshot(blender) == after


def test_undo_of_every_operator_is_tested(extension):
    operators = importlib.import_module("r5dgs.operators")
    found = {cls.bl_idname.partition(".")[2]: cls for module in operators.modules() for cls in module.CLASSES}
    with_undo = {name for name, cls in found.items() if "UNDO" in getattr(cls, "bl_options", ())}
    assert with_undo == set(OPERATORS), "OPERATORS above must list exactly the operators with UNDO"
