"""Rule for the stiffness of contacts and the time step.

The penetration at an impact is about v / w, and a resting body sags by g / w^2. The error of a simulation falls with
w dt. Measurements of both are in docs/results/contact.md.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

PENETRATION = 0.01  # of the size, at an impact
DRAFT_PENETRATION = 0.04  # the same for fits and samples, whose final poses are as good
SAG = 30.0  # lowest frequency of a contact, in units of sqrt(g / size)
DRAFT_STEP, FINE_STEP = 0.25, 0.1  # w dt
MOST_STEPS = 200_000  # up to the horizon; the shown path goes on until all bodies rest, for a few times as long


@dataclass(frozen=True)
class Stepping:
    """Numerical parameters of a simulation.

    Attributes:
        frequency: Angular frequency w of contacts, rad per unit of time.
        step: Time step.
    """

    frequency: float
    step: float

    @property
    def least_restitution(self) -> float:
        """Restitution below which the steps are too long: the damping would create energy."""
        return 0.1 if self.frequency * self.step > 0.15 else 0.0


def choose(speed: float, size: float, gravity: float, duration: float, draft: bool = False) -> Stepping:
    """Return frequency and time step of a simulation.

    Args:
        speed: Largest speed of a point that is expected.
        size: Size of the smallest body, > 0.
        gravity: Magnitude of gravity.
        duration: Time to simulate; contacts become softer if the steps would be more than `MOST_STEPS`.
        draft: True for fits and samples, which need many simulations.
    """
    share, fraction = (DRAFT_PENETRATION, DRAFT_STEP) if draft else (PENETRATION, FINE_STEP)
    frequency = max(speed / (share * size), SAG * math.sqrt(gravity / size), 1e-6)
    frequency = min(frequency, fraction * MOST_STEPS / max(duration, 1e-12))
    return Stepping(frequency, fraction / frequency)
