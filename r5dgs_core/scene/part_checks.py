"""Checks of the parts of objects: the tree of their motion groups, and their joints."""

from __future__ import annotations

from typing import Any

import numpy as np

from .. import findings
from ..motion.joint import BALL, KINDS, Joint
from . import cameras, model_checks
from .array_shapes import fail
from .scene import MotionGroup, Scene

_UNIT_TOLERANCE = 1e-6


def check(scene: Scene, place: str, guard: findings.Guard) -> None:
    """Raise `SceneFileError` naming a motion group whose parent or joint is invalid."""
    for row, group in enumerate(() if scene.groups is findings.UNREAD else scene.groups):
        with guard():
            if group is findings.UNREAD or (group.parent is None and group.joint is None):
                continue
            where = f"motion group {row}"
            if group.parent is None or group.joint is None:
                fail(place, where, "'parent' and 'joint' together", "only one")
            if group.role != "body" or group.follows is not None:
                fail(place, where, "a body that follows none, as it has a parent", repr(group.role))
            if not _is_tree(scene, row, group):
                fail(place, where, "a parent of the same object, and no circle of parents", group.parent)
            if (found := _fault(group.joint)) is not None:
                fail(f"{place}: {where}: joint", *found)


def _is_tree(scene: Scene, row: int, group: MotionGroup) -> bool:
    """Return True if the parents of a group are bodies of its object and end at one without a parent."""
    passed = {row}
    while group.parent is not None:
        if not 0 < group.parent < len(scene.groups) or group.parent in passed:
            return False
        passed.add(group.parent)
        above = scene.groups[group.parent]
        if above.object_id != group.object_id or above.role != "body":
            return False
        group = above
    return True


def _fault(joint: Joint) -> tuple[str, str, Any] | None:
    """Return key, expectation and finding of the first fault of a joint; None if it is sound."""
    farthest = cameras.FARTHEST
    if joint.kind not in KINDS:
        return "kind", f"one of {', '.join(KINDS)}", repr(joint.kind)
    if np.shape(joint.point) != (3,) or not (np.abs(joint.point) <= farthest).all():
        return "point", f"three numbers up to {farthest:g}", joint.point
    if joint.kind == BALL:
        if joint.axis is not None or joint.limits is not None:
            return "axis and limits", "null for a ball", "numbers"
    elif (
        joint.axis is None
        or np.shape(joint.axis) != (3,)
        or not abs(float(np.linalg.norm(joint.axis)) - 1) <= _UNIT_TOLERANCE
    ):
        return "axis", "a unit vector", joint.axis
    elif joint.limits is None or not -farthest <= joint.limits[0] <= joint.limits[1] <= farthest:
        return "limits", f"two numbers up to {farthest:g}, in order", joint.limits
    if joint.stop_time is not None and not 0 <= joint.stop_time <= model_checks.MAX_TIME:
        return "stop_time", f"a number from 0 to {model_checks.MAX_TIME:g}, or null", joint.stop_time
    return None
