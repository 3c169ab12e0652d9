"""Dataclasses of a calibration: cameras, their lenses, poses and, if the files list them, their images."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ... import errors
from .lens import Lens

ASPECT_TOLERANCE = 0.01  # relative difference of the aspect ratios of a calibration and of its images


@dataclass(frozen=True, eq=False)
class CalibratedFrame:
    """An image that a calibration lists.

    Attributes:
        path: The image file.
        time: Time in the unit of `Calibration.seconds_per_time`, or None if the files give none.
        lens: Lens of this image, for an image of the camera's size.
        camera_to_world: Pose of this image, OpenCV axes. [4, 4]
        split: "train", "val" or "test" if the files assign one, else "".
    """

    path: Path
    time: float | None
    lens: Lens
    camera_to_world: np.ndarray
    split: str = ""


@dataclass(frozen=True, eq=False)
class CalibratedCamera:
    """A camera.

    Attributes:
        name: Name in the files, unique in the calibration.
        width: Width of its images in pixels, 0 if the files do not give it.
        height: Height of its images in pixels, 0 if the files do not give it.
        lens: Its lens, for images of this size; that of the first frame if the lens changes.
        camera_to_world: Camera to world, OpenCV axes (x right, y down, z forward), float64; that of the first frame if
            the camera moves. [4, 4]
        frames: Its images, if the files list them, in the order of the files.
    """

    name: str
    width: int
    height: int
    lens: Lens
    camera_to_world: np.ndarray
    frames: tuple[CalibratedFrame, ...] = ()

    @property
    def T_cam_world(self) -> np.ndarray:
        """World to camera. [4, 4]"""
        return np.linalg.inv(self.camera_to_world)

    @property
    def moves(self) -> bool:
        """True if the pose differs between frames."""
        return any(not np.array_equal(frame.camera_to_world, self.camera_to_world) for frame in self.frames)

    @property
    def changes(self) -> bool:
        """True if the pose or the lens differs between frames."""
        return self.moves or any(frame.lens != self.lens for frame in self.frames)

    def resized(self, width: int, height: int) -> CalibratedCamera:
        """Return the camera for images of another size.

        Raises:
            DatasetError: The images have another aspect ratio than the calibration.
        """
        if not self.width or (width, height) == (self.width, self.height):
            return dataclasses.replace(self, width=width, height=height)
        x, y = width / self.width, height / self.height
        if abs(x / y - 1) > ASPECT_TOLERANCE:
            turned = abs((width / self.height) / (height / self.width) - 1) <= ASPECT_TOLERANCE
            remedy = "the images are turned; turn them back" if turned else "use uncropped images"
            raise errors.DatasetError(
                f"camera {self.name!r}: expected images of the calibration's aspect ratio, {self.width}x{self.height}, "
                f"found {width}x{height}; {remedy}, or calibrate at this size"
            )
        frames = tuple(dataclasses.replace(frame, lens=frame.lens.scaled(x, y)) for frame in self.frames)
        return dataclasses.replace(self, width=width, height=height, lens=self.lens.scaled(x, y), frames=frames)


@dataclass(frozen=True, eq=False)
class Calibration:
    """A calibration.

    Attributes:
        cameras: Its cameras, in the order of the files; at least one.
        meters_per_unit: Length of a unit of the world, or None if unknown.
        format: Name of the format: the key of `formats.registry`.
        path: The file or folder that was read.
        world_convention: Axes of the world: "blender" (z up), "colmap" (y down) or "opengl" (y up).
        seconds_per_time: Unit of the frames' times in seconds, or None if unknown.
        points: Points of a reconstruction, world. [P, 3] float64 or None
        colors: Their colours, sRGB in [0, 1]. [P, 3] float32 or None
    """

    cameras: tuple[CalibratedCamera, ...]
    meters_per_unit: float | None
    format: str
    path: Path
    world_convention: str = "colmap"
    seconds_per_time: float | None = None
    points: np.ndarray | None = None
    colors: np.ndarray | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the cameras."""
        return tuple(camera.name for camera in self.cameras)

    def moved(self, rotation: np.ndarray, shift: np.ndarray, scale: float) -> Calibration:
        """Return the calibration in another world: p' = scale rotation p + shift.

        Args:
            rotation: Rotation from the old world to the new one. [3, 3]
            shift: Position of the old origin. [3]
            scale: New units per old unit.
        """

        def pose(camera_to_world: np.ndarray) -> np.ndarray:
            result = np.eye(4)
            result[:3, :3] = rotation @ camera_to_world[:3, :3]
            result[:3, 3] = scale * rotation @ camera_to_world[:3, 3] + shift
            return result

        cameras = tuple(
            dataclasses.replace(
                camera,
                camera_to_world=pose(camera.camera_to_world),
                frames=tuple(
                    dataclasses.replace(frame, camera_to_world=pose(frame.camera_to_world)) for frame in camera.frames
                ),
            )
            for camera in self.cameras
        )
        return dataclasses.replace(
            self,
            cameras=cameras,
            meters_per_unit=None if self.meters_per_unit is None else self.meters_per_unit / scale,
            points=None if self.points is None else scale * self.points @ rotation.T + shift,
        )
