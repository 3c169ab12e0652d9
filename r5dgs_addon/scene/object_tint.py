"""Recolouring of objects by a tint, which is applied in preview, render, export and viewport.

The tint multiplies the display-referred sRGB colour of the Gaussians. It is stored on the object and not in its
points, so that removing it restores the original colours. `display_color` and the object's viewport colour follow it.
"""

import bpy
import numpy as np
from bpy.props import BoolProperty, FloatVectorProperty, PointerProperty

from ...r5dgs_core.color import srgb
from . import point_clouds

NONE = (1.0, 1.0, 1.0)
OVERRIDABLE = {"LIBRARY_OVERRIDABLE"}  # lets a library override of a linked scene keep its own tint


def _follow(look: bpy.types.PropertyGroup, _: bpy.types.Context) -> None:
    show(look.id_data)


class R5DGS_PG_look(bpy.types.PropertyGroup):
    """Tint of a point cloud and its original viewport colour."""

    tint: FloatVectorProperty(
        name="Tint",
        description="Color that multiplies the Gaussians; white keeps the captured colors",
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
        name="Shown", description="The viewport color shows the tint", options=set(), override=OVERRIDABLE
    )
    plain: FloatVectorProperty(
        name="Plain Color",
        description="Viewport color without the tint",
        size=4,
        options=set(),
        override=OVERRIDABLE,
    )


def tint(obj: bpy.types.Object) -> np.ndarray:
    """Factors of a point cloud's display-referred sRGB colour. [3] float64"""
    return np.array(obj.r5dgs_look.tint, np.float64)


def is_tinted(obj: bpy.types.Object) -> bool:
    """True if a point cloud is tinted."""
    return tuple(obj.r5dgs_look.tint) != NONE


def recolor(wanted: list[bpy.types.Object], tint) -> list[str]:
    """Tint point clouds.

    Args:
        wanted: Point clouds.
        tint: Factors of display-referred sRGB. [3]

    Returns:
        Names of linked point clouds, which are not changed.
    """
    for cloud in wanted:
        if cloud.library is None:
            cloud.r5dgs_look.tint = tuple(tint)
    return [cloud.name for cloud in wanted if cloud.library is not None]


def show(cloud: bpy.types.Object) -> None:
    """Apply a point cloud's tint to its viewport colour and to the display colour of its points."""
    look, factors = cloud.r5dgs_look, tint(cloud)
    if is_tinted(cloud):
        if not look.shown:
            look.plain, look.shown = cloud.color, True
        cloud.color = (*srgb.to_linear(np.minimum(factors, 1)), look.plain[3])
    elif look.shown:
        cloud.color, look.shown = look.plain, False
    if cloud.type != "POINTCLOUD" or cloud.data is None or cloud.data.library is not None:
        return
    if _shares_points(cloud):
        cloud.data = cloud.data.copy()
    point_clouds.show_tint(cloud.data, factors)


def _shares_points(cloud: bpy.types.Object) -> bool:
    """True if an object with another tint uses the same points (Alt+D)."""
    if cloud.data.users == 1:
        return False
    return any(
        other.data == cloud.data and tuple(other.r5dgs_look.tint) != tuple(cloud.r5dgs_look.tint)
        for other in bpy.data.objects
    )


def register():
    """Register the property group on objects."""
    bpy.utils.register_class(R5DGS_PG_look)
    bpy.types.Object.r5dgs_look = PointerProperty(type=R5DGS_PG_look, override=OVERRIDABLE)


def unregister():
    """Undo `register`."""
    del bpy.types.Object.r5dgs_look
    bpy.utils.unregister_class(R5DGS_PG_look)
