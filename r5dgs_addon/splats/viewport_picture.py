"""Picture of a 3D view with splats, of any size. Blender's own *Viewport Render* calls no draw handlers."""

from __future__ import annotations

import bpy
import gpu
import numpy as np

from ..scene import render_settings
from . import mesh_depth, paste, viewport_splats, visible_splats
from . import splat_renderer as renderer


def draw(context: bpy.types.Context, width: int, height: int) -> np.ndarray:
    """Draw a 3D view: what Blender shows in it, and splats.

    A view through a camera shows the camera's whole image, other views the same part of the scene as on the screen.

    Args:
        context: Context of the view; drawing needs a window.
        width: Pixels.
        height: Pixels.

    Returns:
        Display-referred colors, top row first. [H, W, 3] in [0, 1]

    Raises:
        CompileError: The graphics card's driver refuses the shaders.
        ConfigError: There are more Gaussians than the graphics card's textures hold.
    """
    viewport_splats.catch_up()
    depsgraph, space = context.evaluated_depsgraph_get(), context.space_data
    view = _view(context, depsgraph, width, height)
    found = visible_splats.shown(depsgraph, space)
    picture = gpu.types.GPUOffScreen(width, height, format="RGBA8")
    _draw_scene(context, picture, view)
    meshes, drawn = None, mesh_depth.MeshDepth()
    if found is not None and viewport_splats.is_anything_else_drawn(context):
        # these write no depth buffer here, even if overlays are shown
        if space.shading.type in ("MATERIAL", "RENDERED"):
            drawn.find(depsgraph, space)
            drawn.draw(view)
            meshes = drawn.texture
        else:
            with picture.bind():
                meshes = renderer.texture(viewport_splats.depth(width, height), width, "R32F")
    if found is not None:
        buffer = renderer.SplatBuffer()
        buffer.draw(found.table, found.groups, view, meshes)
        sky = found.sky if render_settings.of(context.scene).sky else None
        with picture.bind():
            paste.paste(buffer, meshes, view, sky, found.world, None)
    with picture.bind():
        pixels = gpu.state.active_framebuffer_get().read_color(0, 0, width, height, 4, 0, "FLOAT")
    pixels.dimensions = width * height * 4
    picture.free()
    return np.array(pixels, np.float32).reshape(height, width, 4)[::-1, :, :3]


def _draw_scene(context: bpy.types.Context, picture: gpu.types.GPUOffScreen, view: renderer.ViewMatrices) -> None:
    """Draw what Blender itself shows."""
    picture.draw_view3d(
        context.scene,
        context.view_layer,
        context.space_data,
        context.region,
        renderer.matrix(view.view_matrix),
        renderer.matrix(view.projection),
        do_color_management=True,
    )


def _view(context: bpy.types.Context, depsgraph: bpy.types.Depsgraph, width: int, height: int) -> renderer.ViewMatrices:
    view_3d, camera = context.region_data, context.space_data.camera or context.scene.camera
    if view_3d.view_perspective == "CAMERA" and camera is not None and camera.type == "CAMERA":
        evaluated, render = camera.evaluated_get(depsgraph), context.scene.render
        projection = evaluated.calc_matrix_camera(
            depsgraph, x=width, y=height, scale_x=render.pixel_aspect_x, scale_y=render.pixel_aspect_y
        )
        to_camera = np.linalg.inv(np.array(evaluated.matrix_world.normalized(), np.float64))
        return renderer.ViewMatrices(to_camera, np.array(projection, np.float64), width, height)
    projection = np.array(view_3d.window_matrix, np.float64)
    shown, wanted = np.array([context.region.width, context.region.height]), np.array([width, height])
    factors = shown / shown.max() * wanted.max() / wanted  # a view's focal length refers to the longer side
    projection[0] *= factors[0]
    projection[1] *= factors[1]
    return renderer.ViewMatrices(np.array(view_3d.view_matrix, np.float64), projection, width, height)
