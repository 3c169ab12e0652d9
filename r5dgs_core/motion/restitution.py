"""Coefficient of restitution of MuJoCo's contacts.

A contact of MuJoCo is a damped spring that cannot pull: it ends when its force reaches zero. Notation: z the damping
ratio, w the angular frequency of the undamped spring, e the speed after an impact over the speed before it.
"""

from __future__ import annotations

import functools
import math

_GRIP = math.log(20) / (2 * math.pi)  # damping ratio of friction, at least: a bounce of time pi / w leaves 1 / 20
ASSUMED = 0.3  # of bodies about whose restitution nothing is known
LEAST, MOST = 0.05, 0.98  # range of e in which simulated impacts keep it to 0.01
_HEAVY = 50.0  # damping ratio above which nothing bounces


def of_damping(z: float) -> float:
    """Restitution of a damping ratio >= 0; falls from 1.

    Source: motion of the damped oscillator up to the time at which its force is zero.
    """
    if z < 1e-9:
        return 1.0
    if abs(z - 1) < 1e-6:
        return math.exp(-2)
    s = math.sqrt(abs(z * z - 1))
    phase = math.atan2(2 * z * s, 2 * z * z - 1) if z < 1 else math.log((z + s) / (z - s))
    return math.exp(-z / s * phase)


def limited(e: float) -> float:
    """Restitution that is simulated for a wanted one."""
    return min(max(e, LEAST), MOST)


@functools.lru_cache(maxsize=256)  # simulations of a fit repeat the same values
def damping_of(e: float) -> float:
    """Damping ratio of a restitution, clipped to [`LEAST`, `MOST`]; inverse of `of_damping`."""
    e = limited(e)
    low, high = 0.0, _HEAVY
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if of_damping(middle) > e else (low, middle)
    return 0.5 * (low + high)


def reference(e: float, frequency: float) -> tuple[float, float]:
    """MuJoCo's ``solref`` of a contact with a restitution and a frequency w: minus stiffness and minus damping."""
    return -(frequency**2), -2 * damping_of(e) * frequency


def grip(normal: tuple[float, float]) -> tuple[float, float]:
    """Return ``solreffriction`` for the ``solref`` of a contact.

    Friction would stop the slip of a contact with the damping of its normal direction: the more a ball bounces, the
    more slip a bounce would leave, however large its friction.
    """
    frequency = math.sqrt(-normal[0])
    return normal[0], min(normal[1], -2 * _GRIP * frequency)
