"""Motion of groups as glTF animations: CUBICSPLINE keys of the nodes of their anchors.

The time of an animation is the scene time since the first observed time, in seconds; a unit of unknown length counts as
one second. The two tangents of a key differ if the velocity jumps there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..motion import cubic_curves, rotations
from ..motion.cubic_curves import Keys
from ..playback import group_curves, group_dynamics
from ..scene import presence
from ..scene.scene import MotionGroup, Scene
from ..scene.units import Units
from .gltf import Arrays, Content

CUBIC = "CUBICSPLINE"
_TO_XYZW, _TO_WXYZ = [1, 2, 3, 0], [3, 0, 1, 2]


def seconds_per_unit(units: Units) -> float:
    """Seconds of an animation per unit of scene time."""
    return units.seconds_per_unit or 1.0


def home(groups: Sequence[MotionGroup], group: MotionGroup) -> np.ndarray:
    """Position of a group's anchor at t_max in the frame of its parent. [3]"""
    return group.home if group.parent is None else group.home - groups[group.parent].home


def animation(
    scene: Scene,
    nodes: Mapping[int, int],
    meshes: Mapping[int, int],
    end: float,
    arrays: Arrays,
    mode: str,
    source: str,
) -> dict[str, Any] | None:
    """Add the motion of all groups in one playback mode; None if nothing changes.

    Args:
        scene: The scene.
        nodes: Number of the node of each motion group.
        meshes: Motion group of each node with Gaussians, by the number of the node.
        end: Last scene time.
        arrays: Arrays of the file.
        mode: Name of the animation.
        source: Source of the motion past t_max, one of `playback.modes.SOURCES`.
    """
    start, pace, reaches = float(scene.tracks.times[0]), seconds_per_unit(scene.units), group_curves.reaches(scene)
    other_models = None if source == "fitted" else group_dynamics.models_of(scene, source)
    clocks: dict[bytes, int] = {}
    samplers, channels = [], []
    for motion_id, node in nodes.items():
        if motion_id == 0:
            continue
        curves = group_curves.curves(scene, motion_id, end, float(reaches[motion_id]), other_models)
        shift = home(scene.groups, scene.groups[motion_id])
        for path, keys, offset in (("translation", curves.location, shift), ("rotation", curves.rotation, None)):
            if not (keys.values != keys.values[:1]).any():
                continue
            keys = _in_float32(keys, start, pace)
            clock = keys.times.astype(np.float32)
            if clock.tobytes() not in clocks:
                clocks[clock.tobytes()] = arrays.add(clock, bounds=True)
            samplers.append(
                {"input": clocks[clock.tobytes()], "output": arrays.add(_output(keys, offset)), "interpolation": CUBIC}
            )
            channels.append({"sampler": len(samplers) - 1, "target": {"node": node, "path": path}})
    for node, motion_id in meshes.items():
        if scene.groups[motion_id].absent:
            times, sizes = _sizes(scene.groups[motion_id], start, end)
            clock = arrays.add((pace * (times - start)).astype(np.float32), bounds=True)
            samplers.append({"input": clock, "output": arrays.add(sizes), "interpolation": "STEP"})
            channels.append({"sampler": len(samplers) - 1, "target": {"node": node, "path": "scale"}})
    return {"name": mode, "samplers": samplers, "channels": channels} if channels else None


def _sizes(group: MotionGroup, start: float, end: float) -> tuple[np.ndarray, np.ndarray]:
    """Scene times from the start to the end at which a group enters or leaves, and its scales: 0 while it is absent.

    Returns:
        Times [K], and scales [K, 3] that hold until the next time.
    """
    times = [start, *(t for interval in group.absent for t in interval if start < t < end)]
    there = [float(not presence.is_absent(group.absent, t)) for t in times]
    return np.array(times), np.repeat(np.array(there, np.float32), 3).reshape(-1, 3)


def _output(keys: Keys, offset: np.ndarray | None) -> np.ndarray:
    """In-tangents, values and out-tangents of keys, interleaved. [3 K, C]"""
    values = keys.values if offset is None else keys.values + offset
    found = np.stack([keys.left_slopes, values, keys.right_slopes], axis=1)
    found = found.reshape(-1, values.shape[1])
    return found[:, _TO_XYZW] if offset is None else found


def _in_float32(keys: Keys, start: float, pace: float) -> Keys:
    """Keys at seconds since the start, without keys that float32 cannot tell from the previous one."""
    times = (pace * (keys.times - start)).astype(np.float32).astype(np.float64)
    first = np.flatnonzero(np.append(True, np.diff(times) > 0))  # of each group of equal times
    last = np.append(first[1:], len(times)) - 1
    return Keys(times[first], keys.values[last], keys.left_slopes[first] / pace, keys.right_slopes[last] / pace)


def read(content: Content, animation: dict[str, Any], node: int, path: str, rest: np.ndarray) -> Keys:
    """Keys of a node over the seconds since the start; one key ``rest`` if it has none. Raises `SceneFileError`."""
    user = f"animation {animation.get('name')!r:.40}"
    samplers, channels = animation.get("samplers"), animation.get("channels")
    if not isinstance(samplers, list) or not isinstance(channels, list):
        raise content.error(f"{user}: expected lists of samplers and channels")
    for channel in channels:
        target = channel.get("target") if isinstance(channel, dict) else None
        if not isinstance(target, dict) or target.get("node") != node or target.get("path") != path:
            continue
        number = channel.get("sampler")
        sampler = samplers[number] if isinstance(number, int) and 0 <= number < len(samplers) else None
        if not isinstance(sampler, dict) or sampler.get("interpolation") != CUBIC:
            raise content.error(f"{user}: expected {CUBIC} samplers, found {sampler!r:.60}")
        times = content.floats(sampler.get("input"), 1, user).astype(np.float64)
        output = content.floats(sampler.get("output"), len(rest), user).astype(np.float64)
        if len(times) < 2 or (np.diff(times) <= 0).any() or len(output) != 3 * len(times):
            raise content.error(f"{user}: expected increasing times and three values at each, found {len(times)} times")
        left, values, right = np.moveaxis(output.reshape(-1, 3, len(rest)), 1, 0)
        return Keys(times, values, left, right)
    return Keys(np.zeros(1), rest[None], 0 * rest[None], 0 * rest[None])


def poses(
    content: Content, animation: dict[str, Any], node: int, home: np.ndarray, times: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Quaternions wxyz [S, 4] and displacements from the home [S, 3] of a node at seconds since the start."""
    turns = read(content, animation, node, "rotation", np.array([0.0, 0, 0, 1]))
    moves = read(content, animation, node, "translation", home)
    quats = cubic_curves.evaluate(turns, times)[:, _TO_WXYZ]
    return rotations.normalize(quats), cubic_curves.evaluate(moves, times) - home
