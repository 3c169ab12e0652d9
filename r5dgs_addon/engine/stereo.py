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


def eyes(
    engine: bpy.types.RenderEngine, depsgraph: bpy.types.Depsgraph
) -> Iterator[tuple[str, view_cameras.Eye | None]]:
    """Iterate over the views, making each the active view of the engine.

    Args:
        depsgraph: Evaluated depsgraph.

    Yields:
        Name of the view, and its eye, or None for the camera itself (without multi-view).
    """
    for name in names(depsgraph.scene):
        camera = None
        if name:
            engine.active_view_set(name)
            camera = engine.camera_override  # camera selected by the view's suffix
        if camera is None or camera.type != "CAMERA":
            yield name, None
        else:
            matrix = np.array(engine.camera_model_matrix(camera), np.float64)
            yield name, view_cameras.Eye(camera, matrix, engine.camera_shift_x(camera))
