"""Render time and error of the last preview, shown in the sidebar and not saved."""

from typing import Any

import bpy
from bpy.props import FloatProperty, IntProperty, PointerProperty, StringProperty

from ..ui import plural


class R5DGS_PG_figures(bpy.types.PropertyGroup):
    """Statistics of the last preview."""

    size: StringProperty(name="Size", description="Width and height of the last preview in pixels")
    ms_motion: FloatProperty(name="Motion", description="Time spent posing Gaussians (ms)")
    ms_raster: FloatProperty(name="Raster", description="Time spent rasterizing (ms)")
    error: StringProperty(name="Error", description="Known error of the rendered scenes")
    unbent: IntProperty(name="Not Bent", description="Gaussians with residual motion that the preview leaves out")


def remember(image: bpy.types.Image, result: dict[str, Any]) -> None:
    """Store the statistics of an image from the worker's result."""
    figures = bpy.context.window_manager.r5dgs_figures
    figures.size = f"{image.size[0]} x {image.size[1]}"
    figures.ms_motion, figures.ms_raster = result["ms_motion"], result["ms_raster"]
    known = result["scenes"]
    texts = [f"{one['name']}: {one['error']}" if len(known) > 1 else one["error"] for one in known]
    figures.error = "; ".join(texts)
    figures.unbent = sum(one["unbent"] for one in known)


def speed() -> str:
    """Size and render time of the last preview in one line, or "" before the first preview."""
    figures = bpy.context.window_manager.r5dgs_figures
    if not figures.size:
        return ""
    total = figures.ms_motion + figures.ms_raster
    return f"{figures.size} in {total:.0f} ms (motion {figures.ms_motion:.0f}, raster {figures.ms_raster:.0f})"


def errors() -> list[str]:
    """Known error of the last preview, one line per item."""
    figures = bpy.context.window_manager.r5dgs_figures
    lines = [figures.error] if figures.error else []
    if figures.unbent:
        lines.append(
            f"{plural.of(figures.unbent, 'Gaussian', 'bend')} in the observed time but are shown rigid; see Exact Mode"
        )
    return lines


def register():
    """Register the property group on the window manager."""
    bpy.utils.register_class(R5DGS_PG_figures)
    bpy.types.WindowManager.r5dgs_figures = PointerProperty(type=R5DGS_PG_figures)


def unregister():
    """Undo `register`."""
    del bpy.types.WindowManager.r5dgs_figures
    bpy.utils.unregister_class(R5DGS_PG_figures)
