"""Poses of objects in the units of a file, and the text of its header; shared by `poses`, `poses_csv` and `tum`."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np

from .. import errors
from ..playback import object_poses
from ..playback.object_poses import ObjectPoses
from ..scene.scene import Scene
from . import registry, scene_nodes

FRAME = (
    "T_world_object: maps points of the object's frame to the world. The object's frame has its origin at its anchor "
    "(pivot, or point of the joint); its axes are those of the world at t_max"
)
QUATERNION = "unit, Hamilton, active"
VELOCITY = "of the origin of the object's frame, world axes; at an event, the velocity after it"
AXES = {"blender": "z up, right-handed", "colmap": "y down, z forward, right-handed", "opengl": "y up, right-handed"}
KEEPS = "position, rotation, velocity, spin and confidence band of objects and parts at any times"
LOSES = "Gaussians, colours, bending of Gaussians, cameras"
LOST_BENDING = "{} Gaussians bend: a pose describes the rigid motion of their object"


@dataclass(frozen=True)
class Table:
    """Poses of objects at T times in the units of a file.

    Attributes:
        scene_times: Scene times. [T]
        times: The same in `time_unit`. [T]
        objects: The motion of each object.
        predicted: True past t_max. [T]
        header: Units and conventions, as JSON types.
    """

    scene_times: np.ndarray
    times: np.ndarray
    objects: list[ObjectPoses]
    predicted: np.ndarray
    header: dict[str, Any]


def make(scene: Scene, options: registry.Options) -> Table:
    """Table of the selected objects and times, in seconds and metres if the scene stores these units.

    Raises:
        ConfigError: The selection has no object with Gaussians or motion.
    """
    seconds, meters = scene.units.seconds_per_unit or 1.0, scene.units.meters_per_unit or 1.0
    found = object_poses.at(scene, options.times, options.object_ids)
    if not found:
        raise errors.ConfigError(f"{scene.name}: expected objects to export, found none in the selection")
    scaled = [
        dataclasses.replace(
            one,
            positions=meters * one.positions,
            velocities=meters / seconds * one.velocities,
            angular_velocities=one.angular_velocities / seconds,
            half_widths=meters * one.half_widths,
        )
        for one in found
    ]
    times = np.array(options.times)
    header = {
        "scene": scene.name,
        "mode": "rigid",
        "time_unit": "second" if scene.units.seconds_per_unit else "unit of scene time",
        "length_unit": "metre" if scene.units.meters_per_unit else "unit of the scene",
        **scene.units.to_json(),
        "t_max": seconds * scene.t_max,
        "world": f"{scene.world_convention} ({AXES[scene.world_convention]})",
        "origin": (meters * scene.origin).tolist(),
        "frame": FRAME,
        "quaternion": QUATERNION,
        "velocity": VELOCITY,
    }
    return Table(times, seconds * times, scaled, times > scene.t_max, header)


def losses(scene: Scene, options: registry.Options) -> list[str]:
    """Parts of this scene that poses do not hold, as sentences."""
    shown = scene_nodes.selected(scene, options.object_ids)
    bending = 0 if scene.residuals is None else int(shown[scene.residuals.rows].sum())
    return [LOST_BENDING.format(bending)] if bending else []
