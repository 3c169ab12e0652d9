"""Duplicate With Motion operator: independent copies of objects that move the same way."""

import bpy
from bpy.props import BoolProperty, FloatVectorProperty

from ..r5dgs_addon.motion import duplicate_delete, physics
from ..r5dgs_core import errors


class R5DGS_OT_duplicate_object(bpy.types.Operator):
    """Copy the selected objects with their motion: anchor, points and keys"""

    bl_idname = "r5dgs.duplicate_object"
    bl_label = "Duplicate With Motion"
    bl_options = {"REGISTER", "UNDO"}

    offset: FloatVectorProperty(
        name="Offset",
        description="Offset of the copies in the scene's axes; if not set, they are placed next to the originals",
        subtype="TRANSLATION",
        unit="LENGTH",
        options={"SKIP_SAVE"},
    )
    shadows: BoolProperty(name="Shadows", description="Copy the shadows of the objects, too", default=True)

    @classmethod
    def poll(cls, context):
        return duplicate_delete.poll_chosen(cls, context)

    def execute(self, context):
        anchors = duplicate_delete.chosen(context)
        if not self.properties.is_property_set("offset"):
            reach = max(physics.key_error(anchor)[1] for anchor in anchors)
            self.offset = (2.2 * reach, 0.0, 0.0)
        try:
            copies = duplicate_delete.duplicate(context, anchors, tuple(self.offset), self.shadows)
        except errors.R5dgsError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self.report({"INFO"}, f"Made {', '.join(copy.name for copy in copies)}")
        return {"FINISHED"}


CLASSES = (R5DGS_OT_duplicate_object,)
