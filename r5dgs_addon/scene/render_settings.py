"""Scene settings of the R5DGS render engine."""

import bpy
from bpy.props import BoolProperty, EnumProperty, IntProperty, PointerProperty

MOVING = (
    ("1", "Full", "Full resolution"),
    ("2", "Half", "Half the resolution"),
    ("4", "Quarter", "A quarter of the resolution"),
    ("8", "Eighth", "An eighth of the resolution"),
)


class R5DGS_PG_render(bpy.types.PropertyGroup):
    """Settings of the R5DGS render engine."""

    sky: BoolProperty(
        name="Sky",
        description="Render the captured scene's sky as background; if off, the background is black, or "
        "transparent if Film Transparent is on",
        default=True,
    )
    as_trained: BoolProperty(
        name="Colors as Trained",
        description="Invert the view transform for Gaussians, so that AgX, Filmic and others show their trained "
        "colors; meshes are not affected",
        default=True,
    )
    moving: EnumProperty(
        name="While Moving",
        description="Resolution of the viewport while the view moves",
        items=MOVING,
        default="4",
    )
    samples: IntProperty(
        name="Blur Samples",
        description="Number of images that are averaged for depth of field and motion blur",
        default=32,
        min=1,
        soft_max=256,
    )
    meshes: PointerProperty(
        name="Meshes",
        description="Scene of the meshes that are merged with the Gaussians",
        type=bpy.types.Scene,
    )


def of(scene: bpy.types.Scene) -> R5DGS_PG_render:
    """Return the settings of a scene."""
    return scene.r5dgs_render


def register():
    """Register the settings on scenes."""
    bpy.utils.register_class(R5DGS_PG_render)
    bpy.types.Scene.r5dgs_render = PointerProperty(type=R5DGS_PG_render)


def unregister():
    """Undo `register`."""
    del bpy.types.Scene.r5dgs_render
    bpy.utils.unregister_class(R5DGS_PG_render)
