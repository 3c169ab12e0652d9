"""Rig of a data set: the poses and the lenses that its views share.

A fixed camera has one pose for all of its views, a moving one a pose per view or per stop. Notation: V views, R poses,
C lenses (cameras).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...data.views import View
from ...scene.cameras import Camera
from ..train_views import TrainView


@dataclass(frozen=True)
class Rig:
    """Poses and lenses of the training views.

    Attributes:
        pose_of: Pose of each view. [V] int
        lens_of: Lens of each view. [V] int
        cameras: Given camera of each pose, normalised coordinates.
        lens_of_pose: Lens of each pose. [R] int
        names: Name of each pose, as in the data set.
        lens_names: Name of each lens.
        paths: Poses of each moving camera in the order of their times.
    """

    pose_of: np.ndarray
    lens_of: np.ndarray
    cameras: tuple[Camera, ...]
    lens_of_pose: np.ndarray
    names: tuple[str, ...]
    lens_names: tuple[str, ...]
    paths: tuple[np.ndarray, ...]

    @property
    def poses(self) -> int:
        """Number of poses."""
        return len(self.cameras)

    @property
    def lenses(self) -> int:
        """Number of lenses."""
        return len(self.lens_names)


def of(views: Sequence[TrainView] | Sequence[View]) -> Rig:
    """Return the rig of the training views.

    Cameras of a data set have the same name if they have the same pose; the poses of a moving camera are called NAME,
    NAME@1, ... Views without camera names, with different poses and one lens, count as one moving camera.
    """
    names = list(dict.fromkeys(view.camera.name for view in views))
    place = {name: row for row, name in enumerate(names)}
    pose_of = np.array([place[view.camera.name] for view in views])
    first = [int(np.argmax(pose_of == row)) for row in range(len(names))]
    cameras = tuple(views[index].camera for index in first)
    given = [_camera_name(name) for name in names]
    one_lens = len({(camera.intrinsics.tobytes(), camera.width, camera.height) for camera in cameras}) == 1
    if one_lens and len(names) == len(views) and all(name == f"cam{row}" for row, name in enumerate(names)):
        given = ["camera"] * len(names)
    lens_names = tuple(dict.fromkeys(given))
    lens_of_pose = np.array([lens_names.index(name) for name in given])
    times = np.array([views[index].t for index in first])
    paths = []
    for lens in range(len(lens_names)):
        rows = np.flatnonzero(lens_of_pose == lens)
        if len(rows) > 2 and np.ptp(times[rows]) > 0:
            paths.append(rows[np.argsort(times[rows], kind="stable")])
    return Rig(pose_of, lens_of_pose[pose_of], cameras, lens_of_pose, tuple(names), lens_names, tuple(paths))


def _camera_name(name: str) -> str:
    """Return the name of a pose's camera: that of NAME@3 is NAME; a user's name may have an @, too."""
    base, mark, number = name.rpartition("@")
    return base if mark and number.isdigit() else name
