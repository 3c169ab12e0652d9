"""Open Manual operator: open a page of the manual."""

import bpy

from ..r5dgs_addon.ui import manual


class R5DGS_OT_open_manual(bpy.types.Operator):
    """Open the page of the manual for this panel"""

    bl_idname = "r5dgs.open_manual"
    bl_label = "Open Manual"
    bl_options = {"INTERNAL"}

    page: bpy.props.EnumProperty(
        name="Page",
        description="Page of the manual",
        items=[(page, page.replace("_", " ").title(), f"Page '{page}' of the user guide") for page in manual.PAGES],
    )

    def execute(self, context):
        return bpy.ops.wm.url_open(url=manual.address(self.page))


CLASSES = (R5DGS_OT_open_manual,)
