"""Select by Prompt operator: find objects by names, aliases and stored embeddings, and select them."""

import bpy
from bpy.props import EnumProperty, FloatProperty, StringProperty

from ..r5dgs_addon.language import prompt
from ..r5dgs_addon.scene import polls, selection

MODES = (
    ("SET", "Set", "Select these objects only", "SELECT_SET", 0),
    ("ADD", "Add", "Add these objects to the selection", "SELECT_EXTEND", 1),
    ("SUBTRACT", "Subtract", "Remove these objects from the selection", "SELECT_SUBTRACT", 2),
)


class R5DGS_OT_select_by_prompt(polls.Selects, bpy.types.Operator):
    """Select the objects that match these words"""

    bl_idname = "r5dgs.select_by_prompt"
    bl_label = "Select by Prompt"
    bl_options = {"REGISTER", "UNDO"}

    text: StringProperty(name="Prompt", description="Words for the objects, such as 'red mug'", options={"SKIP_SAVE"})
    mode: EnumProperty(name="Mode", description="Change of the selection", items=MODES, default="SET")
    threshold: FloatProperty(
        name="Threshold",
        description="Minimum score of a match; the sidebar's if not given",
        min=0.0,
        max=1.0,
        subtype="FACTOR",
        options={"SKIP_SAVE"},
    )

    def execute(self, context):
        settings, session = context.scene.r5dgs_words, context.window_manager.r5dgs_words
        text = (self.text if self.properties.is_property_set("text") else session.prompt).strip()
        if not text:
            self.report({"WARNING"}, "Type the name of an object first")
            return {"CANCELLED"}
        self.text = text  # for the redo panel, like the threshold below
        if self.properties.is_property_set("threshold"):
            settings.threshold = self.threshold
        else:
            self.threshold = settings.threshold
        answer = prompt.ask(context, text)
        if answer.error:
            self.report({"ERROR"}, answer.error)
            return {"CANCELLED"}
        if answer.asks_for_nothing:
            selection.select(context, [], self.mode)
            self.report({"INFO"}, "The prompt selects no objects")
            return {"FINISHED"}
        if not answer.matches:
            self.report({"WARNING"}, prompt.explain_nothing(prompt.scope(context), text, answer))
            return {"CANCELLED"}
        missed = selection.select(context, answer.objects, self.mode)
        found = ", ".join(f"{match.name} ({match.score:.2f})" for match in answer.matches)
        if missed:
            self.report({"WARNING"}, f"{found}; hidden and therefore not selected: {', '.join(missed)}")
        else:
            self.report({"INFO"}, ". ".join([found, *answer.notes]))
        return {"FINISHED"}


CLASSES = (R5DGS_OT_select_by_prompt,)
