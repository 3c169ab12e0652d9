"""Splits and scene times of the chosen frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .. import errors
from .frame_choice import Choice

HORIZON_SHARE = 0.25
_DIGITS = 9  # of scene times in files


@dataclass(frozen=True)
class HoldOut:
    """Frames that training does not use.

    Attributes:
        cameras: Names of held-out cameras; their frames up to t_max are `val`.
        every: Hold out every n-th moment as `val`, but neither the first nor the last; None for none.
        after: Frames later than this are `test`, seconds from the first moment; None for none.
        horizon: Seconds of the scene after its last observed time; None for a quarter of the observed time.
    """

    cameras: tuple[str, ...] = ()
    every: int | None = None
    after: float | None = None
    horizon: float | None = None


@dataclass(frozen=True)
class Timeline:
    """Scene times and splits.

    Attributes:
        times: Scene time of each frame in [0, 1]. C arrays [F]
        splits: Split of each frame, "" for frames of held-out cameras outside the observed time. C tuples
        t_max: Last time of the training frames.
        seconds_per_unit: Seconds per unit of scene time.
        frames_per_unit: Frames of the source per unit of scene time.
    """

    times: tuple[np.ndarray, ...]
    splits: tuple[tuple[str, ...], ...]
    t_max: float
    seconds_per_unit: float
    frames_per_unit: float


def arrange(names: Sequence[str], choice: Choice, hold_out: HoldOut) -> Timeline:
    """Distribute frames to splits, and map their times to [0, 1].

    Raises:
        ConfigError: A held-out camera does not exist, no frame is held out, or none is left for training.
    """
    unknown = [name for name in hold_out.cameras if name not in names]
    if unknown:
        raise errors.ConfigError(f"--hold-out-camera {unknown[0]}: expected one of {', '.join(names)}")
    zero = min(times[0] for times in choice.times)
    last = max(times[-1] for times in choice.times)
    last_moment = max(int(moments[-1]) for moments in choice.moments)
    splits = []
    for name, times, moments in zip(names, choice.times, choice.moments, strict=True):
        kinds = []
        for time, moment in zip(times - zero, moments, strict=True):
            later = hold_out.after is not None and time > hold_out.after + 1e-6
            between = hold_out.every is not None and 0 < moment < last_moment and moment % hold_out.every == 0
            kinds.append("test" if later else "val" if name in hold_out.cameras or between else "train")
        splits.append(tuple(kinds))
    _check_held_out(splits, hold_out, last - zero, last_moment + 1)
    observed = [
        t
        for times, kinds in zip(choice.times, splits, strict=True)
        for t, kind in zip(times, kinds, strict=True)
        if kind == "train"
    ]
    if not observed:
        raise errors.ConfigError("no frame is left for training; hold out fewer cameras or times")
    end = max(observed) - zero
    within = min(observed), max(observed)
    splits = [
        tuple(
            "" if kind == "val" and not within[0] <= t <= within[1] else kind
            for t, kind in zip(times, kinds, strict=True)
        )
        for times, kinds in zip(choice.times, splits, strict=True)
    ]
    horizon = HORIZON_SHARE * end if hold_out.horizon is None else hold_out.horizon
    unit = max(last - zero, end + horizon) or 1.0
    return Timeline(
        times=tuple(np.round((times - zero) / unit, _DIGITS) for times in choice.times),
        splits=tuple(splits),
        t_max=round(end / unit, _DIGITS),
        seconds_per_unit=float(unit),
        frames_per_unit=float(unit / choice.source_interval) if choice.source_interval else float(unit * 30.0),
    )


def _check_held_out(splits: Sequence[Sequence[str]], hold_out: HoldOut, last: float, moments: int) -> None:
    """Raise ConfigError if an option holds out no frame, because the recordings are too short.

    Args:
        splits: Split of each frame. C lists
        hold_out: The options.
        last: Time of the last frame, seconds from the first moment.
        moments: Number of moments.
    """
    used = {split for one in splits for split in one}
    if hold_out.after is not None and "test" not in used:
        raise errors.ConfigError(
            f"--hold-out-after {hold_out.after:g}: expected a time before the last frame, which is at {last:.3g} s"
        )
    if hold_out.every is not None and moments <= hold_out.every + 1:
        raise errors.ConfigError(
            f"--hold-out-every {hold_out.every}: expected at most {max(moments - 2, 0)}, because the recordings have "
            f"{moments} times, and the first and the last one are not held out"
        )
