"""An estimate of the time that a command still takes, over all of its phases, which changes smoothly.

The work of a phase is its number of units (steps, images) times the expected cost of one, relative to the other
phases. Seconds per cost are measured in the phase that runs; phases to come take those of the phase with most work so
far. What is shown follows this raw estimate under a limit, so that one slow step or one slow phase does not make it
jump.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

SETTLED = 0.05  # share of the work before which the estimate may change by any amount
CHANGE = 0.2  # largest change between two reports after that, as a share of the estimate, beside SLACK_S
SLACK_S = 2.0
MEMORY = 0.03  # share of the work over which seconds per cost are averaged
OUTLIER = 4.0  # slower pieces of work count as this many times the rate known so far


@dataclass(frozen=True)
class Phase:
    """A phase of a command.

    Attributes:
        name: Name of its events.
        units: Number of its steps or images.
        cost: Expected cost of a unit, relative to a training step.
    """

    name: str
    units: float
    cost: float = 1.0


class TimeLeft:
    """The estimate.

    Args:
        phases: Phases of the command; `add` adds those that become known later.
        clock: Seconds of a clock that never goes back.
    """

    def __init__(self, *phases: Phase, clock: Callable[[], float] = time.monotonic):
        self._clock = clock
        self._phases: dict[str, Phase] = {}
        self._done: dict[str, float] = {}
        self._rates: dict[str, float] = {}  # seconds per cost
        self._measured: dict[str, float] = {}  # cost whose time was measured
        self._last: tuple[str, float] | None = None  # phase and time of the last report
        self._shown: tuple[float, float] | None = None  # seconds left, time
        self.add(*phases)

    def __contains__(self, name: str) -> bool:
        return name in self._phases

    def add(self, *phases: Phase) -> None:
        """Add phases, or replace those of the same names."""
        for phase in phases:
            self._phases[phase.name] = phase
            self._done[phase.name] = 0.0

    def finish(self, name: str) -> None:
        """Count a phase as done, whether it ran or was left out."""
        if name not in self._phases:
            return
        phase = self._phases[name]
        if self._shown is not None:
            omitted = (phase.units - self._done[name]) * phase.cost * self._rates.get(name, self._usual())
            self._shown = max(0.0, self._shown[0] - omitted), self._shown[1]
        self._done[name] = phase.units

    def at(self, name: str, done: float, units: float | None = None) -> float | None:
        """Return the seconds left when ``done`` of the units of a phase are done; None before anything was measured.

        A number of ``units`` replaces the planned one.
        """
        now, phase = self._clock(), self._phases[name]
        if units is not None and units != phase.units:
            phase = self._phases[name] = replace(phase, units=units)
        done = min(done, phase.units)
        fresh = done - self._done[name]
        # Between phases other work may have been done: that time counts only if nothing else is known of the phase.
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
        """Return the raw estimate, limited to a small change from the one shown before."""
        if self._shown is not None and self._work_done() >= SETTLED * self._total() and raw > 0:
            expected = max(0.0, self._shown[0] - (now - self._shown[1]))
            most = CHANGE * expected + SLACK_S
            raw = max(0.0, min(max(raw, expected - most), expected + most))
        self._shown = raw, now
        return raw

    def _usual(self) -> float:
        """Seconds per cost of the phase of which most was measured."""
        return self._rates[max(self._measured, key=self._measured.__getitem__)]

    def _total(self) -> float:
        return sum(phase.units * phase.cost for phase in self._phases.values())

    def _work_done(self) -> float:
        return sum(self._done[phase.name] * phase.cost for phase in self._phases.values())


class Timed:
    """A function for progress that adds ``seconds_left`` to counted events, over all phases of the command.

    Args:
        show: Function that shows an event.
        clock: As of `TimeLeft`.

    Attributes:
        estimate: The estimate; phases that are known beforehand are added to it. Others are added by their first event.
    """

    def __init__(self, show: Callable[[dict[str, Any]], None], clock: Callable[[], float] = time.monotonic):
        self.estimate = TimeLeft(clock=clock)
        self._show = show

    def __call__(self, event: dict[str, Any]) -> None:
        self._show(self.timed(event))

    def timed(self, event: dict[str, Any]) -> dict[str, Any]:
        """Return an event with the seconds that are left, if it is counted and they can be told."""
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
