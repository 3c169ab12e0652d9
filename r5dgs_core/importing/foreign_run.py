"""Common form of all imported runs: Gaussians, their state at observed times, and their motion past the last one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ..motion import rotations
from ..scene.splats import Splats
from .networks import DeformNetwork

SPLATTING_NEAR = 0.2  # near plane of the 3DGS rasterizer, depth
TRACE_NEAR = 0.8  # near plane of TRACE and FreeGave: they cull Gaussians nearer than this before 3DGS's own near plane


@dataclass(frozen=True)
class State:
    """State of some Gaussians at one time.

    Attributes:
        means: Centres, world. [n, 3] float64
        quats: Unit wxyz. [n, 4] float64
        log_scales: Logarithms of the standard deviations. [n, 3] float64
    """

    means: np.ndarray
    quats: np.ndarray
    log_scales: np.ndarray


@dataclass(frozen=True)
class ForeignRun:
    """A loaded run of another project.

    Attributes:
        kind: One of `run_folder.KINDS`.
        splats: The Gaussians as stored; canonical if there is a deformation.
        near_plane: Near plane of the run's renderer, depth.
        state: Function from rows and a time up to t_max to their state, or None for a static run.
        dynamics: Function from rows, their centres at t_max [n, 3], and t_max to the motion past it, as in
            `Dynamics.rates` [n, 12]; None if the layout has none.
        t_max: Last time of the deformation, None if unknown.
        classifier: Weight [K, 16] and bias [K] of the identity classifier, or None.
    """

    kind: str
    splats: Splats
    near_plane: float
    state: Callable[[slice, float], State] | None = None
    dynamics: Callable[[slice, np.ndarray, float], np.ndarray] | None = None
    t_max: float | None = None
    classifier: tuple[np.ndarray, np.ndarray] | None = None


def twisted_state(splats: Splats, network: DeformNetwork, rows: slice, t: float, codes: Tensor | None = None) -> State:
    """Compute the state as TRACE and FreeGave do: predicted rotation times canonical one, log scales added.

    Args:
        splats: The canonical Gaussians.
        network: The deformation network.
        rows: Rows to evaluate.
        codes: Codes of these rows, if the network takes them. [n, C]
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
