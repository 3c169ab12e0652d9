"""What every layout comes down to: Gaussians, their state at observed times, and how each moves past the last one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ..formats.ply import Splats
from ..motion import rotations
from .networks import DeformNetwork

SPLATTING_NEAR = 0.2  # depth in front of which the rasterizer of 3DGS draws nothing
TRACE_NEAR = 0.8  # the same in TRACE and FreeGave, which drop nearer Gaussians first


@dataclass(frozen=True)
class State:
    """Some Gaussians at one time.

    Attributes:
        means: Centres, world. [n, 3] float64
        quats: Unit wxyz. [n, 4] float64
        log_scales: Logarithms of the standard deviations. [n, 3] float64
    """

    means: np.ndarray
    quats: np.ndarray
    log_scales: np.ndarray


@dataclass(frozen=True)
class Foreign:
    """A run of others, read.

    Attributes:
        kind: One of `run_folder.KINDS`.
        splats: The Gaussians as they are stored: canonical where there is a deformation.
        near_plane: Depth in front of which their renderer draws nothing.
        state: State of some rows at a time up to t_max, or None where nothing moves.
        dynamics: For some rows and their centres at a time t_max [n, 3] the motion past it, as `Scene.dynamics`
            [n, 12] has it; None where the layout has none.
        t_max: Last time of the deformation, None where nothing says it.
        classifier: Weight [K, 16] and bias [K] of the classifier of identities, or None.
    """

    kind: str
    splats: Splats
    near_plane: float
    state: Callable[[slice, float], State] | None = None
    dynamics: Callable[[slice, np.ndarray, float], np.ndarray] | None = None
    t_max: float | None = None
    classifier: tuple[np.ndarray, np.ndarray] | None = None


def twisted_state(splats: Splats, network: DeformNetwork, rows: slice, t: float, codes: Tensor | None = None) -> State:
    """State by the rule of TRACE and FreeGave: the predicted rotation goes before the canonical one, log scales add.

    Args:
        splats: The canonical Gaussians.
        network: The deformation network.
        rows: Which of them.
        t: The time.
        codes: Codes of these rows where the network takes them. [n, C]
    """
    with torch.no_grad():
        means = torch.from_numpy(splats.means[rows])
        change = network(means, t, codes)
        moved = change.move(means).double().numpy()
        turn = rotations.normalize(change.quats.double().numpy())
    return State(
        moved,
        rotations.normalize(rotations.multiply(turn, splats.quats[rows].astype(np.float64))),
        splats.log_scales[rows] + change.scales.double().numpy(),
    )
