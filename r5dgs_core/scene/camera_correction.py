"""Corrections of a calibrated camera: pose, focal length, clock and colours.

A corrected camera maps a world point x to R(T x) + s with the given ``T_cam_world`` T, a small rotation R and a shift s
in the camera's axes. Its picture at time t shows the scene at t + time, in the colours gain c + offset.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..motion import rotations
from .cameras import Camera

COUNT = 20  # parameters of `Correction.plus`
POSE, FOCAL, TIME, COLOR = slice(0, 6), slice(6, 7), slice(7, 8), slice(8, 20)


@dataclass(frozen=True)
class Correction:
    """Correction of one camera; the default is none.

    Attributes:
        rotvec: Rotation in the camera's axes, rad. [3]
        shift: Shift in the camera's axes, in the unit of the camera's position. [3]
        log_focal: Logarithm of the factor on the focal lengths.
        time: Scene time that its clock is late.
        gain: Linear map from the scene's colours to those of its images. [3, 3]
        offset: Constant part of that map. [3]
    """

    rotvec: np.ndarray = field(default_factory=lambda: np.zeros(3))
    shift: np.ndarray = field(default_factory=lambda: np.zeros(3))
    log_focal: float = 0.0
    time: float = 0.0
    gain: np.ndarray = field(default_factory=lambda: np.eye(3))
    offset: np.ndarray = field(default_factory=lambda: np.zeros(3))

    def camera(self, camera: Camera) -> Camera:
        """Return the corrected camera."""
        change = np.eye(4)
        change[:3, :3] = rotations.quats_to_rotmats(rotations.rotvecs_to_quats(np.asarray(self.rotvec, np.float64)))
        change[:3, 3] = self.shift
        intrinsics = camera.intrinsics.copy()
        intrinsics[:2, :2] *= np.exp(self.log_focal)
        return dataclasses.replace(camera, intrinsics=intrinsics, T_cam_world=change @ camera.T_cam_world)

    @property
    def changes_colors(self) -> bool:
        """True if the colours are corrected."""
        return bool((self.gain != np.eye(3)).any() or (self.offset != 0).any())

    def seen(self, image: np.ndarray) -> np.ndarray:
        """Return the image that the camera takes of the scene's colours. [..., 3]"""
        if not self.changes_colors:
            return image
        return image @ self.gain.T.astype(image.dtype) + self.offset.astype(image.dtype)

    def unseen(self, image: np.ndarray) -> np.ndarray:
        """Return the scene's colours of an image that the camera has taken, the inverse of `seen`. [..., 3]"""
        if not self.changes_colors:
            return image
        inverse = np.linalg.inv(self.gain).T
        return (image - self.offset.astype(image.dtype)) @ inverse.astype(image.dtype)

    def plus(self, change: np.ndarray) -> Correction:
        """Return the correction changed by a vector of `COUNT` numbers, in the order of the attributes."""
        return Correction(
            self.rotvec + change[:3],
            self.shift + change[3:6],
            self.log_focal + float(change[6]),
            self.time + float(change[7]),
            self.gain + change[8:17].reshape(3, 3),
            self.offset + change[17:20],
        )

    def scaled(self, factor: float) -> Correction:
        """Return the correction for positions in another unit, of which there are ``factor`` in the present one."""
        return dataclasses.replace(self, shift=self.shift * factor)

    def to_dict(self) -> dict[str, Any]:
        """Return the attributes as JSON types."""
        return {
            "rotvec": np.asarray(self.rotvec).tolist(),
            "shift": np.asarray(self.shift).tolist(),
            "log_focal": float(self.log_focal),
            "time": float(self.time),
            "gain": np.asarray(self.gain).tolist(),
            "offset": np.asarray(self.offset).tolist(),
        }


def from_dict(values: dict[str, Any]) -> Correction:
    """Inverse of `Correction.to_dict`."""
    arrays = {name: np.asarray(values[name], np.float64) for name in ("rotvec", "shift", "gain", "offset")}
    return Correction(log_focal=float(values["log_focal"]), time=float(values["time"]), **arrays)


def sizes(record: Mapping[str, Any]) -> dict[str, str]:
    """Return the size of each refined part of a scene's cameras in words.

    Args:
        record: Entry "cameras" of a scene's provenance.
    """
    parts = record.get("refined", ())
    found = [from_dict(values) for values in record.get("corrections", {}).values()]
    if not found:
        return {}
    pixels = np.array(list(record["pixels"].values()))
    zoom = 100 * np.abs(np.expm1([c.log_focal for c in found]))
    times = np.abs([c.time for c in found])
    seconds = record.get("seconds_per_unit")
    unit, times = ("ms", 1000 * seconds * times) if seconds else ("units of scene time", times)
    gains = np.abs(np.array([c.gain for c in found]) - np.eye(3)).max((1, 2))
    offsets = np.abs(np.array([c.offset for c in found])).max(1)
    text = {
        "camera_poses": f"pictures moved by {_spread(pixels)} px",
        "focal_lengths": f"focal lengths changed by {_spread(zoom)} %",
        "time_offsets": f"clocks moved by {_spread(times)} {unit}",
        "camera_colours": f"gains changed by {_spread(100 * gains)} %, offsets by {_spread(255 * offsets)} of 255",
    }
    return {part: words for part, words in text.items() if part in parts}


def _spread(values: np.ndarray) -> str:
    return f"{np.median(values):.2g} (at most {values.max():.2g})"
