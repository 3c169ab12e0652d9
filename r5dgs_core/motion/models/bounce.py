"""A body that flies, spins and bounces off a floor, and keeps a fixed fraction of its vertical speed at each bounce.

Once it no longer leaves the floor, it slides on and keeps spinning.

Gravity a sets the upward direction n = -a / |a|. Between bounces the height over the floor is V y - |a| y^2 / 2, with
y the time since the last bounce and V the speed after it. V falls by the factor rho (restitution) at each bounce.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from .. import rotations, se3
from ..pose_track import PoseTrack, Window
from . import first_guesses
from .base import Block, Curve, MotionKind, MotionModel, Rates

_TINY = 1e-300
_NEAR = 9  # poses about a bounce that give its first guess
_PLACES = (0.2, 0.5, 0.8)  # tried times of a bounce between two poses
_RESTING = 1000.0  # flight number that stands for a body that stays on the floor
# a body stays on the floor once rho^number, its speed relative to that after bounce 0, is at most this times 1 - rho
_LOW = 1e-3


class Bounce(MotionKind):
    """d_f = v tau + a tau^2 / 2 up to the next bounce, R_f = exp(w tau)."""

    label = "Bounce"
    tooltip = "Flies and bounces off a floor that is perpendicular to its acceleration, lower each time"
    word = "bounce"
    fields = ("velocity", "acceleration", "angular_velocity", "bounce_time", "restitution")
    fits = {
        "bounces, level": ("w", "v", "fall", "bounce", "logit_rho"),  # on a level floor, if the up axis is known
        "bounces": ("w", "v", "a", "bounce", "logit_rho"),
    }
    blocks = {"fall": Block(1, 100.0), "bounce": Block(1, 3.0), "logit_rho": Block(1, 3.0)}

    def motion(self, rates: Rates, span: np.ndarray) -> Curve:
        g, up = _gravity(rates.a)
        since = span - rates.bounce_time
        hit = rates.v + rates.a * rates.bounce_time  # velocity at the next bounce
        down = -(hit * up).sum(-1)[..., None]
        speed = rates.restitution * np.maximum(down, 0.0)
        flies = (since < 0) | (down < 0) | (g == 0)  # up to the bounce; or a body that moves away from the floor
        high, rise = _heights(np.where(flies, 0.0, since), speed, np.maximum(g, _TINY), rates.restitution)
        free = rates.v * span + rates.a * (0.5 * span**2)
        at = rates.v * rates.bounce_time + rates.a * (0.5 * rates.bounce_time**2)
        along = hit + down * up
        d = np.where(flies, free, at + along * since + high * up)
        velocities = np.where(flies, rates.v + rates.a * span, along + rise * up)
        return rotations.rotvecs_to_quats(rates.w * span), d, rates.w + 0 * span, velocities

    def rates(self, parts: Mapping[str, np.ndarray], window: Window) -> Rates:
        """ "v" is the velocity just after a bounce at the time "bounce" of the window."""
        a = _acceleration(parts, window)
        g, up = _gravity(a)
        rho = _restitution(parts)
        speed, along = _split(parts["v"], up)
        number, start = _flight(-parts["bounce"], speed, np.maximum(g, _TINY), rho)
        at = parts["bounce"] + start
        rising = np.where(number >= _RESTING, 0.0, speed * rho ** np.minimum(number, _RESTING))
        v = along + (rising + g * at) * up  # at t_max, -at after the bounce
        ahead = np.maximum(at + 2 * rising / np.maximum(g, _TINY), 0.0)
        resting = number >= _RESTING
        return Rates(
            v=np.where(resting, along, v),
            a=a,
            w=parts["w"],
            bounce_time=np.where(resting, 0.0, ahead),
            restitution=rho,
        )

    def observed(
        self, parts: Mapping[str, np.ndarray], tau: np.ndarray, window: Window, inertia: np.ndarray | None
    ) -> se3.Pose:
        g, up = _gravity(_acceleration(parts, window))
        speed, along = _split(parts["v"], up)
        rho = _restitution(parts)

        def place(at: np.ndarray) -> np.ndarray:
            high, _ = _heights(at - parts["bounce"], speed, np.maximum(g, _TINY), rho)
            return along * at + high * up

        quats = rotations.multiply(
            rotations.rotvecs_to_quats(parts["w"] * tau[:, None]), rotations.rotvecs_to_quats(parts["r"])
        )
        return quats, parts["e"] + place(tau[:, None]) - place(np.zeros((1, 1)))

    def starts(self, blocks: Sequence[str], track: PoseTrack, window: Window) -> list[first_guesses.Guess]:
        """Fit two parabolas with a common acceleration that meet between two poses; guesses for at most two bounces."""
        count, tau = len(track), track.tau
        if count < 8 or ("fall" in blocks and window.up is None):
            return []
        gaps = np.arange(2, count - 1)
        times = (tau[gaps - 1, None] + np.array(_PLACES) * np.diff(tau)[gaps - 1, None]).reshape(-1)
        gaps = np.repeat(gaps, len(_PLACES))
        x = tau - times[:, None]
        near = np.abs(np.arange(count) - gaps[:, None] + 0.5) < 0.5 * _NEAR
        columns = np.stack([np.ones_like(x), np.maximum(x, 0), np.minimum(x, 0), 0.5 * x**2], -1) * near[..., None]
        path = track.displacements * near[..., None]
        fits = np.linalg.pinv(columns) @ path  # [K, 4, 3]
        misses = ((columns @ fits - path) ** 2).sum((-1, -2)) / near.sum(-1)
        found: list[tuple[float, first_guesses.Guess]] = []
        for row in np.argsort(misses, kind="stable"):
            e, after, before, a = fits[row]
            if "fall" in blocks:
                pull = -a @ np.array(window.up)
                if pull <= 0:
                    continue
                a = _acceleration({"fall": pull[None]}, window)
            g, up = _gravity(a)
            rise, fall = float(after @ up), float(before @ up)
            if not (rise > 0.05 and fall < -0.05 and float(g[0]) > 0.1):
                continue
            if any(abs(times[row] - other) < 0.05 for other, _ in found):
                continue
            rho = np.clip(rise / -fall, 0.1, 0.95)
            d = after * -times[row] + 0.5 * a * times[row] ** 2 + e
            guess = {"r": np.zeros(3), "e": d, "w": track.spin, "v": after, "a": a, "fall": g}
            guess |= {"bounce": times[row : row + 1], "logit_rho": np.log(np.array([rho / (1 - rho)]))}
            found.append((float(times[row]), guess))
            if len(found) == 2:
                break
        return [guess for _, guess in found]

    def last_impacts(self, parts: Mapping[str, np.ndarray], window: Window) -> tuple[np.ndarray, np.ndarray]:
        """Times <= 0 of the last impact before t_max and of the one before it; t_max for a body that rests. [..., 1]"""
        g, up = _gravity(_acceleration(parts, window))
        speed, _ = _split(parts["v"], up)
        g, rho = np.maximum(g, _TINY), _restitution(parts)
        number, start = _flight(-parts["bounce"], speed, g, rho)
        resting = number >= _RESTING
        before = _start(np.where(resting, 0.0, number - 1), speed, g, rho)
        last, earlier = (np.where(resting, 0.0, np.minimum(parts["bounce"] + x, 0.0)) for x in (start, before))
        return last, earlier

    def events(self, parts: Mapping[str, np.ndarray], window: Window) -> list[tuple[str, np.ndarray]]:
        g, up = _gravity(_acceleration(parts, window))
        speed, _ = _split(parts["v"], up)
        rho, gravity = _restitution(parts), np.maximum(g, _TINY)
        first = float(_flight(window.first - parts["bounce"], speed, gravity, rho)[0].reshape(-1)[0])
        last = float(_flight(-parts["bounce"], speed, gravity, rho)[0].reshape(-1)[0])
        numbers = range(int(first) + 1, int(min(last, first + 50)) + 1)
        return [("impact", parts["bounce"] + _start(np.array(float(k)), speed, gravity, rho)) for k in numbers]

    def resolved(self, parts: Mapping[str, np.ndarray], window: Window, count: int) -> bool:
        """True if at least one flight between two bounces is longer than two gaps between poses."""
        times = [float(time.reshape(-1)[0]) for _, time in self.events(parts, window)]
        return bool(len(times) < 2 or max(np.diff(times)) > 2 * -window.first / (count - 1))

    def kinks(self, model: MotionModel, end: float) -> np.ndarray:
        """Impacts, and the time from which the body stays on the floor."""
        g, up = _gravity(model.acceleration)
        rho, down = model.restitution, -float((model.velocity + model.acceleration * model.bounce_time) @ up)
        if not (g > 0 and down >= 0):
            return np.zeros(0)
        numbers = np.arange(_RESTING)
        since = _start(numbers, np.array(rho * down), g, np.array(rho))[rho**numbers > _LOW * (1 - rho)]
        if rho < 1:
            since = np.append(since, 2 * rho * down / g * (1 / (1 - rho) - _LOW))
        times = np.unique(model.bounce_time + since)
        return times[(times > 0) & (times <= end)]

    def moves(self, model: MotionModel) -> bool:
        return bool(model.velocity.any() or model.acceleration.any() or model.angular_velocity.any())

    def spins(self, model: MotionModel) -> bool:
        return bool(model.angular_velocity.any())


def _acceleration(parts: Mapping[str, np.ndarray], window: Window) -> np.ndarray:
    """Gravity, along the up axis if its strength alone is free. [..., 3]"""
    if "a" in parts:
        return parts["a"]
    assert window.up is not None
    return -parts["fall"] * np.array(window.up)


def _gravity(a: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Strength of an acceleration [..., 1] and the direction against it [..., 3]."""
    g = np.sqrt((a * a).sum(-1))[..., None]
    return g, -a / np.maximum(g, _TINY)


def _restitution(parts: Mapping[str, np.ndarray]) -> np.ndarray:
    return 1 / (1 + np.exp(-np.clip(parts["logit_rho"], -4.0, 5.0)))


def _split(v: np.ndarray, up: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Upward speed, at least 1e-6, and the velocity along the floor. [..., 1], [..., 3]"""
    speed = (v * up).sum(-1)[..., None]
    return np.maximum(speed, 1e-6), v - speed * up


def _start(number: np.ndarray, speed: np.ndarray, g: np.ndarray, rho: np.ndarray) -> np.ndarray:
    """Start of a flight, as time since bounce 0: 2 V / g times 1 + rho + ... + rho^(number - 1)."""
    first = 2 * speed / g
    steady = np.abs(1 - rho) < 1e-9
    return first * np.where(steady, number, (1 - rho**number) / np.where(steady, 1.0, 1 - rho))


def _flight(since: np.ndarray, speed: np.ndarray, g: np.ndarray, rho: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Flight at a time since bounce 0, from which the body rises at ``speed``.

    Returns:
        Number of the flight, negative before bounce 0 and `_RESTING` if the body stays on the floor, and its start.
    """
    first = 2 * speed / g
    flights = since / np.maximum(first, _TINY)
    steady = np.abs(1 - rho) < 1e-9
    rest = 1 - flights * (1 - rho)  # rho^number, for whole numbers
    with np.errstate(divide="ignore", invalid="ignore"):
        number = np.where(
            steady, np.floor(flights), np.floor(np.log(np.maximum(rest, _TINY)) / np.log(np.maximum(rho, _TINY)))
        )
    number = np.where((rest <= _LOW * (1 - rho)) | (first <= _TINY) & (since >= 0), _RESTING, number)
    number = np.clip(number, -60.0, _RESTING)
    return number, np.where(number < _RESTING, _start(number, speed, g, rho), 0.0)


def _heights(since: np.ndarray, speed: np.ndarray, g: np.ndarray, rho: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Height over the floor and its rate at a time since bounce 0, from which the body rises at ``speed``."""
    number, start = _flight(since, speed, g, rho)
    rising = speed * rho**number
    y = since - start
    resting = number >= _RESTING
    return np.where(resting, 0.0, rising * y - 0.5 * g * y**2), np.where(resting, 0.0, rising - g * y)


KIND = Bounce()
