"""Observed events of a body and the confidence in its prediction, in times and units of the scene."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from .models import VECTORS

EVENTS = ("start", "stop", "impact", "change")
MAX_KNOTS = 16
UNKNOWN_TURN = 1.0  # standard deviation of a rotation that the images do not determine, rad
_EVENT_VERBS = {"start": "set off", "stop": "stopped", "impact": "hit", "change": "changed"}


@dataclass(frozen=True)
class Event:
    """A change of the motion in the observed window.

    Attributes:
        time: Scene time.
        kind: One of `EVENTS`.
        sigma: Standard deviation of the time, >= 0.
    """

    time: float
    kind: str
    sigma: float

    def text(self) -> str:
        """Event in words, such as "hit at 0.55"."""
        return f"{_EVENT_VERBS[self.kind]} at {self.time:.2f}"


@dataclass(frozen=True)
class Segment:
    """Motion between two events.

    Attributes:
        start, stop: Scene times.
        kind: Kind of the motion, "static" for rest.
        parameters: "velocity", "acceleration" and "angular_velocity" at its end, world frame, and those of the further
            fields of `MotionModel` that are known and not zero: constants such as "damping" [1], and in the last
            segment all fields of its kind, at t_max. [3] or [1] each
    """

    start: float
    stop: float
    kind: str
    parameters: Mapping[str, tuple[float, ...]]

    def transformed(self, turn: np.ndarray, scale: float) -> Segment:
        """Segment after a similarity of the world, see `MotionModel.transformed`."""
        found = {
            name: tuple(((scale if VECTORS[name].is_length else 1.0) * turn @ np.array(value)).tolist())
            if name in VECTORS
            else value
            for name, value in self.parameters.items()
        }
        return replace(self, parameters=found)


@dataclass(frozen=True)
class Band:
    """Confidence band of the motion past t_max, at most `MAX_KNOTS` knots; linear in between and after the last one.

    Attributes:
        times: Scene times, increasing, the first is t_max. [H]
        half_width: Half width of the position of a point of the body, world units. [H]
        half_angle: Half width of the rotation, rad. [H]
        level: Probability that the truth lies inside.
        predictable_until: Scene time after which the motion is not predictable; None if it is up to the last one.
    """

    times: tuple[float, ...]
    half_width: tuple[float, ...]
    half_angle: tuple[float, ...]
    level: float = 0.95
    predictable_until: float | None = None

    def widths(self, times: np.ndarray) -> np.ndarray:
        """Half widths of the position at scene times; after the last knot they grow with the last slope. [H]"""
        return self._at(times, self.half_width)

    def angles(self, times: np.ndarray) -> np.ndarray:
        """Half widths of the rotation at scene times, at most pi; likewise. [H]"""
        return np.minimum(self._at(times, self.half_angle), math.pi)

    def _at(self, times: np.ndarray, values: tuple[float, ...]) -> np.ndarray:
        inside = np.interp(times, self.times, values)
        if len(values) < 2:
            return inside
        slope = (values[-1] - values[-2]) / (self.times[-1] - self.times[-2])
        return inside + max(slope, 0.0) * np.maximum(np.asarray(times) - self.times[-1], 0.0)


@dataclass(frozen=True)
class PoseErrors:
    """Standard deviations of the observed poses, per component; infinite at knots at which no image shows the body.

    Attributes:
        place: Of the displacements, world units. [S]
        turn: Of the rotations, rad; `UNKNOWN_TURN` if the images do not determine them. [S]
    """

    place: tuple[float, ...]
    turn: tuple[float, ...]


def with_bend(errors: np.ndarray, radius: float, bend: float) -> np.ndarray:
    """Return errors of displacements and of rotations of a body that also bends, so that it has no exact pose.

    Args:
        errors: Standard deviations per component, world units and rad. [2, ...]
        radius: Radius of the body, world units.
        bend: Root mean square distance of its points from a rigid motion, world units.
    """
    each = bend / math.sqrt(3)
    return np.stack([np.hypot(errors[0], each), np.hypot(errors[1], each / radius if radius > 0 else 0.0)])


@dataclass(frozen=True)
class History:
    """Events, segments, confidence band and pose errors of a motion, from its observed poses.

    Attributes:
        events: Changes of the motion, in order.
        segments: Motion between them, one more than events; empty without events.
        band: Confidence band, or None if it is unknown.
        errors: Errors of the observed poses, or None if they are unknown.
    """

    events: tuple[Event, ...] = field(default=())
    segments: tuple[Segment, ...] = field(default=())
    band: Band | None = None
    errors: PoseErrors | None = None

    def transformed(self, turn: np.ndarray, scale: float) -> History:
        """History after a similarity of the world, see `MotionModel.transformed`."""
        band, errors = self.band, self.errors
        if errors is not None:
            errors = replace(errors, place=tuple(abs(scale) * x for x in errors.place))
        if band is not None:
            band = replace(band, half_width=tuple(abs(scale) * width for width in band.half_width))
        segments = tuple(s.transformed(turn, scale) for s in self.segments)
        return replace(self, segments=segments, band=band, errors=errors)

    def warning(self, end: float = math.inf) -> str:
        """Reason to distrust the prediction, such as "not predictable past 0.85 (hit at 0.55)".

        Returns "" if the motion is predictable up to the scene time ``end``.
        """
        if self.band is None or self.band.predictable_until is None or self.band.predictable_until >= end:
            return ""
        last = f" ({self.events[-1].text()})" if self.events else ""
        return f"not predictable past {self.band.predictable_until:.2f}{last}"

    def text(self, end: float = math.inf) -> str:
        """Events and warning, if there is one before the scene time ``end``, in words; or ""."""
        warning = self.warning(end)
        words = [event.text() for event in (self.events[:-1] if warning else self.events)]
        return ", ".join([*words, *([warning] if warning else [])])


EMPTY = History()
