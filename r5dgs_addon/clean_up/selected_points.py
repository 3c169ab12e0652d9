"""Selected Gaussians of a loaded scene, stored as an attribute of its point clouds."""

from collections.abc import Callable, Iterator

import bpy
import numpy as np

from ...r5dgs_core import errors
from ..scene import loaded_scenes, point_clouds, polls, viewport_display
from ..ui import status_bar

ATTRIBUTE = "r5dgs_selected"  # exists only while points of the cloud are selected
MODES = (
    ("SET", "Set", "Replace the selection"),
    ("ADD", "Extend", "Add to the selection"),
    ("SUBTRACT", "Subtract", "Remove from the selection"),
)


def clouds(collection: bpy.types.Collection) -> list[bpy.types.Object]:
    """Point clouds of a loaded scene that hold points."""
    members = loaded_scenes.members(collection, "CLOUD")
    return [obj for obj in members if obj.type == "POINTCLOUD" and len(obj.data.points)]


def mask(data: bpy.types.PointCloud) -> np.ndarray:
    """Mask of the selected points. [n]"""
    found = point_clouds.attribute(data, ATTRIBUTE, "BOOLEAN")
    if found is None:
        return np.zeros(len(data.points), bool)
    return point_clouds.read(found, "value", 1, bool)[:, 0]


def count(collection: bpy.types.Collection) -> int:
    """Number of selected Gaussians of a loaded scene."""
    return sum(int(mask(data).sum()) for data in {cloud.data for cloud in selected_clouds(collection)})


def selected_clouds(collection: bpy.types.Collection) -> list[bpy.types.Object]:
    """Point clouds of a loaded scene with selected Gaussians."""
    return [cloud for cloud in clouds(collection) if cloud.data.attributes.get(ATTRIBUTE) is not None]


def select(
    collection: bpy.types.Collection, mode: str, masks: Callable[[list[bpy.types.Object]], Iterator[np.ndarray]]
) -> int:
    """Change the selection.

    Args:
        collection: Loaded scene.
        mode: Key of `MODES`.
        masks: Function that yields, for each of the given clouds, the mask of its points. [n]

    Returns:
        Number of selected Gaussians afterwards.

    Raises:
        ConfigError: A cloud cannot be edited; nothing is changed.
    """
    members = clouds(collection)
    for cloud in members:
        check_editable(cloud)
    found: dict[bpy.types.PointCloud, np.ndarray] = {}  # copies of an object share their points
    for cloud, chosen in zip(members, list(masks(members)), strict=True):
        found[cloud.data] = chosen | found.get(cloud.data, False)
    for data, chosen in found.items():
        if mode != "SET":
            before = mask(data)
            chosen = before | chosen if mode == "ADD" else before & ~chosen
        store(data, chosen)
    status_bar.redraw("VIEW_3D")
    return count(collection)


def store(data: bpy.types.PointCloud, chosen: np.ndarray) -> None:
    """Store the mask of the selected points. [n]"""
    attributes = data.attributes
    found = attributes.get(ATTRIBUTE)
    if not chosen.any():
        if found is not None:
            attributes.remove(found)
        return
    found = found or attributes.new(ATTRIBUTE, "BOOLEAN", "POINT")
    found.data.foreach_set("value", np.ascontiguousarray(chosen, bool))


def check_editable(cloud: bpy.types.Object) -> None:
    """Check that the points of a cloud can be selected and edited.

    Raises:
        ConfigError: The cloud belongs to another .blend file, or modifiers change its points.
    """
    if any(one.library is not None or one.override_library is not None for one in (cloud, cloud.data)):
        raise errors.ConfigError(
            f"{cloud.name}: expected points of this file, found those of another .blend; open that one, or append them"
        )
    for modifier in cloud.modifiers:
        if modifier.name not in viewport_display.MODIFIERS and modifier.show_viewport:
            raise errors.ConfigError(
                f"{cloud.name}: the modifier '{modifier.name}' changes its points; apply it, or hide it in viewports"
            )


class NeedsSelected(polls.NeedsScene):
    """Mixin for operators on the selected Gaussians of the active scene."""

    @classmethod
    def poll(cls, context):
        if context.mode != "OBJECT":
            cls.poll_message_set("Switch to Object Mode first")
            return False
        if not super().poll(context):
            return False
        if not selected_clouds(loaded_scenes.active_collection(context)):
            cls.poll_message_set("Select Gaussians first")
            return False
        return True
