"""Live Preview operator: start or stop the live preview."""

import bpy

from ..r5dgs_addon.engine import live_preview
from ..r5dgs_addon.scene import polls


class R5DGS_OT_live_preview(polls.NeedsCamera, bpy.types.Operator):
    """Keep the image 'R5DGS Preview' up to date with the frame, the camera and the objects; press again to stop"""

    bl_idname = "r5dgs.live_preview"
    bl_label = "Live Preview"

    @classmethod
    def poll(cls, context):
        if live_preview.running():
            return True
        if bpy.app.background:
            cls.poll_message_set("Live preview needs a window; render single previews instead")
            return False
        return super().poll(context)

    def execute(self, context):
        if live_preview.running():
            live_preview.stop()
        else:
            live_preview.start()
        return {"FINISHED"}


CLASSES = (R5DGS_OT_live_preview,)
