"""Conversion between scene time and Blender frames: frame = frame_zero + t * frames_per_unit."""

import math
from dataclasses import dataclass

import bpy

from ...r5dgs_core import errors
from ...r5dgs_core.scene import predictability
from ...r5dgs_core.scene.scene import Scene

MARKER = "t_max"
LAST_FRAME = 1_048_574  # Blender's last frame
LONGEST = 20.0  # limit of extrapolation past t_max, in observed spans; farther keys take minutes and are meaningless


@dataclass(frozen=True)
class Times:
    """Times of a loaded scene and their frames.

    Attributes:
        t_start: First observed time.
        t_max: Last observed time.
        t_end: End of the extrapolated keys.
        frames_per_unit: Frames per unit of scene time.
        frame_zero: Frame of scene time 0.
    """

    t_start: float
    t_max: float
    t_end: float
    frames_per_unit: float
    frame_zero: float

    @staticmethod
    def of(scene: Scene, frame_zero: float = 1.0, t_end: float | None = None) -> "Times":
        """Times of a scene; an end before t_max is clamped to t_max."""
        start = float(scene.tracks.times[0])
        end = predictability.horizon(scene) if t_end is None else max(float(t_end), scene.t_max)
        return Times(start, float(scene.t_max), end, float(scene.frames_per_unit), float(frame_zero))

    def frame(self, t: float) -> float:
        """Frame of a scene time, including its fraction."""
        return self.frame_zero + t * self.frames_per_unit

    def time(self, frame: float) -> float:
        """Scene time of a frame; inverse of `frame`."""
        return (frame - self.frame_zero) / self.frames_per_unit


def of_collection(collection: bpy.types.Collection) -> Times:
    """Times of a loaded scene, from its properties."""
    state = collection.r5dgs
    return Times(state.t_start, state.t_max, state.t_end, state.frames_per_unit, state.frame_zero)


def check_end(name: str, times: Times) -> None:
    """Check that extrapolation does not end too late or past Blender's last frame.

    Args:
        name: Name of the scene for the error message.
        times: Times of the scene, with the requested end.

    Raises:
        ConfigError: The end is NaN or too late, or a frame is past Blender's last one.
    """
    longest = max(times.t_max + LONGEST * max(times.t_max - times.t_start, 1 / times.frames_per_unit), 1.0)
    if not times.t_end <= longest:
        raise errors.ConfigError(
            f"{name}: expected an end of at most {longest:.4g}, {LONGEST:g} observed spans after t_max, found "
            f"{times.t_end:.4g}; choose an earlier end"
        )
    for what, t, remedy in (
        ("observed times", max(times.t_start, times.t_max, key=abs), "train with fewer frames per unit of time"),
        ("extrapolated times", times.t_end, "choose an earlier end"),
    ):
        if abs(times.frame(t)) > LAST_FRAME:
            raise errors.ConfigError(
                f"{name}: {what}: expected frames up to {LAST_FRAME:,}, Blender's last, found {times.frame(t):.4g}; "
                f"{remedy}"
            )


def fit(scene: bpy.types.Scene, times: Times) -> None:
    """Set a Blender scene's frame range to the scene's times, and add a marker at t_max."""
    scene.frame_start = _start(times)
    fit_end(scene, times)
    if not _is_marked(scene, times):
        scene.timeline_markers.new(MARKER, frame=round(times.frame(times.t_max)))


def fits(scene: bpy.types.Scene, times: Times) -> bool:
    """True if `fit` would change nothing."""
    return (scene.frame_start, scene.frame_end) == (_start(times), _end(scene, times)) and _is_marked(scene, times)


def _is_marked(scene: bpy.types.Scene, times: Times) -> bool:
    frame = round(times.frame(times.t_max))
    return any(marker.name == MARKER and marker.frame == frame for marker in scene.timeline_markers)


def _start(times: Times) -> int:
    return max(math.floor(times.frame(times.t_start) + 1e-6), 0)


def _end(scene: bpy.types.Scene, times: Times) -> int:
    return max(math.ceil(times.frame(times.t_end) - 1e-4), scene.frame_start)


def fit_end(scene: bpy.types.Scene, times: Times) -> None:
    """Set the last frame of a Blender scene to the last frame with keys."""
    scene.frame_end = _end(scene, times)
