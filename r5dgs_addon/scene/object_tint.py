"""How the user recolours objects: a tint on clouds, which preview, render and export obey and viewports show.

The tint multiplies the display-referred sRGB colour of the cloud's Gaussians. It lies on the object and not in its
points, so that taking it back loses nothing; `display_color` and the object's viewport colour follow it.
"""

import bpy
import numpy as np
from bpy.props import BoolProperty, FloatVectorProperty, PointerProperty

from . import point_clouds

NONE = (1.0, 1.0, 1.0)
OVERRIDABLE = {"LIBRARY_OVERRIDABLE"}  # so that a library override of a linked scene keeps its own


def _follow(look: bpy.types.PropertyGroup, _: bpy.types.Context) -> None:
    show(look.id_data)


class R5DGS_PG_look(bpy.types.PropertyGroup):
    """How a cloud looks other than its file says."""

    tint: FloatVectorProperty(
        name="Tint",
        description="Color that the Gaussians are multiplied with; white leaves them as they were captured",
        subtype="COLOR_GAMMA",
        size=3,
        default=NONE,
        min=0.0,
        soft_max=1.0,
        max=8.0,
        update=_follow,
        options=set(),
        override=OVERRIDABLE,
    )
    shown: BoolProperty(
        name="Shown", description="Whether the viewport color is the tint's", options=set(), override=OVERRIDABLE
    )
    plain: FloatVectorProperty(
        name="Plain Color",
        description="Viewport color of the object without tint",
        size=4,
        options=set(),
        override=OVERRIDABLE,
    )


def tint(obj: bpy.types.Object) -> np.ndarray:
    """The factors on a cloud's display-referred sRGB colour. [3] float64"""
    return np.array(obj.r5dgs_look.tint, np.float64)


def is_tinted(obj: bpy.types.Object) -> bool:
    """Whether a cloud is recoloured."""
    return tuple(obj.r5dgs_look.tint) != NONE


def recolor(wanted: list[bpy.types.Object], tint) -> list[str]:
    """Tint clouds.

    Args:
        wanted: The clouds.
        tint: Factors on display-referred sRGB. [3]

    Returns:
        Names of those that are linked from another file and therefore left as they are.
    """
    for cloud in wanted:
        if cloud.library is None:
            cloud.r5dgs_look.tint = tuple(tint)
    return [cloud.name for cloud in wanted if cloud.library is not None]


def show(cloud: bpy.types.Object) -> None:
    """Let a cloud's viewport colour and the display colour of its points follow its tint."""
    look, factors = cloud.r5dgs_look, tint(cloud)
    if is_tinted(cloud):
        if not look.shown:
            look.plain, look.shown = cloud.color, True
        cloud.color = (*point_clouds.srgb_to_linear(factors), look.plain[3])
    elif look.shown:
        cloud.color, look.shown = look.plain, False
    if cloud.type != "POINTCLOUD" or cloud.data is None or cloud.data.library is not None:
        return
    if _shares_points(cloud):
        cloud.data = cloud.data.copy()
    point_clouds.show_tint(cloud.data, factors)


def _shares_points(cloud: bpy.types.Object) -> bool:
    """Whether an object of another tint shows the same points (Alt+D)."""
    if cloud.data.users == 1:
        return False
    return any(
        other.data == cloud.data and tuple(other.r5dgs_look.tint) != tuple(cloud.r5dgs_look.tint)
        for other in bpy.data.objects
    )


def register():
    """Register the group and hang it on objects."""
    bpy.utils.register_class(R5DGS_PG_look)
    bpy.types.Object.r5dgs_look = PointerProperty(type=R5DGS_PG_look, override=OVERRIDABLE)


def unregister():
    """Undo `register`."""
    del bpy.types.Object.r5dgs_look
    bpy.utils.unregister_class(R5DGS_PG_look)
