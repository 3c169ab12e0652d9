"""Joints between the parts of an object, and their motion past t_max.

An object with several bodies gets a tree: its root is the part whose own motion is most predictable, and each other
part hangs on the one with which the evidence for a joint is strongest. Parts without a joint stay bodies of their own.
"""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Sequence

import numpy as np

from ..motion_fit import joints
from ..motion_fit import noise as noises
from ..scene.scene import MotionGroup, Scene
from .draft import Context, Draft

log = logging.getLogger(__name__)


def apply(draft: Draft, context: Context) -> Draft:
    """Find the joints of all objects with several bodies."""
    observed = np.stack([group.observed for group in draft.observed.motion.groups])
    return dataclasses.replace(draft, scene=connect(draft.scene, observed))


def connect(scene: Scene, observed: np.ndarray) -> Scene:
    """Return the scene with the joints between bodies of the same object.

    Args:
        scene: The scene, with motion models.
        observed: Knots at which each group was placed. [G, S] bool
    """
    groups = list(scene.groups)
    for item in scene.objects:
        bodies = [g for g in scene.groups if g.object_id == item.id > 0 and g.role == "body"]
        if len(bodies) < 2:
            continue
        root = min(range(len(bodies)), key=lambda k: _doubt(scene, bodies[k]))
        for child, parent in _tree(scene, bodies, observed, root):
            part = _part(groups[parent.id], child, scene, observed)
            groups[child.id] = part
            assert part.joint is not None
            log.info("%s: part %d, %s", item.name, child.id, part.joint.text())
    return dataclasses.replace(scene, groups=tuple(groups))


def _doubt(scene: Scene, group: MotionGroup) -> tuple[float, int]:
    """Sort key, most predictable body first: half width at the band's end in radii, minus the member count."""
    band = group.history.band
    moves = bool(np.any(scene.tracks.poses[group.id, :, 1:] != 0))
    width = band.half_width[-1] / group.model.radius if moves and band is not None else 0.0 if not moves else np.inf
    return width, -int((scene.gaussians.motion_ids == group.id).sum())


def _tree(
    scene: Scene, bodies: Sequence[MotionGroup], observed: np.ndarray, root: int
) -> list[tuple[MotionGroup, MotionGroup]]:
    """Return the pairs of child and parent, parents first."""
    costs = np.full((len(bodies), len(bodies)), np.inf)
    for a, b in np.ndindex(costs.shape):
        found = _find(scene, bodies[a], bodies[b], observed) if a != b else None
        costs[a, b] = np.inf if found is None else found.cost
    parents, pairs, reached = joints.parents(costs, root), [], [root]
    while children := [k for k, above in enumerate(parents) if above in reached and k not in reached]:
        pairs += [(bodies[k], bodies[above]) for k in children if (above := parents[k]) is not None]
        reached += children
    return pairs


def _part(parent: MotionGroup, child: MotionGroup, scene: Scene, observed: np.ndarray) -> MotionGroup:
    """Return the child with its joint, and the history of its motion relative to the parent."""
    found = _find(scene, parent, child, observed)
    assert found is not None
    lever = float(np.linalg.norm(child.pivot - parent.pivot))
    band = joints.carried(parent.history.band, found.history.band, lever, child.model.radius)
    history = dataclasses.replace(found.history, band=band, errors=child.history.errors)
    return dataclasses.replace(child, parent=parent.id, joint=found.joint, history=history)


def _find(scene: Scene, parent: MotionGroup, child: MotionGroup, observed: np.ndarray) -> joints.Found | None:
    """Return the joint between two bodies, or None."""
    weights = (observed[parent.id] & observed[child.id]).astype(np.float64)
    least = np.zeros(2)
    for group in (parent, child):
        own = np.array(noises.of_images(group.model.radius))
        errors = group.history.errors
        if errors is not None:
            usual = [
                np.median([x for x in values if np.isfinite(x)] or [0.0]) for values in (errors.place, errors.turn)
            ]
            own = np.maximum(own, usual)
        least += own**2
    links = [
        joints.Link(poses[:, :4], poses[:, 4:], np.asarray(group.pivot, np.float64), group.model.radius)
        for group in (parent, child)
        for poses in [scene.tracks.poses[group.id]]
    ]
    place, turn = (float(x) for x in np.sqrt(least))
    return joints.find(scene.tracks.times, links[0], links[1], weights=weights, least_noise=(place, turn))
