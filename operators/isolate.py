"""Isolate operator: hide all objects of the loaded scenes except some."""

import bpy
from bpy.props import IntProperty, StringProperty

from ..r5dgs_addon.language import prompt
from ..r5dgs_addon.scene import isolation, object_names, polls, selection
from ..r5dgs_addon.ui import plural


class R5DGS_OT_isolate(polls.Selects, bpy.types.Operator):
    """Hide all objects of loaded scenes in viewports and renders, except the selected or named ones"""

    bl_idname = "r5dgs.isolate"
    bl_label = "Isolate"
    bl_options = {"REGISTER", "UNDO"}

    text: StringProperty(
        name="Prompt", description="Words for the objects to show; empty for the selected ones", options={"SKIP_SAVE"}
    )
    scene: StringProperty(name="Scene", description="Collection of the object's scene", options={"SKIP_SAVE"})
    object_id: IntProperty(
        name="Object Id",
        description="Object to show; replaces prompt and selection",
        default=object_names.NOBODY,
        options={"SKIP_SAVE"},
    )

    def execute(self, context):
        if self.object_id != object_names.NOBODY:
            found = selection.find(context, self.scene, self.object_id)
            wanted = [] if found is None else [found]
        elif self.text.strip():
            answer = prompt.ask(context, self.text)
            if answer.error:
                self.report({"ERROR"}, answer.error)
                return {"CANCELLED"}
            if not answer.matches:
                self.report({"WARNING"}, prompt.explain_nothing(prompt.scope(context), self.text, answer))
                return {"CANCELLED"}
            wanted = answer.objects
        else:
            wanted = selection.selected(context)
        known = {
            collection: (object_names.names(collection), object_names.present(collection)) for collection, _ in wanted
        }
        wanted = [(collection, object_id) for collection, object_id in wanted if object_id in known[collection][1]]
        if not wanted:
            self.report({"WARNING"}, "Select an object of a loaded scene, or type its name first")
            return {"CANCELLED"}
        hidden = isolation.isolate(context, wanted)
        shown = ", ".join(known[collection][0][object_id] for collection, object_id in wanted)
        self.report({"INFO"}, f"{shown}: {plural.of(hidden, 'other')} hidden; Un-Isolate restores their visibility")
        return {"FINISHED"}


CLASSES = (R5DGS_OT_isolate,)
