"""State that belongs to a .blend file: what each object of a loaded scene is, and the scene's table of words.

Everything that playback, selection and preview need to find their way back after saving, reloading or moving files
lies here and not in Python's memory.
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
    """What one Blender object is in its R5DGS scene."""

    role: EnumProperty(name="Role", description="What this object is in its R5DGS scene", items=ROLES)
    object_id: IntProperty(name="Object Id", description="Id in the scene's table of objects", default=0)
    motion_id: IntProperty(name="Motion Group", description="Id of the rigid motion", default=0)
    start: IntProperty(name="First Gaussian", description="First row in the scene file", default=0)
    count: IntProperty(name="Gaussians", description="Number of rows in the scene file", default=0)
    pivot: FloatVectorProperty(name="Pivot", description="Point that the motion turns about, scene coordinates", size=3)


class R5DGS_PG_alias(bpy.types.PropertyGroup):
    """Another word that finds an object: its `name`."""


class R5DGS_PG_entry(bpy.types.PropertyGroup):
    """One object of the scene's table; `name` is the object's name."""

    object_id: IntProperty(name="Object Id", description="Id in the scene's table of objects")
    aliases: CollectionProperty(name="Aliases", description="Other words that find it", type=R5DGS_PG_alias)
    caption: StringProperty(name="Caption", description="A sentence about it")
    count: IntProperty(name="Gaussians", description="Number of Gaussians")
    label: StringProperty(
        name="Name",
        description="Name of the object; its collection, anchor and clouds are renamed with it",
        get=object_list.label,
        set=object_list.set_label,
    )
    color: FloatVectorProperty(
        name="Color",
        description="Color in viewports; choosing another one tints the object",
        subtype="COLOR_GAMMA",
        size=3,
        min=0.0,
        max=1.0,
        get=object_list.color,
        set=object_list.set_color,
    )
    tint: FloatVectorProperty(
        name="Tint",
        description="Color that the object's Gaussians are multiplied with; white leaves them as captured",
        subtype="COLOR_GAMMA",
        size=3,
        min=0.0,
        soft_max=1.0,
        max=8.0,
        get=object_list.tint,
        set=object_list.set_color,
    )
    hidden: BoolProperty(
        name="Hide in Viewport",
        description="Hide the object in the view layer, and thereby in previews",
        get=object_list.is_hidden,
        set=object_list.set_hidden,
    )
    hidden_in_renders: BoolProperty(
        name="Hide in Renders",
        description="Leave the object out of renders",
        get=object_list.is_hidden_in_renders,
        set=object_list.set_hidden_in_renders,
    )


class R5DGS_PG_scene(bpy.types.PropertyGroup):
    """The loaded scene that a collection holds."""

    is_scene: BoolProperty(name="R5DGS Scene", description="Whether this collection holds a loaded R5DGS scene")
    scene_name: StringProperty(name="Name", description="Name of the scene in its file")
    filepath: StringProperty(
        name="Scene File",
        description="The .r5dgs file that the preview reads; relative to the .blend file where possible",
        subtype="FILE_PATH",
        options={"ANIMATABLE"} | compat.PATH_OPTIONS,
        update=trust.choose,
    )
    seen_at: StringProperty(
        name="Seen At", description="Where the scene file was last seen: a .blend that appends this starts elsewhere"
    )
    display: EnumProperty(
        name="Display",
        description="What stands for Gaussians where the viewport draws no splats",
        items=viewport_display.ITEMS,
    )
    gaussians: IntProperty(name="Gaussians", description="Number of Gaussians in the scene file")
    t_start: FloatProperty(name="First Time", description="First observed scene time", precision=4)
    t_max: FloatProperty(name="Last Observed Time", description="Motion is extrapolated after it", precision=4)
    t_end: FloatProperty(name="Last Time", description="End of the extrapolated keys", precision=4)
    frames_per_unit: FloatProperty(name="Frames per Unit", description="Frames per unit of scene time", default=60.0)
    frame_zero: FloatProperty(name="Frame of Time 0", description="Frame at which the scene time is 0", default=1.0)
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
    """Register the groups and hang them on objects and collections."""
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
