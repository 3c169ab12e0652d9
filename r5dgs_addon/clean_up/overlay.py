"""Selected Gaussians, corners of selected objects and the current stroke, drawn over 3D views."""

import bpy
import gpu
import numpy as np
from gpu_extras.batch import batch_for_shader

from ..scene import loaded_scenes, point_clouds, viewport_display
from . import selected_points

COLOR = (1.0, 0.45, 0.05, 0.9)
POINT_SIZE = 4.0  # pixels
CORNER = 0.15  # length of the lines at a corner, as a fraction of the edge
_EDGES = tuple((a, a ^ bit) for a in range(8) for bit in (1, 2, 4))  # corners of a box, x in the lowest bit
_handles: list[object] = []
_batches: dict[int, tuple[str, object]] = {}  # points on the graphics card and their fingerprint, by session_uid


def _draw() -> None:
    """Draw the selected objects and points of all visible clouds; Blender calls this for each 3D view."""
    context = bpy.context
    _draw_corners(context)
    shown = [
        cloud
        for collection in loaded_scenes.scene_collections()
        for cloud in selected_points.selected_clouds(collection)
        if cloud.visible_get(view_layer=context.view_layer, viewport=context.space_data)
    ]
    alive = {cloud.data.session_uid for cloud in shown}
    for uid in _batches.keys() - alive:
        del _batches[uid]
    if not shown:
        return
    shader = gpu.shader.from_builtin("UNIFORM_COLOR")
    gpu.state.point_size_set(POINT_SIZE * context.preferences.system.pixel_size)
    gpu.state.blend_set("ALPHA")
    shader.bind()
    shader.uniform_float("color", COLOR)
    depsgraph = context.evaluated_depsgraph_get()
    for cloud in shown:
        with gpu.matrix.push_pop():
            gpu.matrix.multiply_matrix(cloud.evaluated_get(depsgraph).matrix_world)
            _batch(cloud.data, shader).draw(shader)
    gpu.state.blend_set("NONE")
    gpu.state.point_size_set(1.0)


def _draw_corners(context: bpy.types.Context) -> None:
    """Mark the selected objects shown as splats by the corners of their boxes; splats cover Blender's own outlines."""
    if context.mode != "OBJECT" or not context.space_data.overlay.show_overlays:
        return
    theme, active = context.preferences.themes[0].view_3d, context.view_layer.objects.active
    shader = gpu.shader.from_builtin("UNIFORM_COLOR")
    gpu.state.depth_test_set("NONE")
    shader.bind()
    for obj in context.selected_objects:
        if obj.r5dgs.role not in ("CLOUD", "ANCHOR"):
            continue
        color = theme.object_active if obj == active else theme.object_selected
        for cloud in (one for one in (obj, *obj.children) if one.r5dgs.role == "CLOUD"):
            if viewport_display.draws_splats(cloud) and cloud.visible_get(viewport=context.space_data):
                shader.uniform_float("color", (*color, 1.0))
                batch_for_shader(shader, "LINES", {"pos": _corners(cloud)}).draw(shader)


def _corners(cloud: bpy.types.Object) -> list[tuple[float, ...]]:
    """Ends of short lines along the edges of a cloud's box, in the world."""
    box = np.array(cloud.bound_box, np.float64)
    low, high = box.min(0), box.max(0)
    places = np.array([[(high if corner >> axis & 1 else low)[axis] for axis in range(3)] for corner in range(8)])
    matrix = np.array(cloud.matrix_world, np.float64)
    places = places @ matrix[:3, :3].T + matrix[:3, 3]
    ends = [(places[a], places[a] + CORNER * (places[b] - places[a])) for a, b in _EDGES]
    return [tuple(end) for line in ends for end in line]


def _batch(data: bpy.types.PointCloud, shader):
    """Selected points of a cloud on the graphics card."""
    places = point_clouds.view(point_clouds.attribute(data, "position", "FLOAT_VECTOR"), "vector", 3)
    places = np.ascontiguousarray(places[selected_points.mask(data)])
    key = point_clouds.fingerprint(places)
    if _batches.get(data.session_uid, ("",))[0] != key:
        _batches[data.session_uid] = key, batch_for_shader(shader, "POINTS", {"pos": places})
    return _batches[data.session_uid][1]


def draw_path(path: list[tuple[float, float]], closed: bool, radius: float | None) -> None:
    """Draw a stroke in pixels of the current region.

    Args:
        path: Its places.
        closed: True to join the last place to the first.
        radius: Radius of the brush at the last place, or None for a lasso.
    """
    if radius is not None:
        turns = np.linspace(0, 2 * np.pi, 49)
        path = [(path[-1][0] + radius * np.cos(a), path[-1][1] + radius * np.sin(a)) for a in turns]
    if len(path) < 2:
        return
    shader = gpu.shader.from_builtin("UNIFORM_COLOR")
    shader.bind()
    shader.uniform_float("color", COLOR)
    corners = [(x, y, 0.0) for x, y in ([*path, path[0]] if closed else path)]
    batch_for_shader(shader, "LINE_STRIP", {"pos": corners}).draw(shader)


def register():
    """Register the drawing, if there is a window."""
    if not bpy.app.background:
        _handles.append(bpy.types.SpaceView3D.draw_handler_add(_draw, (), "WINDOW", "POST_VIEW"))


def unregister():
    """Undo `register`."""
    while _handles:
        bpy.types.SpaceView3D.draw_handler_remove(_handles.pop(), "WINDOW")
    _batches.clear()
