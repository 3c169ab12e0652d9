"""Explain Warning operator: icon of objects with unpredictable motion in the list; the tooltip gives the reason."""

import bpy
from bpy.props import IntProperty

from ..r5dgs_addon.motion import warnings
from ..r5dgs_addon.scene import loaded_scenes, object_names, polls


class R5DGS_OT_explain_warning(polls.NeedsScene, bpy.types.Operator):
    """Show why the motion of this object cannot be predicted"""

    bl_idname = "r5dgs.explain_warning"
    bl_label = "Explain Warning"
    bl_options = {"INTERNAL"}

    object_id: IntProperty(
        name="Object Id",
        description="Id in the scene's table of objects",
        default=object_names.NOBODY,
        options={"SKIP_SAVE"},
    )

    @classmethod
    def description(cls, context, properties):
        collection = loaded_scenes.active_collection(context)
        found = "" if collection is None else warnings.of_object(collection, properties.object_id)
        return found.capitalize() or cls.__doc__

    def execute(self, context):
        collection = loaded_scenes.active_collection(context)
        found = warnings.of_object(collection, self.object_id)
        if not found:
            self.report({"INFO"}, "The motion of this object is predictable, or its confidence is unknown")
            return {"CANCELLED"}
        name = object_names.names(collection).get(self.object_id, "")
        self.report({"WARNING"}, f"{name}: {found}; Show Confidence in the panel Motion draws how far it may be off")
        return {"FINISHED"}


CLASSES = (R5DGS_OT_explain_warning,)
