"""Checks of single tracks: problems are reported with the object's name and do not affect other groups."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Sequence

import numpy as np

from ..motion import rigid_fit, rotations
from ..train.observed_motion import GroupTrack

log = logging.getLogger(__name__)


def sound(group: GroupTrack, name: str) -> GroupTrack:
    """Return the group, or log a warning and return it at rest if its track is not finite.

    Args:
        group: A motion group.
        name: Name of its object, for the warning.
    """
    track = np.concatenate([group.quats, group.displacements], axis=1)
    bad = np.asarray(~np.isfinite(track).all(1))
    if not bad.any():
        return group
    if group.role == "body":  # its shadow follows it
        log.warning(
            "%s: %d of %d poses are not finite; the object is left at rest, others are not affected. "
            "Remedy: train again",
            name,
            int(bad.sum()),
            len(bad),
        )
    still = np.zeros_like(group.displacements)
    return dataclasses.replace(group, quats=rotations.identity(len(bad)), displacements=still)


def warn_of_aliasing(name: str, times: np.ndarray, track: np.ndarray) -> None:
    """Warn if an object turns by more than 120 degrees between two observed times, as its direction is then ambiguous.

    Args:
        name: Name of the object.
        times: Observed times. [S]
        track: Poses of the object, rotation wxyz first. [S, 7]
    """
    found = rigid_fit.aliased_step(times, track[:, :4])
    if found is not None:
        angle, first, second = found
        log.warning(
            "%s turns by %.0f degrees between t = %g and %g: its direction is ambiguous, also past the last observed "
            "time. Remedy: frames at more times",
            name,
            np.degrees(angle),
            first,
            second,
        )


def warn_of_slips(name: str, slips: Sequence[float]) -> None:
    """Warn if the rotations of an object slipped, at the times given."""
    for time in slips:
        log.warning("rotation of %s slipped at t=%.2f; its motion past t_max ignores this turn", name, time)
