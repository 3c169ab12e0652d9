"""Panel *Select by Prompt*."""

import bpy

from . import sidebar


class R5DGS_PT_prompt(sidebar.WithScene, bpy.types.Panel):
    """Select objects by words."""

    bl_idname = "R5DGS_PT_prompt"
    bl_label = "Select by Prompt"

    def draw(self, context):
        layout = self.layout
        session = context.window_manager.r5dgs
        layout.prop(session, "prompt", text="", icon="VIEWZOOM")
        row = layout.row(align=True)
        for mode, text in (("SET", "Select"), ("ADD", "Add"), ("SUBTRACT", "Subtract")):
            action = row.operator("r5dgs.select_by_prompt", text=text)
            action.mode = mode
            action.text = session.prompt
        if not session.asked:
            return
        box = layout.box().column(align=True)
        if not session.matches:
            box.label(text=f"Nothing matches '{session.asked}'", icon="INFO")
        for match in session.matches:
            line = box.row()
            line.label(text=match.name, icon="OUTLINER_OB_POINTCLOUD")
            line.label(text=match.why)
            line.label(text=f"{match.score:.2f}")


CLASSES = (R5DGS_PT_prompt,)
