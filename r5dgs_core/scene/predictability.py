"""Reliability of the predicted motion of each object: warnings, half widths of bands, errors of poses."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..motion import history
from .scene import MotionGroup, Scene


@dataclass(frozen=True)
class PoseError:
    """Standard deviation of the observed rotations or positions of an object, per component.

    Attributes:
        median: Median over the observed times that show the object.
        worst: Largest of them.
    """

    median: float
    worst: float


@dataclass(frozen=True)
class Outlook:
    """Reliability of an object's motion. An attribute is None if it is unknown.

    Attributes:
        warning: Reason to distrust the prediction up to `horizon`, such as "not predictable past 0.85 (hit at 0.55)",
            or "".
        half_width: Half width of the confidence band at `horizon`, world units.
        half_width_percent: The same, in % of the object's size.
        rotation_error_deg: Errors of the observed rotations, degrees.
        position_error_percent: Errors of the observed positions, in % of the object's size.
        unseen_times: Number of observed times at which no image shows the object.
    """

    warning: str | None = None
    half_width: float | None = None
    half_width_percent: float | None = None
    rotation_error_deg: PoseError | None = None
    position_error_percent: PoseError | None = None
    unseen_times: int | None = None

    @property
    def is_known(self) -> bool:
        """True if anything is known."""
        return self != UNKNOWN

    def prediction(self) -> dict[str, Any]:
        """Return warning and half widths in JSON types."""
        return {name: getattr(self, name) for name in ("warning", "half_width", "half_width_percent")}


UNKNOWN = Outlook()


def horizon(scene: Scene) -> float:
    """Return the scene time up to which Blender extrapolates by default.

    It is a third of the observed span after t_max, but at least scene time 1.
    """
    start = float(scene.tracks.times[0])
    return max(scene.t_max + (scene.t_max - start) / 3, 1.0)


def outlooks(scene: Scene) -> dict[int, Outlook]:
    """Return the reliability of the motion of each object by its id. Of an object with parts, the worst part counts."""
    bodies: dict[int, list[MotionGroup]] = {item.id: [] for item in scene.objects}
    for group in scene.groups:
        if group.role == "body" and group.object_id in bodies:
            bodies[group.object_id].append(group)
    end = horizon(scene)
    return {object_id: _outlook(groups, end) for object_id, groups in bodies.items()}


def warnings(scene: Scene) -> list[str]:
    """Return a line per object whose motion is not predictable up to `horizon`.

    For example, "ball: not predictable past 0.85 (hit at 0.55)".
    """
    found = outlooks(scene)
    return [f"{item.name}: {found[item.id].warning}" for item in scene.objects if found[item.id].warning]


def _outlook(groups: Sequence[MotionGroup], end: float) -> Outlook:
    result = UNKNOWN
    bands = [(group, band) for group in groups if (band := group.history.band) is not None]
    if bands:
        first = min(bands, key=lambda pair: math.inf if (t := pair[1].predictable_until) is None else t)
        widths = [float(band.widths(np.array([end]))[0]) for _, band in bands]
        shares = [width / _size(group) for (group, _), width in zip(bands, widths, strict=True)]
        worst = int(np.argmax(shares))
        result = Outlook(first[0].history.warning(end), widths[worst], 100 * shares[worst])
    errors = [(group, own) for group in groups if (own := group.history.errors) is not None]
    if errors:
        known = [(group, _with_bend(own, group)) for group, own in errors]
        turns = [error for _, (_, turn) in known if (error := _error(np.degrees(turn))) is not None]
        places = [error for group, (place, _) in known if (error := _error(100 * place / _size(group))) is not None]
        result = dataclasses.replace(
            result,
            rotation_error_deg=max(turns, key=lambda error: error.worst, default=None),
            position_error_percent=max(places, key=lambda error: error.worst, default=None),
            unseen_times=max(int(np.isinf(own.place).sum()) for _, own in errors),
        )
    return result


def _with_bend(errors: history.PoseErrors, group: MotionGroup) -> np.ndarray:
    """Errors of places and of rotations, with the deviations of the body from a rigid motion. [2, S]"""
    return history.with_bend(np.array([errors.place, errors.turn]), group.model.radius, group.rigid_rms)


def _size(group: MotionGroup) -> float:
    return max(2 * group.model.radius, np.finfo(float).tiny)


def _error(deviations: np.ndarray) -> PoseError | None:
    """Return the median and the largest of the finite deviations [S]; None if there are none."""
    seen = deviations[np.isfinite(deviations)]
    return PoseError(float(np.median(seen)), float(seen.max())) if len(seen) else None


def rotation_text(error: PoseError) -> str:
    """Return errors of rotations in words: "1.2°, worst 3.4°", or "unknown" if the images do not show them."""
    if error.median >= 0.999 * math.degrees(history.UNKNOWN_TURN):
        return "unknown"
    worst = "unknown" if error.worst >= 0.999 * math.degrees(history.UNKNOWN_TURN) else f"{error.worst:.2g}°"
    return f"{error.median:.2g}°, worst {worst}"


def position_text(error: PoseError) -> str:
    """Return errors of positions in words: "0.5 %, worst 1.2 %"."""
    return f"{error.median:.2g} %, worst {error.worst:.2g} %"
