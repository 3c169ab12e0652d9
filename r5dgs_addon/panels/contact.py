"""*Contact* panel: simulated contacts after the last observed time."""

import bpy

from ..motion import contact, duplicate_delete
from ..scene import loaded_scenes
from ..ui import status_bar
from ..worker import jobs
from . import motion, sidebar

_LACKING = (
    "The worker's Python lacks MuJoCo, so predictions stay smooth: run pip install 'r5dgs[contact]' there, or choose "
    "another Worker Python in the preferences"
)


class R5DGS_PT_contact(sidebar.WithScene, bpy.types.Panel):
    """Predict the motion of the active scene with contacts."""

    bl_idname = "R5DGS_PT_contact"
    bl_parent_id = motion.R5DGS_PT_motion.bl_idname
    bl_label = "Contact"
    manual = "contact"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context):
        layout = self.layout
        layout.use_property_split = True
        layout.use_property_decorate = False
        collection = loaded_scenes.active_collection(context)
        bodies = contact.bodies(collection)
        if bodies:
            off = any(contact.is_off(anchor) for anchor in bodies)
            text = "Contacts Are Off" if off else "Contacts Are On"
            layout.operator("r5dgs.switch_contacts", text=text, icon="PHYSICS", depress=not off)
        anchor = duplicate_delete.active_anchor(context)
        if anchor is not None:
            _body(layout, anchor)
        settings = collection.r5dgs_contact
        _optional(layout, settings, "gravity")
        layout.prop(settings, "obstacles")
        if jobs.simulates() is False:
            status_bar.wrapped(layout, context, _LACKING, "ERROR")
        layout.operator("r5dgs.predict_contacts", icon="TRACKING_FORWARDS")
        for line in settings.result.split("; ") if settings.result else ():
            status_bar.wrapped(layout, context, line, "BLANK1")


def _body(layout, anchor) -> None:
    """Draw the material of the active object."""
    own = anchor.r5dgs_contact
    layout.label(text=anchor.name, icon="EMPTY_ARROWS")
    _optional(layout, own, "friction")
    _optional(layout, own, "bounciness")
    layout.prop(own, "mass")


def _optional(layout, settings, name) -> None:
    """Draw a value with the checkbox that puts it in place of the fitted one."""
    row = layout.row(align=True)
    row.prop(settings, f"use_{name}", text="")
    value = row.row(align=True)
    value.active = getattr(settings, f"use_{name}")
    value.prop(settings, name)


CLASSES = (R5DGS_PT_contact,)
