"""Images with their own camera each, sorted into the cameras that took them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..calibration import CalibratedCamera, CalibratedFrame
from ..lens import Lens

_SAME_POSE = 1e-7  # rounding of the poses of one fixed camera, relative to the largest coordinate


@dataclass(frozen=True, eq=False)
class Shot:
    """An image that a calibration lists.

    Attributes:
        camera: Name of the camera, or "" if the files give none.
        path: The image file.
        time: Time in the unit of the calibration, or None.
        size: Width and height in pixels.
        lens: Lens, for this size.
        camera_to_world: Pose, OpenCV axes. [4, 4]
        split: "train", "val", "test" or "".
    """

    camera: str
    path: Path
    time: float | None
    size: tuple[int, int]
    lens: Lens
    camera_to_world: np.ndarray
    split: str = ""


def cameras(found: Sequence[Shot]) -> tuple[CalibratedCamera, ...]:
    """Sort images into cameras.

    Images of one name are one camera. Images without a name are sorted by folder. A folder is one moving camera, unless
    a pose or a time occurs twice in it: it then holds one fixed camera for each pose. Images of different sizes are
    different cameras.
    """
    named: dict[str, list[Shot]] = {}
    folders: dict[Path, list[Shot]] = {}
    for shot in found:
        if shot.camera:
            named.setdefault(shot.camera, []).append(shot)
        else:
            folders.setdefault(shot.path.parent, []).append(shot)
    for folder, shots in folders.items():
        groups = _fixed(shots)
        for index, group in enumerate(groups):
            name = folder.name or "camera"
            named[_unused(f"{name}_{index}" if len(groups) > 1 else name, named)] = group
    result = []
    for name, shots in named.items():
        by_size: dict[tuple[int, int], list[Shot]] = {}
        for shot in shots:
            by_size.setdefault(shot.size, []).append(shot)
        for size, group in by_size.items():
            label = name if len(by_size) == 1 else f"{name}_{size[0]}x{size[1]}"
            result.append(_camera(label, group))
    return tuple(result)


def _fixed(shots: list[Shot]) -> list[list[Shot]]:
    """Split the images of a folder into fixed cameras, or return all as one moving camera."""
    step = _SAME_POSE * max(1.0, max(float(np.abs(shot.camera_to_world).max()) for shot in shots))
    by_pose: dict[tuple[Lens, bytes], list[Shot]] = {}
    for shot in shots:
        pose = np.rint(shot.camera_to_world / step) + 0.0  # turns -0.0 into 0.0
        by_pose.setdefault((shot.lens, pose.tobytes()), []).append(shot)
    groups = list(by_pose.values())
    times = [shot.time for shot in shots if shot.time is not None]
    repeated = len(groups) < len(shots) or len(set(times)) < len(times)
    return groups if repeated else [shots]


def _unused(name: str, taken: Iterable[str]) -> str:
    while name in taken:
        name += "_"
    return name


def _camera(name: str, shots: list[Shot]) -> CalibratedCamera:
    frames = tuple(CalibratedFrame(s.path, s.time, s.lens, s.camera_to_world, s.split) for s in shots)
    first = shots[0]
    return CalibratedCamera(name, *first.size, first.lens, first.camera_to_world, frames)
