"""Reader of TRACE runs: a deformation network up to max_time, and a velocity network for the motion past it.

The velocity network is evaluated once, at each Gaussian's centre at max_time. It returns v, w and raw rates; a rate is
raw |raw| / 10. The velocity at p is v + a tau + (w + e tau) x p, p in the world. With codes (TRACE's variant
`freegave`), the network depends on time only and returns these for every motion pattern; codes give shares of them.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ..errors import CheckpointError
from ..formats import ply
from ..motion import rotations
from . import networks, weights
from .foreign_run import TRACE_NEAR, ForeignRun, State, twisted_state
from .run_folder import RunFolder

TWIST = 12  # numbers: v, w and their rates


def read(run: RunFolder, velocity: weights.Weights, t_max: float) -> ForeignRun:
    """Read the Gaussians and both networks.

    Args:
        velocity: Content of its ``vel.pth``.
        t_max: Last time of the deformation.
    """
    splats = ply.read(run.ply)
    field = None
    if "code_field.pth" in run.files:
        field = networks.read_code_field(weights.load(run.weights("code_field.pth")))
    deform = networks.read_deform(weights.load(run.weights("deform.pth")), 0 if field is None else field.size)
    network = networks.read_velocity(velocity)
    inputs, outputs = (4, TWIST) if field is None else (1, TWIST * field.size)
    if (network.inputs, network.outputs) != (inputs, outputs):
        raise CheckpointError(
            f"{velocity.path}: expected a network from {inputs} to {outputs} numbers, "
            f"found {network.inputs} to {network.outputs}; unknown layout"
        )

    def codes(rows: slice) -> Tensor | None:
        with torch.no_grad():
            return None if field is None else field.codes(torch.from_numpy(splats.means[rows]))

    def state(rows: slice, t: float) -> State:
        return twisted_state(splats, deform, rows, t, codes(rows))

    def dynamics(rows: slice, means: np.ndarray, t: float) -> np.ndarray:
        with torch.no_grad():
            if field is None:
                points = torch.from_numpy(means.astype(np.float32))
                twists = squash(network(torch.cat([points, torch.full_like(points[:, :1], t)], -1)))
            else:
                patterns = squash(network(torch.tensor([[t]])).reshape(-1, TWIST))
                twists = field.pattern_shares(field.codes(torch.from_numpy(splats.means[rows]))) @ patterns
        return about_centers(twists.double().numpy(), means)

    return ForeignRun("trace", splats, TRACE_NEAR, state, dynamics, t_max)


def squash(raw: Tensor) -> Tensor:
    """Convert raw rates to rates; the first six numbers stay. [..., 12]"""
    rates = raw[..., 6:]
    return torch.cat([raw[..., :6], rates * rates.abs() / 10], -1)


def about_centers(twists: np.ndarray, centers: np.ndarray) -> np.ndarray:
    """Move world twists v, w and their rates a, e [n, 12] to centres [n, 3]: v and a become those of the centre."""
    v, w, a, e = np.split(twists, 4, axis=-1)
    return np.concatenate([v + rotations.cross(w, centers), w, a + rotations.cross(e, centers), e], -1)
