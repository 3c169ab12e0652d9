"""Settings of the render engine R5DGS, on Blender's scenes."""

import bpy
from bpy.props import BoolProperty, EnumProperty, PointerProperty

MOVING = (
    ("1", "Full", "Full size at once; slow where pictures take long"),
    ("2", "Half", "Half as many pixels across"),
    ("4", "Quarter", "A quarter as many pixels across"),
    ("8", "Eighth", "An eighth as many pixels across"),
)


class R5DGS_PG_render(bpy.types.PropertyGroup):
    """How the render engine R5DGS renders a Blender scene."""

    sky: BoolProperty(
        name="Sky",
        description="Render the captured scene's own sky behind everything; black without, or nothing where the film "
        "is transparent",
        default=True,
    )
    as_trained: BoolProperty(
        name="Colors as Trained",
        description="Invert the view transform, so that AgX, Filmic and others display the colors of Gaussians as they "
        "were trained, and meshes as ever",
        default=True,
    )
    moving: EnumProperty(
        name="While Moving",
        description="Size of pictures in the viewport until it rests",
        items=MOVING,
        default="4",
    )


def of(scene: bpy.types.Scene) -> R5DGS_PG_render:
    """The settings of a scene."""
    return scene.r5dgs_render


def register():
    """Register the group and hang it on scenes."""
    bpy.utils.register_class(R5DGS_PG_render)
    bpy.types.Scene.r5dgs_render = PointerProperty(type=R5DGS_PG_render)


def unregister():
    """Undo `register`."""
    del bpy.types.Scene.r5dgs_render
    bpy.utils.unregister_class(R5DGS_PG_render)
