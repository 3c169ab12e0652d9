"""The views of a stereoscopic or multi-view render: each is a picture of its own, by an eye of its own."""

from collections.abc import Iterator

import bpy
import numpy as np

from . import view_cameras


def names(scene: bpy.types.Scene) -> list[str]:
    """Names of the views that a Blender scene renders; one without a name where it renders in mono."""
    render = scene.render
    if not render.use_multiview:
        return [""]
    found = render.stereo_views if render.views_format == "STEREO_3D" else render.views
    return [view.name for view in found if view.use] or [""]


def eyes(
    engine: bpy.types.RenderEngine, depsgraph: bpy.types.Depsgraph
) -> Iterator[tuple[str, view_cameras.Eye | None]]:
    """The views one after the other, each the engine's active one while it is its turn.

    Args:
        engine: What renders.
        depsgraph: Evaluated.

    Yields:
        The view's name and its eye; none, which means the camera's own, where the scene renders in mono.
    """
    for name in names(depsgraph.scene):
        camera = None
        if name:
            engine.active_view_set(name)
            camera = engine.camera_override  # the one that the view's suffix chooses among several
        if camera is None or camera.type != "CAMERA":
            yield name, None
        else:
            matrix = np.array(engine.camera_model_matrix(camera), np.float64)
            yield name, view_cameras.Eye(camera, matrix, engine.camera_shift_x(camera))
