"""A fitted candidate as a motion model in world units, with its covariance and events.

Notation: P parameters, S poses.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..motion import models, rotations
from ..motion.history import Event, Segment
from .candidates import Candidate, FittedCandidate

_FADE_PER_SPAN = 0.1 / 0.75
_SLIPPED = 0.1  # factor on this time if the last observed rotation is known to be wrong
_SEGMENT_RATES = ("velocity", "acceleration", "angular_velocity")
_RATES = ("velocity", "acceleration", "angular_velocity", "angular_acceleration")


def fade_time(solution: FittedCandidate) -> float:
    """Time constant, in spans, with which the body leaves the last observed pose for the fitted curve."""
    return _FADE_PER_SPAN * (_SLIPPED if solution.candidate.slip(solution.theta).any() else 1.0)


def to_model(solution: FittedCandidate, variance: float, radius: float, span: float) -> models.MotionModel:
    """Motion model in world units and units of time; ``variance`` is the factor of the parameters' covariance."""
    law, theta = solution.candidate.law, solution.law_theta
    fields = _fields(law, theta, radius, span)
    step = 1e-6
    moved = _fields(law, theta + step * np.eye(len(theta)), radius, span)
    names = (*_RATES, *(name for name in fields if name not in _RATES and _varies(name, moved)))
    slopes = np.concatenate([(moved[name] - fields[name]) / step for name in names], axis=-1).T
    inertia = None
    if law.inertia is not None and models.KINDS[law.kind].needs_inertia:
        turn = rotations.quats_to_rotmats(rotations.rotvecs_to_quats(fields["offset_rotvec"]))
        inertia = turn @ law.inertia @ turn.T
    slopes = slopes @ solution.law_slopes
    spread = variance * slopes @ solution.inverse @ slopes.T
    values: dict[str, Any] = {
        name: float(value[0]) if name in models.SCALARS else value for name, value in fields.items()
    }
    labels = [[name] if name in models.SCALARS else [f"{name}.{axis}" for axis in "xyz"] for name in names]
    return models.MotionModel(
        kind=law.kind,
        **values,
        inertia=inertia,
        fade_time=fade_time(solution) * span,
        radius=radius,
        covariance=0.5 * (spread + spread.T),
        covariance_names=tuple(name for group in labels for name in group),
    )


def _varies(name: str, moved: dict[str, np.ndarray]) -> bool:
    """True for a free rate that only some kinds have."""
    return name not in models.RATES and not name.startswith("offset_") and bool(np.ptp(moved[name], axis=0).any())


def _fields(law: Candidate, theta: np.ndarray, radius: float, span: float) -> dict[str, np.ndarray]:
    """Fields of the model in world units and units of time. [..., P] -> [..., 3] or [..., 1] each"""
    rates, parts = law.rates(theta), law.parts(theta)
    found = {"offset_rotvec": parts["r"], "offset_displacement": parts["e"] * radius}
    for (name, unit), value in zip(models.FIELDS.items(), rates, strict=True):
        length = radius if unit.is_length else 1.0
        scale = length / span**unit.per_time if unit.size == 3 else span**-unit.per_time
        found[name] = np.broadcast_to(value * scale, (*theta.shape[:-1], unit.size))
    return found


def events(solution: FittedCandidate, variance: float, t_max: float, span: float) -> tuple[Event, ...]:
    """Events of a solution in the observed window, in order; only the first of several between two poses."""
    gap = -solution.candidate.window.first / len(solution.weights)
    found: list[tuple[str, np.ndarray]] = []
    rows: list[int] = []
    for row, (kind, time) in enumerate(solution.candidate.events(solution.theta)):
        if not found or float(time[0]) - float(found[-1][1][0]) > gap:
            found.append((kind, time))
            rows.append(row)
    step = 1e-6
    slopes = np.zeros((len(found), len(solution.theta)))
    for k, direction in enumerate(np.eye(len(solution.theta))):
        moved = solution.candidate.events(solution.theta + step * direction)
        for i, row in enumerate(rows):
            if row < len(moved):
                slopes[i, k] = (float(moved[row][1][0]) - float(found[i][1][0])) / step
    variances = variance * np.einsum("ip,pq,iq->i", slopes, solution.inverse, slopes)
    return tuple(
        Event(t_max + span * float(time[0]), kind, span * float(np.sqrt(max(square, 0.0))))
        for (kind, time), square in zip(found, variances, strict=True)
    )


def segments(
    solutions: Sequence[FittedCandidate],
    found: tuple[Event, ...],
    first: float,
    t_max: float,
    radius: float,
    span: float,
) -> tuple[Segment, ...]:
    """Segments between events, from the first pose to t_max; empty without events.

    Args:
        solutions: FittedCandidate of each segment.
        found: Events.
        first: Time of the first pose.
    """
    if not found:
        return ()
    bounds = [first, *(event.time for event in found), t_max]
    result = []
    for solution, start, stop in zip(solutions, bounds[:-1], bounds[1:], strict=True):
        h = 0.02 * max(stop - start, 1e-9 * span)
        tau = (stop - t_max - h * np.array([2.1, 1.1, 0.1])) / span
        quats, d = solution.candidate.path(solution.theta, tau)
        d = d * radius
        turn = rotations.quats_to_rotvecs(rotations.multiply(quats[2], rotations.conjugate(quats[1])))
        rates = {
            "velocity": (1.5 * d[2] - 2 * d[1] + 0.5 * d[0]) / h,
            "acceleration": (d[2] - 2 * d[1] + d[0]) / h**2,
            "angular_velocity": turn / h,
        }
        sizes = np.linalg.norm(rates["velocity"]) + radius * np.linalg.norm(rates["angular_velocity"])
        rests = sizes * span < 1e-6 * radius
        kind = "static" if rests else solution.candidate.law.kind
        if not rests and kind == "static":  # a body that stopped
            kind = "ballistic_spin"
        if not rests:
            rates |= _parameters(solution, radius, span, last=stop == t_max)
        result.append(Segment(start, stop, kind, {name: tuple(value.tolist()) for name, value in rates.items()}))
    return tuple(result)


def _parameters(solution: FittedCandidate, radius: float, span: float, last: bool) -> dict[str, np.ndarray]:
    """Parameters of a segment beside the common rates: constants of its law, in the last also fields of its kind."""
    law = solution.candidate.law
    if not last and law is not solution.candidate:  # the law holds after the break alone
        return {}
    fields = _fields(law, solution.law_theta, radius, span)
    names = [*models.KINDS[law.kind].fields, "center_offset"] if last else []
    names += [name for name, unit in models.SCALARS.items() if unit.per_time >= 0]  # constants, unlike times
    return {name: fields[name] for name in names if name not in _SEGMENT_RATES and fields[name].any()}
