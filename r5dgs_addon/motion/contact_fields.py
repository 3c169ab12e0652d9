"""Fields of the panel *Contact*: material of each anchor, and surroundings of each loaded scene."""

import bpy
from bpy.props import BoolProperty, FloatProperty, PointerProperty, StringProperty


class R5DGS_PG_contact_body(bpy.types.PropertyGroup):
    """Contact parameters of an anchor."""

    use_friction: BoolProperty(
        name="Own Friction", description="Use this friction instead of the fitted one", options=set()
    )
    friction: FloatProperty(
        name="Friction",
        description="Coulomb friction; of two bodies in contact, the rougher one counts",
        default=0.3,
        min=0.0,
        soft_max=1.0,
        options=set(),
    )
    use_bounciness: BoolProperty(
        name="Own Bounciness", description="Use this bounciness instead of the fitted one", options=set()
    )
    bounciness: FloatProperty(
        name="Bounciness",
        description="Speed after an impact as a share of the speed before it; 0.05 to 0.98 is simulated",
        default=0.3,
        min=0.0,
        max=1.0,
        subtype="FACTOR",
        options=set(),
    )
    mass: FloatProperty(
        name="Mass ×",
        description="Factor of the mass, which is otherwise proportional to the volume",
        default=1.0,
        min=1e-6,
        soft_min=0.01,
        soft_max=100.0,
        options=set(),
    )
    former: StringProperty(
        name="Former Keys", description="Keys and motion with contacts while contacts are off", options={"HIDDEN"}
    )


class R5DGS_PG_contact_scene(bpy.types.PropertyGroup):
    """Surroundings of the bodies of a loaded scene."""

    use_gravity: BoolProperty(
        name="Own Gravity",
        description="Use this gravity instead of that of falling objects or of the units of the scene",
        options=set(),
    )
    gravity: FloatProperty(
        name="Gravity",
        description="Downward acceleration along the up axis of the scene, per second squared of Blender's time",
        default=9.81,
        unit="ACCELERATION",
        options=set(),
    )
    obstacles: PointerProperty(
        name="Collides With",
        description="Collection of meshes; the objects collide with the convex hull of each, as it is now",
        type=bpy.types.Collection,
        options=set(),
    )
    result: StringProperty(name="Result", description="Result of the last prediction", options={"HIDDEN"})


CLASSES = (R5DGS_PG_contact_body, R5DGS_PG_contact_scene)


def register():
    """Register the property groups on objects and collections."""
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    bpy.types.Object.r5dgs_contact = PointerProperty(type=R5DGS_PG_contact_body)
    bpy.types.Collection.r5dgs_contact = PointerProperty(type=R5DGS_PG_contact_scene)


def unregister():
    """Undo `register`."""
    del bpy.types.Collection.r5dgs_contact, bpy.types.Object.r5dgs_contact
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
