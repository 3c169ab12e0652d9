"""*Motion* panel: motion of the active object past the last observed time."""

import bpy

from ...r5dgs_core import errors
from ...r5dgs_core.motion import models
from ..motion import confidence_tubes, curve_place, duplicate_delete, hand_over, physics, pivot, warnings
from ..scene import loaded_scenes, retiming
from ..ui import status_bar
from . import sidebar


class R5DGS_PT_motion(sidebar.WithScene, bpy.types.Panel):
    """Edit the motion of the active object."""

    bl_idname = "R5DGS_PT_motion"
    bl_label = "Motion"
    manual = "motion"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context):
        layout = self.layout
        layout.use_property_split = True
        layout.use_property_decorate = False
        anchor = duplicate_delete.active_anchor(context)
        if anchor is None:
            layout.label(text="Select an object to see its motion", icon="INFO")
        else:
            _physics(layout, anchor)
            layout.operator("r5dgs.re_extrapolate", icon="TRACKING_FORWARDS")


class R5DGS_PT_change_motion(sidebar.Sidebar, bpy.types.Panel):
    """Keys, motion and copies of the active object."""

    bl_idname = "R5DGS_PT_change_motion"
    bl_parent_id = R5DGS_PT_motion.bl_idname
    bl_label = "Keys and Copies"
    bl_options = {"DEFAULT_CLOSED"}

    @classmethod
    def poll(cls, context):
        return duplicate_delete.active_anchor(context) is not None

    def draw(self, context):
        column = self.layout.column(align=True)
        column.operator("r5dgs.reset_motion", icon="LOOP_BACK")
        column.operator("r5dgs.simplify_keys", icon="IPO_BEZIER")
        column = self.layout.column(align=True)
        column.operator("r5dgs.replace_motion", icon="PASTEDOWN")
        column.operator("r5dgs.duplicate_object", icon="DUPLICATE")
        column.operator("r5dgs.delete_object", icon="TRASH")


class R5DGS_PT_retime(sidebar.WithScene, bpy.types.Panel):
    """Retiming of the selected objects or of the scene."""

    bl_idname = "R5DGS_PT_retime"
    bl_parent_id = R5DGS_PT_motion.bl_idname
    bl_label = "Retime"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context):
        layout = self.layout
        anchor = duplicate_delete.anchor_of(context.view_layer.objects.active)
        strip = retiming.strip_of(anchor)
        if strip is not None:
            shown = retiming.source_frame(anchor, context.scene.frame_current_final)
            layout.label(text=f"{anchor.name} shows frame {shown:.4g}", icon="TIME")
        for which, text in (("SELECTED", "Retime Selected"), ("SCENE", "Retime Scene")):
            button = layout.operator_menu_enum("r5dgs.retime", "kind", text=text, icon="MOD_TIME")
            button.which = which


class R5DGS_PT_rigid_bodies(sidebar.WithScene, bpy.types.Panel):
    """Hand-over of the selected objects to Blender's rigid bodies."""

    bl_idname = "R5DGS_PT_rigid_bodies"
    bl_parent_id = R5DGS_PT_motion.bl_idname
    bl_label = "Rigid Bodies"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context):
        proxies = hand_over.proxies_of(context.scene)
        if proxies is None:
            self.layout.operator_menu_enum("r5dgs.hand_over", "start", icon="RIGID_BODY")
            return
        self.layout.label(text=f"Simulated from frame {proxies[hand_over.FRAME]} on", icon="RIGID_BODY")
        self.layout.operator("r5dgs.bake_back", icon="KEY_HLT")


class R5DGS_PT_all_motions(sidebar.WithScene, bpy.types.Panel):
    """Motion of the whole scene."""

    bl_idname = "R5DGS_PT_all_motions"
    bl_parent_id = R5DGS_PT_motion.bl_idname
    bl_label = "Whole Scene"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context):
        _scene(self.layout, loaded_scenes.active_collection(context))


def _physics(layout, anchor) -> None:
    """Draw the fields of the motion."""
    state = anchor.r5dgs_motion
    layout.label(text=anchor.name, icon="EMPTY_ARROWS")
    refused = curve_place.refusal(anchor)
    if refused:
        status_bar.wrapped(layout, bpy.context, refused, "ERROR")
    layout.prop(state, "leader")
    if physics.follow_matrix(state) is not None:
        layout.label(text="Follows another object", icon="LINKED")
        return
    draw_warning(layout, anchor)
    layout.prop(state, "kind")
    if not refused:
        _pivot(layout, anchor)
    for name in models.KINDS[state.kind].fields:
        layout.prop(state, name)
    if state.clamped:
        status_bar.wrapped(layout, bpy.context, state.clamped, "ERROR")
    layout.prop(state, "at_once")
    if state.too_fast:
        status_bar.wrapped(layout, bpy.context, "Too fast for keys: exact only at frames", "ERROR")
    if not physics.is_written(anchor):
        status_bar.wrapped(layout, bpy.context, "Re-Extrapolate writes this to the keys", "ERROR")
    elif physics.edited(state):
        layout.label(text="Edited", icon="GREASEPENCIL")
    else:
        layout.label(text="As learned", icon="CHECKMARK")


def draw_warning(layout, anchor) -> None:
    """Draw a warning if the learned motion is not predictable."""
    warning = warnings.of_anchor(anchor)
    if warning:
        status_bar.wrapped(layout, bpy.context, warning.capitalize(), "ERROR")


def _pivot(layout, anchor) -> None:
    """Draw the pivot and axis if the motion has them."""
    try:
        point = pivot.point(anchor)
    except errors.R5dgsError:  # shown by the operators
        point = None
    if point is not None:
        column = layout.column(align=True)
        column.prop(anchor.r5dgs_pivot, "point")
        column.operator("r5dgs.pivot_to_cursor", text="Use 3D Cursor", icon="PIVOT_CURSOR")
    if pivot.axis(anchor) is not None:
        layout.prop(anchor.r5dgs_pivot, "axis")


def _scene(layout, collection) -> None:
    """Draw the settings of the whole scene."""
    column = layout.column(align=True)
    column.operator("r5dgs.extrapolate_until", icon="PREVIEW_RANGE")
    shown = any(confidence_tubes.helper_of(anchor) for anchor in loaded_scenes.members(collection, "ANCHOR"))
    column.operator("r5dgs.show_confidence", text="Hide Confidence" if shown else "Show Confidence", icon="CURVE_PATH")
    exact = collection.r5dgs_exact
    text = "Exact Mode Is On" if exact.enabled else "Exact Mode"
    column.operator("r5dgs.exact_mode", text=text, icon="MOD_SIMPLEDEFORM", depress=exact.enabled)
    if exact.problem:
        status_bar.wrapped(layout, bpy.context, exact.problem, "ERROR")
    elif exact.enabled and any(cloud.data.library for cloud in loaded_scenes.members(collection, "CLOUD")):
        text = "Linked points do not bend in viewports, only in renders; append the scene instead"
        status_bar.wrapped(layout, bpy.context, text, "ERROR")


CLASSES = (R5DGS_PT_motion, R5DGS_PT_change_motion, R5DGS_PT_retime, R5DGS_PT_rigid_bodies, R5DGS_PT_all_motions)
