"""JSON form of the events, segments, confidence band and pose errors of a motion group."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from .. import errors
from ..motion.history import EVENTS, MAX_KNOTS, Band, Event, History, PoseErrors, Segment
from ..motion.models import FIELDS, KINDS, SCALARS
from .json_row import Row

_RATES = ("velocity", "acceleration", "angular_velocity")


def to_json(history: History) -> dict[str, Any]:
    """Entries of a motion group; only those that are not empty."""
    found: dict[str, Any] = {}
    if history.events:
        found["events"] = [{"time": e.time, "kind": e.kind, "sigma": e.sigma} for e in history.events]
    if history.segments:
        found["segments"] = [
            {"from": s.start, "to": s.stop, "kind": s.kind, "parameters": _parameters(s)} for s in history.segments
        ]
    if history.band is not None:
        band = history.band
        found["band"] = {
            "times": list(band.times),
            "half_width": list(band.half_width),
            "half_angle": list(band.half_angle),
            "level": band.level,
            "predictable_until": band.predictable_until,
        }
    if history.errors is not None:
        columns = {"place": history.errors.place, "turn": history.errors.turn}
        found["errors"] = {name: [x if math.isfinite(x) else None for x in values] for name, values in columns.items()}
    return found


def _parameters(segment: Segment) -> dict[str, Any]:
    return {name: value[0] if name in SCALARS else list(value) for name, value in segment.parameters.items()}


def read(row: Row) -> History:
    """Inverse of `to_json`, from a motion group. Raises `SceneFileError` naming place and key."""
    return History(
        events=() if row.lacks("events") else row.each("events", _event),
        segments=() if row.lacks("segments") else row.each("segments", _segment),
        band=None if row.lacks("band") else _band(Row(row.get("band", dict), f"{row.place}: band", row.guard)),
        errors=None
        if row.lacks("errors")
        else _errors(Row(row.get("errors", dict), f"{row.place}: errors", row.guard)),
    )


def _event(row: Row) -> Event:
    return Event(row.get("time", float), _one_of(row, "kind", EVENTS), _at_least_zero(row, "sigma"))


def _segment(row: Row) -> Segment:
    rates = Row(row.get("parameters", dict), f"{row.place}: parameters", row.guard)
    return Segment(
        row.get("from", float),
        row.get("to", float),
        _one_of(row, "kind", tuple(KINDS)),
        {name: rates.floats(name, 3) for name in _RATES} | _further(rates),
    )


def _further(rates: Row) -> dict[str, Any]:
    """Optional parameters of a segment; those of later releases are ignored."""
    names = [name for name in FIELDS if name not in _RATES and not rates.lacks(name)]
    return {name: (_at_least_zero(rates, name),) if name in SCALARS else rates.floats(name, 3) for name in names}


def _band(row: Row) -> Band:
    times = row.get("times", list)
    shape = (len(times),)
    if not 1 <= len(times) <= MAX_KNOTS:
        raise errors.SceneFileError(f"{row.place}: times: expected 1 to {MAX_KNOTS} numbers, found {len(times)}")
    found = {name: row.numbers(name, shape) for name in ("times", "half_width", "half_angle")}
    if (np.diff(found["times"]) <= 0).any():
        raise errors.SceneFileError(f"{row.place}: times: expected increasing numbers, found {times!r:.60}")
    for name in ("half_width", "half_angle"):
        if (found[name] < 0).any():
            raise errors.SceneFileError(f"{row.place}: {name}: expected numbers >= 0, found {found[name].min():g}")
    until = None if row.lacks("predictable_until") else row.get("predictable_until", float)
    level = row.get("level", float)
    if not 0 < level < 1:
        raise errors.SceneFileError(f"{row.place}: level: expected a number between 0 and 1, found {level:g}")
    return Band(*(tuple(found[name].tolist()) for name in found), level=level, predictable_until=until)


def _errors(row: Row) -> PoseErrors:
    count = len(row.get("place", list))
    return PoseErrors(*(_deviations(row, name, count) for name in ("place", "turn")))


def _deviations(row: Row, key: str, count: int) -> tuple[float, ...]:
    """Numbers >= 0, infinite for null."""
    values = row.get(key, list)
    plain = Row({key: [0.0 if x is None else x for x in values]}, row.place, row.guard).numbers(key, (count,))
    if (plain < 0).any():
        raise errors.SceneFileError(f"{row.place}: {key}: expected numbers >= 0, found {plain.min():g}")
    return tuple(math.inf if x is None else float(y) for x, y in zip(values, plain, strict=True))


def _one_of(row: Row, key: str, names: tuple[str, ...]) -> str:
    value = row.get(key, str)
    if value not in names:
        raise errors.SceneFileError(f"{row.place}: {key}: expected one of {', '.join(names)}, found {value!r:.60}")
    return value


def _at_least_zero(row: Row, key: str) -> float:
    value = row.get(key, float)
    if not value >= 0:
        raise errors.SceneFileError(f"{row.place}: {key}: expected a number >= 0, found {value:g}")
    return value
