"""Select by Prompt: words to objects, by the names and aliases that the .blend file remembers."""

import bpy
from bpy.props import EnumProperty, StringProperty

from ..r5dgs_addon import objects, prompt
from ..r5dgs_core.scene import lookup

MODES = (
    ("SET", "Set", "Select these objects only", "SELECT_SET", 0),
    ("ADD", "Add", "Add these objects to the selection", "SELECT_EXTEND", 1),
    ("SUBTRACT", "Subtract", "Take these objects out of the selection", "SELECT_SUBTRACT", 2),
)


class R5DGS_OT_select_by_prompt(bpy.types.Operator):
    """Select the objects that these words name"""

    bl_idname = "r5dgs.select_by_prompt"
    bl_label = "Select by Prompt"
    bl_options = {"REGISTER", "UNDO"}

    text: StringProperty(name="Prompt", description="Words for the objects, such as 'red mug'", options={"SKIP_SAVE"})
    mode: EnumProperty(name="Mode", description="What to do with the selection", items=MODES, default="SET")

    @classmethod
    def poll(cls, context):
        if context.mode != "OBJECT":
            cls.poll_message_set("Switch to Object Mode first")
            return False
        if objects.active_collection(context) is None:
            cls.poll_message_set("Load an R5DGS scene first")
            return False
        return True

    def execute(self, context):
        session = context.window_manager.r5dgs
        text = (self.text if self.properties.is_property_set("text") else session.prompt).strip()
        if not text:
            self.report({"WARNING"}, "Type the name of an object first")
            return {"CANCELLED"}
        collection = objects.active_collection(context)
        matches = prompt.search(collection, text)
        prompt.show(session, text, matches)
        if not matches:
            said = lookup.explain_nothing(prompt.remembered(collection), text)
            self.report({"WARNING"}, said[0].upper() + said[1:])
            return {"CANCELLED"}
        missed = prompt.select(context, collection, [match.object_id for match in matches], self.mode)
        said = ", ".join(f"{match.name} ({match.score:.2f})" for match in matches)
        if missed:
            self.report({"WARNING"}, f"{said}; hidden and therefore not selected: {', '.join(missed)}")
        else:
            self.report({"INFO"}, said)
        return {"FINISHED"}


CLASSES = (R5DGS_OT_select_by_prompt,)
