"""Contacts operator: switch the contacts of predicted motions off, and on again."""

import bpy

from ..r5dgs_addon.motion import contact
from ..r5dgs_addon.scene import loaded_scenes, polls
from ..r5dgs_core import errors


class R5DGS_OT_switch_contacts(polls.NeedsScene, bpy.types.Operator):
    """Switch contacts off, so that objects follow their smooth motions, or on again, which restores the former keys"""

    bl_idname = "r5dgs.switch_contacts"
    bl_label = "Contacts"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context):
        if not super().poll(context):
            return False
        if not contact.bodies(loaded_scenes.active_collection(context)):
            cls.poll_message_set("No predicted motion of this scene has contacts")
            return False
        return True

    def execute(self, context):
        collection = loaded_scenes.active_collection(context)
        off = any(contact.is_off(anchor) for anchor in contact.bodies(collection))
        try:
            changed = (contact.switch_on if off else contact.switch_off)(collection)
        except errors.R5dgsError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        names = ", ".join(anchor.name for anchor in changed)
        self.report({"INFO"}, f"Contacts are {'on' if off else 'off'}: {names}")
        return {"FINISHED"}


CLASSES = (R5DGS_OT_switch_contacts,)
