"""Deformation field f_def: change of each Gaussian from its canonical state at an observed time.

Notation: N Gaussians, W width of the network. All Gaussians of a picture share one time, so the part of a layer that
reads the time is a single vector, added like a bias. The result equals that of the concatenated input.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from . import encoding


@dataclass(frozen=True)
class FieldShape:
    """Size of a deformation field.

    Attributes:
        depth: Hidden layers; the encodings are concatenated again after half of them.
        width: Width of the hidden layers.
        position_bands: Octaves of the position encoding.
        time_bands: Octaves of the time encoding.
        time_width: Hidden width of the time network, 0 for no time network.
        time_features: Outputs of the time network.
    """

    depth: int = 8
    width: int = 256
    position_bands: int = 8
    time_bands: int = 6
    time_width: int = 256
    time_features: int = 30


SHAPES = {
    "complex": FieldShape(),
    "light": FieldShape(depth=6, width=128, time_width=128),
    "small": FieldShape(depth=4, width=128, position_bands=6, time_bands=3, time_width=64),
}


@dataclass(frozen=True)
class Deltas:
    """Changes of the canonical state.

    Attributes:
        offsets: Added to the centres. [N, 3]
        quats: Rotations applied after the canonical ones, unit wxyz. [N, 4]
        log_scales: Added to the log scales. [N, 3]
    """

    offsets: Tensor
    quats: Tensor
    log_scales: Tensor


class DeformationField(nn.Module):
    """MLP from canonical centre and time to `Deltas`. The untrained field is the identity.

    Args:
        shape: Size of the network.
        generator: Source of the initial weights.

    Source: TRACE and FreeGave (f_def), after Deformable 3D Gaussians (Yang et al. 2024). Unlike there, heads start at
        zero, so that enabling the deformation changes nothing.
    """

    def __init__(self, shape: FieldShape, generator: torch.Generator):
        super().__init__()
        self.shape = shape
        times = encoding.encoded_size(1, shape.time_bands)
        self.time_network = None
        if shape.time_width > 0:
            self.time_network = nn.ModuleList(
                [
                    encoding.linear(times, shape.time_width, generator),
                    encoding.linear(shape.time_width, shape.time_features, generator),
                ]
            )
            times = shape.time_features
        inputs = encoding.encoded_size(3, shape.position_bands) + times
        self.skip = shape.depth // 2  # the layer after this one reads the inputs again
        sizes = [inputs] + [shape.width + (inputs if k == self.skip else 0) for k in range(shape.depth - 1)]
        self.layers = nn.ModuleList([encoding.linear(size, shape.width, generator) for size in sizes])
        self.head = nn.Linear(shape.width, 10)
        nn.init.zeros_(self.head.weight)
        with torch.no_grad():
            self.head.bias.copy_(torch.tensor([0.0, 0, 0, 1, 0, 0, 0, 0, 0, 0]))

    def forward(self, means: Tensor, t: float | Tensor, chunk: int = 65536) -> Deltas:
        """Return the deltas of Gaussians at a time.

        Args:
            means: Canonical centres. [N, 3]
            t: Scene time, a number or a tensor [].
            chunk: Number of Gaussians per evaluation; bounds the memory.
        """
        time = self._time_features(means, t)
        out = encoding.in_chunks(lambda rows: self._run(rows, time), means, chunk)
        quats = out[:, 3:7]
        return Deltas(out[:, :3], quats / quats.norm(dim=-1, keepdim=True).clamp(min=1e-8), out[:, 7:])

    def _time_features(self, means: Tensor, t: float | Tensor) -> Tensor:
        time = encoding.encode(encoding.times(means, 1, t)[:, 0], self.shape.time_bands)
        if self.time_network is not None:
            first, second = self.time_network
            time = second(F.relu(first(time)))
        return time

    def _run(self, means: Tensor, time: Tensor) -> Tensor:
        position = encoding.encode(means, self.shape.position_bands)
        hidden = position
        for k, layer in enumerate(self.layers):
            reads_inputs = k == 0 or k == self.skip + 1
            if not reads_inputs:
                hidden = F.relu(layer(hidden))
                continue
            assert isinstance(layer, nn.Linear)
            weight, p, s = layer.weight, position.shape[1], len(time)
            bias = layer.bias + weight[:, p : p + s] @ time
            total = F.linear(position, weight[:, :p], bias)
            hidden = F.relu(total if k == 0 else total + F.linear(hidden, weight[:, p + s :]))
        return self.head(hidden)
