"""*Select by Prompt* panel."""

import bpy

from ..language import prompt
from ..scene import isolation, loaded_scenes, object_names, selection
from ..ui import status_bar
from . import sidebar


class R5DGS_MT_prompts(bpy.types.Menu):
    """Earlier prompts with matches"""

    bl_idname = "R5DGS_MT_prompts"
    bl_label = "Earlier Prompts"

    def draw(self, context):
        for item in context.scene.r5dgs_words.history:
            self.layout.operator("r5dgs.select_by_prompt", text=item.name).text = item.name
        if not context.scene.r5dgs_words.history:
            self.layout.label(text="None yet")


class R5DGS_PT_prompt(sidebar.WithScene, bpy.types.Panel):
    """Select objects by words."""

    bl_idname = "R5DGS_PT_prompt"
    bl_label = "Select by Prompt"
    manual = "blender"

    def draw(self, context):
        layout, session = self.layout, context.window_manager.r5dgs_words
        row = layout.row(align=True)
        row.prop(session, "prompt", text="", icon="VIEWZOOM", placeholder="Words, such as red mug")
        row.menu("R5DGS_MT_prompts", text="", icon="TIME")
        row = layout.row(align=True)
        for mode, text in (("SET", "Select"), ("ADD", "Add"), ("SUBTRACT", "Subtract")):
            action = row.operator("r5dgs.select_by_prompt", text=text)
            action.mode = mode
            action.text = session.prompt
        if session.asked:
            _draw_answers(layout.box().column(align=True), session, _current_names(session))


class R5DGS_PT_prompt_options(sidebar.WithScene, bpy.types.Panel):
    """Threshold and scenes of the search, and isolation of its matches."""

    bl_idname = "R5DGS_PT_prompt_options"
    bl_parent_id = "R5DGS_PT_prompt"
    bl_label = "Search Options"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context):
        layout = self.layout
        session, settings = context.window_manager.r5dgs_words, context.scene.r5dgs_words
        row = layout.row(align=True)
        row.prop(settings, "threshold", slider=True)
        if len(selection.scenes(context)) > 1:
            row.prop(settings, "all_scenes", toggle=True)
        row = layout.row(align=True)
        row.operator("r5dgs.isolate", text="Isolate Matches", icon="HIDE_ON").text = session.prompt
        if isolation.is_isolated(context.scene):
            row.operator("r5dgs.unisolate", icon="HIDE_OFF")


def _draw_answers(box, session, names):
    asking = any(note.name.startswith(prompt.ASKING) for note in session.notes)
    if not session.matches and not asking:
        status_bar.wrapped(box, bpy.context, f"Nothing matches '{session.asked}'", "INFO")
    for match in session.matches:
        line = box.split(factor=0.5)
        action = line.operator(
            "r5dgs.select_object",
            text=names.get((match.scene, match.object_id), match.name),
            icon="OUTLINER_OB_POINTCLOUD",
        )
        action.scene, action.object_id = match.scene, match.object_id
        line.label(text=f"{match.score:.2f}  {match.why}")
    if session.meant:
        row = box.row()
        row.label(text="Did you mean")
        for item in session.meant:
            row.operator("r5dgs.select_by_prompt", text=item.name).text = item.name
    for note in session.notes:
        icon = "TIME" if note.name.startswith(prompt.ASKING) else "ERROR"
        status_bar.wrapped(box, bpy.context, note.name, icon)


def _current_names(session) -> dict[tuple[str, int], str]:
    """Current names of the matched objects."""
    wanted = {match.scene for match in session.matches}
    return {
        (collection.name, object_id): name
        for collection in loaded_scenes.scene_collections()
        if collection.name in wanted
        for object_id, name in object_names.names(collection).items()
    }


CLASSES = (R5DGS_MT_prompts, R5DGS_PT_prompt, R5DGS_PT_prompt_options)
