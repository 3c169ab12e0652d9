"""Translation-rotation dynamics module (TRD): motion state of each Gaussian, from its position and time.

Notation: the state of a Gaussian is a twist about the origin of the coordinates with linear rates. At time tau after
the start, the velocity at p is v + a tau + (w + e tau) x p.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from . import encoding


@dataclass(frozen=True)
class TRDShape:
    """Size of a TRD network: hidden layers after the first, their width, octaves of the encoding."""

    layers: int = 8
    width: int = 256
    bands: int = 6


SHAPES = {"complex": TRDShape(), "light": TRDShape(6, 128, 3), "small": TRDShape(3, 64, 3)}


@dataclass(frozen=True)
class MotionState:
    """Twist of each Gaussian at the start, world frame, about the origin of the coordinates.

    Attributes:
        equiv_velocity: Velocity of the body's point at the origin. [N, 3]
        angular_velocity: Angular velocity, rad per unit of time. [N, 3]
        equiv_acceleration: Time derivative of ``equiv_velocity``. [N, 3]
        angular_acceleration: Time derivative of ``angular_velocity``. [N, 3]
    """

    equiv_velocity: Tensor
    angular_velocity: Tensor
    equiv_acceleration: Tensor
    angular_acceleration: Tensor


class TRD(nn.Module):
    """MLP from position and time to `MotionState`. The untrained state is nearly at rest.

    Args:
        shape: Size of the network.
        generator: Source of the initial weights.

    Source: TRACE (the TRD): twelve outputs, the last six through a signed square a |a| / 10. Its slope is zero at
        zero, so these six start at 0.1 instead, which is an acceleration of 0.001.
    """

    def __init__(self, shape: TRDShape, generator: torch.Generator):
        super().__init__()
        self.shape = shape
        sizes = [encoding.encoded_size(4, shape.bands)] + [shape.width] * shape.layers
        self.layers = nn.ModuleList([encoding.linear(size, shape.width, generator) for size in sizes])
        self.head = nn.Linear(shape.width, 12)
        nn.init.zeros_(self.head.weight)
        with torch.no_grad():
            signs = torch.randint(0, 2, (6,), generator=generator) * 2.0 - 1
            self.head.bias.copy_(torch.cat([torch.zeros(6), 0.1 * signs]))

    def forward(self, positions: Tensor, t: float | Tensor, chunk: int = 65536) -> MotionState:
        """Return the motion state of Gaussians.

        Args:
            positions: Centres at time ``t``. [N, 3]
            t: Scene time, a number or a tensor [].
            chunk: Number of Gaussians per evaluation; bounds the memory.
        """
        inputs = torch.cat([positions, encoding.times(positions, len(positions), t)], dim=-1)
        out = encoding.in_chunks(self._run, inputs, chunk)
        rates = out[:, 6:] * out[:, 6:].abs() / 10
        return MotionState(out[:, :3], out[:, 3:6], rates[:, :3], rates[:, 3:])

    def _run(self, inputs: Tensor) -> Tensor:
        hidden = encoding.encode(inputs, self.shape.bands)
        for layer in self.layers:
            hidden = F.silu(layer(hidden))
        return self.head(hidden)
