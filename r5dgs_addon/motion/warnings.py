"""Warnings of learned motion that is not predictable, for the list of objects, panels and messages."""

import math
import statistics
from collections.abc import Iterable

import bpy

from ...r5dgs_core.scene import predictability
from ..scene import object_names, timeline
from . import extrapolate, physics


def of_anchor(anchor: bpy.types.Object | None) -> str:
    """Warning of an anchor, such as "not predictable past 0.85 (hit at 0.55)".

    It is "" if the motion is predictable up to the end of the scene's keys, or was edited.
    """
    if anchor is None or not physics.has_motion(anchor):
        return ""
    collection = extrapolate.scene_of(anchor)
    end = math.inf if collection is None else timeline.of_collection(collection).t_end
    warning = physics.history(anchor).warning(end)
    return warning if warning and physics.band(anchor) is not None else ""


def of_object(collection: bpy.types.Collection, object_id: int) -> str:
    """Warning of the first of an object's anchors that has one, or ""."""
    return of_clouds(object_names.clouds(collection, object_id))


def of_clouds(clouds: Iterable[bpy.types.Object]) -> str:
    """Warning of the first of the anchors of point clouds that has one, or ""."""
    anchors = {cloud.parent for cloud in clouds} - {None}
    found = [(anchor.name, warning) for anchor in anchors if (warning := of_anchor(anchor))]
    return min(found)[1] if found else ""


def lines(collection: bpy.types.Collection) -> list[str]:
    """Warnings of all objects, each with the name of its object."""
    ids = object_names.names(collection)
    return [f"{name}: {found}" for key, name in ids.items() if (found := of_object(collection, key))]


def errors_of_poses(anchor: bpy.types.Object) -> list[str]:
    """Estimated errors of an anchor's observed poses in words, for a panel; empty if they are unknown."""
    errors = physics.history(anchor).errors
    if errors is None:
        return []
    turns, places = sorted(filter(math.isfinite, errors.turn)), sorted(filter(math.isfinite, errors.place))
    if not turns or not places:
        return []
    size = max(physics.size(anchor), 1e-9)
    turn = predictability.PoseError(*(math.degrees(x) for x in (statistics.median(turns), turns[-1])))
    place = predictability.PoseError(*(100 * x / size for x in (statistics.median(places), places[-1])))
    return [
        f"Rotation error: {predictability.rotation_text(turn)}",
        f"Position error: {predictability.position_text(place)} of its size",
    ]
