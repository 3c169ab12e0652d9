"""Views of a stereoscopic or multi-view render. Each view is rendered separately, with its own eye."""

from collections.abc import Iterator

import bpy
import numpy as np

from . import view_cameras


def names(scene: bpy.types.Scene) -> list[str]:
    """Names of the views that a scene renders, or [""] without multi-view."""
    render = scene.render
    if not render.use_multiview:
        return [""]
    found = render.stereo_views if render.views_format == "STEREO_3D" else render.views
    return [view.name for view in found if view.use] or [""]


def cameras(engine: bpy.types.RenderEngine, scene: bpy.types.Scene) -> Iterator[tuple[str, bpy.types.Object | None]]:
    """Iterate over the views, making each the active view of the engine.

    Yields:
        Name of the view, and its camera, selected by the view's suffix, or None without multi-view.
    """
    for name in names(scene):
        camera = None
        if name:
            engine.active_view_set(name)
            camera = engine.camera_override
        yield name, camera if camera is not None and camera.type == "CAMERA" else None


def eye(engine: bpy.types.RenderEngine, camera: bpy.types.Object | None) -> view_cameras.Eye | None:
    """Return the eye of a camera in the active view at the evaluated frame, or None without a camera."""
    if camera is None:
        return None
    matrix = np.array(engine.camera_model_matrix(camera), np.float64)
    return view_cameras.Eye(camera, matrix, engine.camera_shift_x(camera))
