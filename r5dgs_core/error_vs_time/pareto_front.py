"""The Pareto front of error against time; differences within the noise do not count.

A line is a row of the report in each run of a scene, by the number of the run. Lines are compared run by run, so that
effects common to the lines of a run, such as an easy seed, do not count as noise.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Mapping
from typing import TypeVar

from .report_rows import Row

Line = Mapping[int, Row]
Key = TypeVar("Key", bound=Hashable)


def front(lines: Mapping[Key, Line]) -> set[Key]:
    """Return the keys of the lines on the Pareto front.

    First, a line is removed if another one is better and not slower. Then, from fast to slow, a line is kept if it is
    better than every line kept so far. Both "better" and "faster" mean by more than the noise (`is_better`,
    `is_faster`).

    Args:
        lines: Lines of one task and kind of error; lines without times or errors are never on the front.
    """
    timed = {key: line for key, line in lines.items() if line and all(_complete(row) for row in line.values())}
    candidates = [
        key
        for key, line in timed.items()
        if not any(is_better(other, line) and not is_faster(line, other) for other in timed.values())
    ]
    kept: list[Key] = []
    for key in sorted(candidates, key=lambda key: (mean_ms(timed[key]), _badness(timed[key]))):
        if all(is_better(timed[key], timed[other]) for other in kept):
            kept.append(key)
    return set(kept)


def _complete(row: Row) -> bool:
    return math.isfinite(row.ms) and math.isfinite(row.error)


def mean_ms(line: Line) -> float:
    """Return the mean time of a line over its runs, milliseconds."""
    return sum(row.ms for row in line.values()) / len(line)


def _badness(line: Line) -> float:
    return sum(-row.error if row.kind.more_is_better else row.error for row in line.values()) / len(line)


def losses(one: Line, other: Line) -> list[float]:
    """Return the excess error of a line over another one in each run that has both; negative if it is better."""
    sign = [-1 if row.kind.more_is_better else 1 for row in one.values()][:1] or [1]
    return [sign[0] * (one[run].error - other[run].error) for run in sorted(one.keys() & other.keys())]


def is_better(one: Line, other: Line) -> bool:
    """Return True if the mean difference of the errors exceeds the noise.

    The noise is the range of the difference over the runs. Differences below `Kind.min_difference` and
    `Kind.min_relative_difference` never count; with a single run, they are the only estimate of the noise.
    """
    found = losses(other, one)
    if not found:
        return False
    kind = next(iter(one.values())).kind
    size = max(abs(row.error) for line in (one, other) for row in line.values())
    noise = max(max(found) - min(found), kind.min_difference, kind.min_relative_difference * size)
    return sum(found) / len(found) > noise


def is_faster(one: Line, other: Line) -> bool:
    """Return True if the quartiles of the times do not overlap in any run, and the first line is the faster one."""
    shared = one.keys() & other.keys()
    return bool(shared) and all(_high(one[run]) < _low(other[run]) for run in shared)


def _high(row: Row) -> float:
    return row.ms_high if math.isfinite(row.ms_high) else row.ms


def _low(row: Row) -> float:
    return row.ms_low if math.isfinite(row.ms_low) else row.ms
