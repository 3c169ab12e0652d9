"""Deletion of the selected Gaussians, and their assignment to another object."""

from collections.abc import Callable

import bpy
import numpy as np

from ...r5dgs_core import errors
from ..scene import object_names, point_clouds, point_subset
from . import selected_points


def delete(context: bpy.types.Context, collection: bpy.types.Collection) -> int:
    """Delete the selected Gaussians of a loaded scene. Clouds without further points are removed.

    Returns:
        Number of deleted Gaussians.

    Raises:
        ConfigError: A cloud cannot be edited; nothing is changed.
    """
    members = selected_points.selected_clouds(collection)
    for cloud in members:
        selected_points.check_editable(cloud)
    return _remove_selected(context, members)


def assign(context: bpy.types.Context, collection: bpy.types.Collection, object_id: int) -> int:
    """Assign the selected Gaussians of a loaded scene to an object, with which they move from now on.

    They get a cloud of their own for each cloud that they come from. At the current frame, they stay in place.

    Args:
        context: Context with the current frame.
        collection: Loaded scene.
        object_id: Object of its table.

    Returns:
        Number of assigned Gaussians.

    Raises:
        ConfigError: A cloud cannot be edited, or the object has no points left; nothing is changed.
    """
    own = [cloud for cloud in object_names.clouds(collection, object_id) if cloud.parent is not None]
    home = max(own, key=lambda cloud: len(cloud.data.points), default=None)
    name = object_names.names(collection).get(object_id, f"object {object_id}")
    if home is None:
        raise errors.ConfigError(f"{name}: expected an object with an anchor, found none; choose another object")
    members = [
        one for one in selected_points.selected_clouds(collection) if one.parent != home.parent or one not in own
    ]
    for cloud in (home, *members):
        selected_points.check_editable(cloud)
    name_of = {cloud: object_names.fit(f"{name} from {cloud.name}") for cloud in members}
    return _remove_selected(
        context, members, lambda cloud, chosen: _cloud_of_selected(cloud, home, chosen, name_of[cloud])
    )


def _remove_selected(
    context: bpy.types.Context,
    members: list[bpy.types.Object],
    use: Callable[[bpy.types.Object, np.ndarray], object] = lambda cloud, chosen: None,
) -> int:
    """Call ``use`` for each cloud, then remove the selected points. Returns their number.

    Clouds that keep no points are removed. Copies of an object still share their points.
    """
    kept: dict[bpy.types.PointCloud, bpy.types.PointCloud | None] = {}
    total = 0
    for cloud in members:
        data, chosen = cloud.data, selected_points.mask(cloud.data)
        use(cloud, chosen)
        if data not in kept:
            total += int(chosen.sum())
            kept[data] = None if chosen.all() else _unselected(point_subset.of(data, ~chosen))
        if kept[data] is None:
            bpy.data.objects.remove(cloud)
        else:
            cloud.data = kept[data]
    bpy.data.batch_remove([data for data in kept if data.users == 0])
    context.view_layer.update()
    return total


def _cloud_of_selected(
    cloud: bpy.types.Object, home: bpy.types.Object, chosen: np.ndarray, name: str
) -> bpy.types.Object:
    """Copy the points in a mask [n] to a new cloud, which belongs to the object of ``home`` and its anchor."""
    part = cloud.copy()
    part.name, part.data = name, _unselected(point_subset.of(cloud.data, chosen))
    part.data.name = part.name
    part.animation_data_clear()
    home.users_collection[0].objects.link(part)
    anchor, state = home.parent, part.r5dgs
    part.parent = anchor
    place = anchor.matrix_world.inverted_safe() @ cloud.matrix_world
    part.matrix_parent_inverse = place @ part.matrix_basis.inverted_safe()
    part.r5dgs_look.shown = False
    part.color = home.r5dgs_look.plain if home.r5dgs_look.shown else home.color
    part.r5dgs_look.tint = home.r5dgs_look.tint
    part.r5dgs_named.object_id, part.r5dgs_named.given = object_names.NOBODY, ""
    rows = point_clouds.attribute(part.data, point_clouds.ROW, "INT")
    state.object_id, state.motion_id, state.pivot = home.r5dgs.object_id, anchor.r5dgs.motion_id, anchor.r5dgs.pivot
    state.start, state.count = cloud.r5dgs.start if rows is None else rows.data[0].value, int(chosen.sum())
    labels = part.data.attributes.get("object_id")
    if labels is not None:
        labels.data.foreach_set("value", np.full(state.count, state.object_id, np.int32))
    return part


def _unselected(data: bpy.types.PointCloud) -> bpy.types.PointCloud:
    """Clear the selection of points. Returns them."""
    selected_points.store(data, np.zeros(len(data.points), bool))
    return data
