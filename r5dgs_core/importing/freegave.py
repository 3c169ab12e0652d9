"""Reader of FreeGave runs: a code per Gaussian, and motion patterns whose weights depend on time only.

A code gives shares of the patterns. Of the resulting six weights, the first three are v and the last three -w; the
velocity at p is v + w x p, p in the world. FreeGave evaluates the weights at every step. The scene stores their value
and slope at max_time, which agrees to second order in the elapsed time. Gaussians that stay within 0.01 of their
position at time 0 keep the state of time 0, as in FreeGave's own renderings.
"""

from __future__ import annotations

import functools

import numpy as np
import torch
from torch import Tensor

from ..errors import CheckpointError
from ..formats import ply
from ..motion import rotations
from . import networks, weights
from .foreign_run import TRACE_NEAR, ForeignRun, State, twisted_state
from .run_folder import RunFolder
from .trace import about_centers

BANK = "vel_net.a_weight_bank"  # trained but unused by FreeGave; identifies the layout
WEIGHTS = 6
STILL_TIMES = tuple(k / 100 for k in range(75))
STILL_DISTANCE = 0.01  # world units


def read(run: RunFolder, velocity: weights.Weights, t_max: float) -> ForeignRun:
    """Read the Gaussians, the code field and both networks.

    Args:
        velocity: Content of its ``vel.pth``.
        t_max: Last time of the deformation.
    """
    splats = ply.read(run.ply)
    if "code_field.pth" not in run.files:
        raise CheckpointError(f"{run.weights('code_field.pth')}: the file is missing beside FreeGave's vel.pth")
    field = networks.read_code_field(weights.load(run.weights("code_field.pth")))
    deform = networks.read_deform(weights.load(run.weights("deform.pth")), field.size)
    network = networks.read_velocity(velocity)
    _check(velocity, network, field.size)

    def codes(rows: slice) -> Tensor:
        with torch.no_grad():
            return field.codes(torch.from_numpy(splats.means[rows]))

    def predicted(rows: slice, t: float) -> State:
        return twisted_state(splats, deform, rows, t, codes(rows))

    def rates(rows: slice, means: np.ndarray, t: float) -> np.ndarray:
        with torch.no_grad():
            shares = field.pattern_shares(codes(rows))
            value, slope = (shares @ x.reshape(-1, WEIGHTS) for x in network.value_and_slope(t))
        turned = torch.cat([value[:, :3], -value[:, 3:], slope[:, :3], -slope[:, 3:]], -1)
        return about_centers(turned.double().numpy(), means)

    @functools.lru_cache(maxsize=1)  # the same rows are requested for many times
    def resting(start: int, stop: int) -> tuple[np.ndarray, State]:
        """Mask of the rows that stay at their position of time 0, and their state at time 0."""
        rows = slice(start, stop)
        first, last = predicted(rows, 0.0), predicted(rows, t_max).means
        v, w, a, _ = np.split(rates(rows, last, t_max), 4, axis=-1)
        result = np.ones(stop - start, bool)
        for t in STILL_TIMES:
            tau = t - t_max
            later = last + v * tau + (a + rotations.cross(w, v)) * tau**2 / 2
            means = predicted(rows, t).means if tau <= 0 else later
            result &= np.linalg.norm(means - first.means, axis=-1) < STILL_DISTANCE
        return result, first

    def state(rows: slice, t: float) -> State:
        rests, first = resting(rows.start, rows.stop)
        moving = predicted(rows, t)
        chosen = (
            np.where(rests[:, None], getattr(first, name), getattr(moving, name))
            for name in ("means", "quats", "log_scales")
        )
        return State(*chosen)

    def dynamics(rows: slice, means: np.ndarray, t: float) -> np.ndarray:
        return np.where(resting(rows.start, rows.stop)[0][:, None], 0.0, rates(rows, means, t))

    return ForeignRun("freegave", splats, TRACE_NEAR, state, dynamics, t_max)


def _check(velocity: weights.Weights, network: networks.VelocityNetwork, patterns: int) -> None:
    """Raise `CheckpointError` if the velocity network does not have FreeGave's layout for this number of patterns."""
    velocity.tensor(BANK, (patterns, WEIGHTS))
    if (network.inputs, network.outputs) != (1, WEIGHTS * patterns):
        raise CheckpointError(
            f"{velocity.path}: expected a network from 1 to {WEIGHTS * patterns} numbers, found {network.inputs} to "
            f"{network.outputs}; unknown layout"
        )
