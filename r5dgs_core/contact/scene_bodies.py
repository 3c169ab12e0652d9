"""Bodies of a scene: shapes from their hulls, and observed poses."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from .. import errors
from ..motion import models, rotations
from ..scene import gravity, presence, slipped_rotations, world_axes
from ..scene.scene import MotionGroup, Scene
from ..shapes import solid
from .observed_track import Track

_PLACE_NOISE, _TURN_NOISE = 0.003, 0.004  # of poses without known errors: in sizes, and rad
_STILL = 0.05  # motion, in sizes, in the last three poses before a body set off; a law that misses more is wrong there
_FREE = ("translation", "ballistic_spin", "free_top", "drag", "bounce", "friction")


@dataclass(frozen=True)
class SceneBody:
    """A body of a scene.

    Attributes:
        group: Its motion group; group 0 for an object that is part of the background's motion.
        name: Name of its object.
        solid: Its shape in the bind state.
        moves: True if it moves at t_max.
        reason: Reason for not simulating its motion, or "".
    """

    group: MotionGroup
    name: str
    solid: solid.Solid
    moves: bool
    reason: str

    @property
    def smooth(self) -> models.MotionModel:
        """Its motion past t_max without contacts."""
        return self.group.smooth or self.group.model


def of(scene: Scene) -> tuple[list[SceneBody], list[str]]:
    """Return the bodies of a scene whose hulls are sound, and a line about each of the others.

    Bodies that are absent past t_max are left out.
    """
    names = {item.id: item.name for item in scene.objects}
    found, lines = [], []
    for hull in scene.hulls:
        group, name = scene.groups[hull.motion_id], names[hull.object_id]
        if presence.span(group.absent)[1] < np.inf:
            lines.append(f"{name}: has left the scene before t_max")
            continue
        try:
            shape = solid.of(hull.vertices)
        except errors.ConfigError as error:
            lines.append(f"{name}: has no contacts: {error}")
            continue
        body = SceneBody(group, name, shape, _moves(scene, group), "")
        found.append(dataclasses.replace(body, reason=_reason(scene, body) if body.moves else ""))
    return found, lines


def without_contacts(scene: Scene) -> Scene:
    """Return the scene with its smooth motions, whose rotations that slipped are marked as unknown.

    The band of a motion with contacts is left out.
    """
    smooth = dataclasses.replace(scene, groups=tuple(_smoothed(group) for group in scene.groups))
    slipped = slipped_rotations.recorded(scene)
    return slipped_rotations.unknown(smooth, slipped) if slipped else smooth


def _smoothed(group: MotionGroup) -> MotionGroup:
    if group.smooth is None:
        return group
    history = dataclasses.replace(group.history, band=None)
    return dataclasses.replace(group, model=group.smooth, smooth=None, history=history)


def obstacles(scene: Scene, points: Mapping[str, np.ndarray]) -> list[SceneBody]:
    """Return fixed bodies by name: the convex hulls of points [V, 3] in the world. Raises ConfigError for flat ones."""
    found = []
    for name, corners in points.items():
        try:
            found.append(SceneBody(scene.groups[0], name, solid.of(corners), False, ""))
        except errors.ConfigError as error:
            raise errors.ConfigError(f"{name}: nothing can collide with it: {error}; give it a thickness") from error
    return found


def track(scene: Scene, body: SceneBody, center: np.ndarray | None = None) -> Track:
    """Return the observed poses of a body since it last set off, with their errors.

    Args:
        scene: The scene.
        body: The body.
        center: Centre of mass in the bind state whose places to return; None for that of the body's shape. [3]
    """
    center = body.solid.center if center is None else center
    group, times = body.group, scene.tracks.times
    poses, size = scene.tracks.poses[group.id], body.solid.size
    arms = rotations.rotate(poses[:, :4], np.broadcast_to(center - group.pivot, (len(times), 3)))
    place, turn = np.full(len(times), _PLACE_NOISE * size), np.full(len(times), _TURN_NOISE)
    known = group.history.errors
    if known is not None:
        place, turn = np.maximum(place, known.place), np.maximum(turn, known.turn)
    places = group.pivot + poses[:, 4:] + arms
    begins = [event.time for event in group.history.events if event.kind == "change"]
    starts = (event.time for event in group.history.events if event.kind == "start")
    begins += [time for time in starts if np.ptp(places[times <= time][-3:], axis=0).max(initial=0.0) < _STILL * size]
    rows = np.isfinite(place) & (times > max(begins, default=-np.inf))
    if group.seen is not None:
        rows &= (times >= group.seen[0] - 1e-9) & (times <= group.seen[1] + 1e-9)
    return Track(times[rows], poses[rows, :4], places[rows], place[rows], turn[rows])


def predicted(body: SceneBody, tau: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotations [T, 4] and centres of mass [T, 3] of a body's smooth motion at times since t_max."""
    quats, moved = models.evaluate(body.smooth, tau)
    arms = rotations.rotate(quats, np.broadcast_to(body.solid.center - body.group.pivot, moved.shape))
    return quats, body.group.pivot + moved + arms


def _moves(scene: Scene, group: MotionGroup) -> bool:
    still = (group.smooth or group.model).kind == "static" and group.parent is None and group.follows is None
    return bool(group.id and not still and np.any(scene.tracks.poses[group.id, :, 1:] != 0))


def _reason(scene: Scene, body: SceneBody) -> str:
    """Return the reason for not simulating a body, such as that a hand, a motor or a string drives it, or ""."""
    group, model, up = body.group, body.smooth, world_axes.UP_AXIS.get(scene.world_convention)
    if group.joint is not None or group.parent is not None or group.follows is not None:
        return "it is a part of another body"
    if model.kind not in _FREE or model.frequency > 0 or model.angular_acceleration.any() and model.center_offset.any():
        return f"its motion is that of a driven body ({models.KINDS[model.kind].word})"
    free = ("translation", "ballistic_spin", "free_top")
    if model.kind in free and model.acceleration.any() and up is not None and not gravity.falls(model, up):
        return "its acceleration is not that of gravity"
    if not len(track(scene, body)):
        return "it was not seen since it set off"
    return ""
