"""Properties stored in the .blend file: role of each object in a loaded scene, and the scene's object table.

Playback, selection and preview restore their state from these properties after saving, reloading or moving files.
"""

import bpy
from bpy.props import (
    BoolProperty,
    CollectionProperty,
    EnumProperty,
    FloatProperty,
    FloatVectorProperty,
    IntProperty,
    PointerProperty,
    StringProperty,
)

from .. import compat
from . import object_list, trust, viewport_display

ROLES = (
    ("NONE", "None", "Not part of an R5DGS scene"),
    ("ROOT", "Root", "Carries the world convention of the scene"),
    ("ANCHOR", "Anchor", "Carries the motion of a motion group"),
    ("CLOUD", "Cloud", "Gaussians of one object and one motion group"),
)


class R5DGS_PG_object(bpy.types.PropertyGroup):
    """Role of a Blender object in its R5DGS scene."""

    role: EnumProperty(name="Role", description="Role of this object in its R5DGS scene", items=ROLES)
    object_id: IntProperty(name="Object Id", description="Id in the scene's table of objects", default=0)
    motion_id: IntProperty(name="Motion Group", description="Id of the rigid motion", default=0)
    start: IntProperty(name="First Gaussian", description="First row in the scene file", default=0)
    count: IntProperty(name="Gaussians", description="Number of rows in the scene file", default=0)
    pivot: FloatVectorProperty(name="Pivot", description="Pivot of the motion in scene coordinates", size=3)


class R5DGS_PG_alias(bpy.types.PropertyGroup):
    """Alias of an object; the word is its `name`."""


class R5DGS_PG_entry(bpy.types.PropertyGroup):
    """Entry of the scene's object table; `name` is the object's name."""

    object_id: IntProperty(name="Object Id", description="Id in the scene's table of objects")
    aliases: CollectionProperty(name="Aliases", description="Other words that find the object", type=R5DGS_PG_alias)
    caption: StringProperty(name="Caption", description="Sentence that describes the object")
    count: IntProperty(name="Gaussians", description="Number of Gaussians")
    label: StringProperty(
        name="Name",
        description="Name of the object; its collection, anchor and clouds are renamed with it",
        get=object_list.label,
        set=object_list.set_label,
    )
    color: FloatVectorProperty(
        name="Color",
        description="Average color of the object, with its tint",
        subtype="COLOR_GAMMA",
        size=3,
        min=0.0,
        max=1.0,
        get=object_list.color,
    )
    tint: FloatVectorProperty(
        name="Tint",
        description="Color that multiplies the object's Gaussians; white keeps the captured colors",
        subtype="COLOR_GAMMA",
        size=3,
        min=0.0,
        soft_max=1.0,
        max=8.0,
        get=object_list.tint,
        set=object_list.set_tint,
    )
    hidden: BoolProperty(
        name="Hide in Viewport",
        description="Hide the object in the view layer and in previews",
        get=object_list.is_hidden,
        set=object_list.set_hidden,
    )
    hidden_in_renders: BoolProperty(
        name="Hide in Renders",
        description="Hide the object in renders",
        get=object_list.is_hidden_in_renders,
        set=object_list.set_hidden_in_renders,
    )


class R5DGS_PG_scene(bpy.types.PropertyGroup):
    """Loaded scene that a collection holds."""

    is_scene: BoolProperty(name="R5DGS Scene", description="This collection holds a loaded R5DGS scene")
    scene_name: StringProperty(name="Name", description="Name of the scene in its file")
    filepath: StringProperty(
        name="Scene File",
        description="The .r5dgs file that previews, renders, exports, searches and Exact Mode read; relative to the "
        ".blend file if possible",
        subtype="FILE_PATH",
        options={"ANIMATABLE"} | compat.PATH_OPTIONS,
        update=trust.choose,
    )
    seen_at: StringProperty(
        name="Seen At", description="Last known location of the scene file, for scenes appended from another .blend"
    )
    display: EnumProperty(
        name="Display",
        description="Representation of Gaussians in viewports",
        items=viewport_display.ITEMS,
    )
    gaussians: IntProperty(name="Gaussians", description="Number of Gaussians in the scene file")
    t_start: FloatProperty(name="First Time", description="First observed scene time", precision=4)
    t_max: FloatProperty(
        name="Last Observed Time",
        description="Last observed scene time, after which motion is extrapolated",
        precision=4,
    )
    t_end: FloatProperty(name="Last Time", description="End of the extrapolated keys", precision=4)
    frames_per_unit: FloatProperty(name="Frames per Unit", description="Frames per unit of scene time", default=60.0)
    frame_zero: FloatProperty(name="Frame of Time 0", description="Frame of scene time 0", default=1.0)
    root: PointerProperty(name="Root", description="Empty that carries the world convention", type=bpy.types.Object)
    table: CollectionProperty(name="Objects", description="The scene's table of objects", type=R5DGS_PG_entry)
    row: IntProperty(
        name="Active Object",
        description="Row of the active object in the table",
        get=object_list.active_row,
        set=object_list.set_active_row,
    )


CLASSES = (R5DGS_PG_object, R5DGS_PG_alias, R5DGS_PG_entry, R5DGS_PG_scene)


def register():
    """Register the property groups on objects and collections."""
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    bpy.types.Object.r5dgs = PointerProperty(type=R5DGS_PG_object)
    bpy.types.Collection.r5dgs = PointerProperty(type=R5DGS_PG_scene)


def unregister():
    """Undo `register`."""
    del bpy.types.Collection.r5dgs
    del bpy.types.Object.r5dgs
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
