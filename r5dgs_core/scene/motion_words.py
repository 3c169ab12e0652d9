"""Motion of objects in words."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..motion.models import KINDS
from . import predictability, presence
from .scene import MotionGroup, Scene

STILL = 0.05  # maximum motion of a still object, as a share of its radius


def motion_of(scene: Scene, groups: Sequence[MotionGroup]) -> str:
    """Return the motion of an object past t_max in words, by its motion models; "pinned" if no group can move."""
    words, end = [], predictability.horizon(scene)
    for number, group in enumerate(groups, start=1):
        if group.joint is not None:
            words.append(f"part {number}: {group.joint.text()}")
        elif not KINDS[group.model.kind].fields and _moved(scene, group) <= STILL * group.model.radius:
            words.append("still")
        else:
            words.append(KINDS[group.model.kind].word)
        if more := [part for part in (presence.text(group.absent), group.history.text(end)) if part]:
            words[-1] += f"; {', '.join(more)}"
    return ", ".join(dict.fromkeys(words)) or "pinned"


def _moved(scene: Scene, group: MotionGroup) -> float:
    """Return the largest displacement of a point at the group's radius in the observed time, world units."""
    poses = scene.tracks.poses[group.id]
    chords = 2 * np.linalg.norm(poses[:, 1:4], axis=1)  # 2 sin(angle / 2)
    return float((np.linalg.norm(poses[:, 4:], axis=1) + chords * group.model.radius).max())
