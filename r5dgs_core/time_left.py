"""Smooth estimate of the remaining time of a command, over all of its phases.

The work of a phase is its number of units (steps, images) times the expected cost of one, relative to the other
phases. Seconds per cost are measured in the running phase; future phases use those of the phase with the most measured
work. The shown value follows this raw estimate at a limited rate, so that one slow step or phase does not make it jump.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

SETTLED = 0.05  # share of the work before which the estimate may change without limit
CHANGE = 0.2  # maximum change between two reports, as a share of the estimate, in addition to SLACK_S
SLACK_S = 2.0  # maximum change between two reports, seconds, in addition to CHANGE
MEMORY = 0.03  # share of the work over which seconds per cost are averaged
OUTLIER = 4.0  # limit of the seconds per cost of one report, as a multiple of the average


@dataclass(frozen=True)
class Phase:
    """Phase of a command.

    Attributes:
        name: Name of its events.
        units: Number of its steps or images.
        cost: Expected cost of a unit, relative to a training step.
    """

    name: str
    units: float
    cost: float = 1.0


class TimeLeft:
    """Estimate of the remaining time.

    Args:
        phases: Phases of the command; later phases are added by `add`.
        clock: Monotonic clock, seconds.
    """

    def __init__(self, *phases: Phase, clock: Callable[[], float] = time.monotonic):
        self._clock = clock
        self._phases: dict[str, Phase] = {}
        self._done: dict[str, float] = {}
        self._rates: dict[str, float] = {}  # seconds per cost
        self._measured: dict[str, float] = {}  # cost of the measured work
        self._last: tuple[str, float] | None = None  # phase and time of the last report
        self._shown: tuple[float, float] | None = None  # last estimate in seconds, and its time
        self.add(*phases)

    def __contains__(self, name: str) -> bool:
        return name in self._phases

    def add(self, *phases: Phase) -> None:
        """Add phases, or replace those of the same names."""
        for phase in phases:
            self._phases[phase.name] = phase
            self._done[phase.name] = 0.0

    def finish(self, name: str) -> None:
        """Count a phase as finished, whether it ran or was skipped."""
        if name not in self._phases:
            return
        phase = self._phases[name]
        if self._shown is not None:
            omitted = (phase.units - self._done[name]) * phase.cost * self._rates.get(name, self._usual())
            self._shown = max(0.0, self._shown[0] - omitted), self._shown[1]
        self._done[name] = phase.units

    def at(self, name: str, done: float, units: float | None = None) -> float | None:
        """Return the seconds left after ``done`` units of a phase; None before the first measurement.

        ``units`` replaces the planned number of units.
        """
        now, phase = self._clock(), self._phases[name]
        if units is not None and units != phase.units:
            phase = self._phases[name] = replace(phase, units=units)
        done = min(done, phase.units)
        fresh = done - self._done[name]
        # Time since a report of another phase may include other work, so it counts only for a phase without a rate.
        if self._last is not None and fresh > 0 and (self._last[0] == name or name not in self._rates):
            self._measure(phase, fresh, now - self._last[1])
        self._last = (name, now)
        self._done[name] = done
        if not self._rates:
            return None
        usual = self._usual()
        raw = sum(
            (phase.units - self._done[phase.name]) * phase.cost * self._rates.get(phase.name, usual)
            for phase in self._phases.values()
        )
        return self._limited(raw, now)

    def _measure(self, phase: Phase, units: float, seconds: float) -> None:
        cost = units * phase.cost
        rate, before = seconds / cost, self._rates.get(phase.name)
        if before is None:
            self._rates[phase.name] = rate
        else:
            share = -math.expm1(-cost / (MEMORY * self._total()))
            self._rates[phase.name] = before + share * (min(rate, OUTLIER * before) - before)
        self._measured[phase.name] = self._measured.get(phase.name, 0.0) + cost

    def _limited(self, raw: float, now: float) -> float:
        """Return the raw estimate, with a limited change from the previous one."""
        if self._shown is not None and self._work_done() >= SETTLED * self._total() and raw > 0:
            expected = max(0.0, self._shown[0] - (now - self._shown[1]))
            most = CHANGE * expected + SLACK_S
            raw = max(0.0, min(max(raw, expected - most), expected + most))
        self._shown = raw, now
        return raw

    def _usual(self) -> float:
        """Return the seconds per cost of the phase with the most measured work."""
        return self._rates[max(self._measured, key=self._measured.__getitem__)]

    def _total(self) -> float:
        return sum(phase.units * phase.cost for phase in self._phases.values())

    def _work_done(self) -> float:
        return sum(self._done[phase.name] * phase.cost for phase in self._phases.values())


class TimedProgress:
    """Progress function that adds ``seconds_left`` to counted events, over all phases of the command.

    Args:
        show: Function that shows an event.
        clock: Clock of `TimeLeft`.

    Attributes:
        estimate: The estimate. Phases known in advance are added to it; others are added by their first event.
    """

    def __init__(self, show: Callable[[dict[str, Any]], None], clock: Callable[[], float] = time.monotonic):
        self.estimate = TimeLeft(clock=clock)
        self._show = show

    def __call__(self, event: dict[str, Any]) -> None:
        self._show(self.timed(event))

    def timed(self, event: dict[str, Any]) -> dict[str, Any]:
        """Return an event with the remaining seconds, if it is counted and they are known."""
        name, done = event["event"], event.get("iteration", event.get("done"))
        total = event.get("iterations", event.get("total"))
        if done is None or "seconds_left" in event:
            return event
        if name not in self.estimate:
            if total is None:
                return event
            self.estimate.add(Phase(name, total))
        left = self.estimate.at(name, done, total)
        return event if left is None else {**event, "seconds_left": left}
