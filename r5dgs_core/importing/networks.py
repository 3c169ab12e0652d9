"""Networks of other projects, evaluated from their weights; widths, depths and encodings follow from the shapes.

Notation: N Gaussians, L frequency bands. An input x becomes x, sin(2^k x), cos(2^k x) for k = 0..L-1.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from ..errors import CheckpointError
from .weights import Linear, Weights

RAW_TIME_BANDS = 10  # of networks without a time network


@dataclass(frozen=True)
class Deformation:
    """Output of a deformation network.

    Attributes:
        shift: Displacement of the centres, or affine map of each centre if the network predicts screws. [N, 3] or
            [N, 3, 4]
        quats: Raw output of the rotation head. [N, 4]
        scales: Raw output of the scale head. [N, 3]
    """

    shift: Tensor
    quats: Tensor
    scales: Tensor

    def move(self, means: Tensor) -> Tensor:
        """Return the deformed centres. [N, 3]"""
        if self.shift.ndim == 2:
            return means + self.shift
        return (self.shift[..., :3] @ means[..., None])[..., 0] + self.shift[..., 3]


@dataclass(frozen=True)
class SkipRow:
    """Sequence of ReLU layers with one skip connection: layer ``skip`` also reads the inputs."""

    layers: tuple[Linear, ...]
    skip: int

    @property
    def inputs(self) -> int:
        """Number of input channels."""
        return self.layers[0].inputs

    @property
    def outputs(self) -> int:
        """Number of output channels."""
        return self.layers[-1].outputs

    def __call__(self, inputs: Tensor) -> Tensor:
        """Evaluate the layers. [N, inputs] -> [N, outputs]"""
        hidden = inputs
        for i, layer in enumerate(self.layers):
            hidden = torch.relu(layer(torch.cat([inputs, hidden], -1) if i == self.skip else hidden))
        return hidden


def read_skip_row(weights: Weights) -> SkipRow:
    """Read the layers ``linear.0``, ``linear.1``, ... of a state dictionary."""
    layers = [weights.linear("linear.0")]
    width, inputs, skips = layers[0].outputs, layers[0].inputs, []
    while f"linear.{len(layers)}.weight" in weights:
        name = f"linear.{len(layers)}"
        if weights.linear(name).inputs == width + inputs:
            skips.append(len(layers))
        layers.append(weights.linear(name, inputs=width + inputs * (len(layers) in skips), outputs=width))
    if len(skips) != 1:
        raise CheckpointError(
            f"{weights.path}: expected one of the layers linear.1, linear.2, ... to have {width} + {inputs} inputs, "
            f"found {len(skips)}"
        )
    return SkipRow(tuple(layers), skips[0])


@dataclass(frozen=True)
class DeformNetwork:
    """Deformation network of Deformable-3DGS, TRACE and FreeGave.

    Attributes:
        trunk: Hidden layers.
        time_layers: Two layers for the encoded time, or none.
        bands: Frequency bands of position and time.
        shift: Head of the displacement, or heads of the rotational and translational part of a screw.
        quats: Head of the rotation.
        scales: Head of the scale.
    """

    trunk: SkipRow
    time_layers: tuple[Linear, ...]
    bands: tuple[int, int]
    shift: tuple[Linear, ...]
    quats: Linear
    scales: Linear

    def __call__(self, means: Tensor, t: float, codes: Tensor | None = None) -> Deformation:
        """Deform canonical centres [N, 3], with codes [N, C] if the network takes them, at a time."""
        time = encode(torch.tensor([[t]], dtype=means.dtype), self.bands[1])
        if self.time_layers:
            time = chain(self.time_layers, time, torch.relu)
        parts = [encode(means, self.bands[0]), time.expand(len(means), -1)]
        hidden = self.trunk(torch.cat(parts if codes is None else [*parts, codes], -1))
        shift = self.shift[0](hidden) if len(self.shift) == 1 else screw(self.shift[0](hidden), self.shift[1](hidden))
        return Deformation(shift, self.quats(hidden), self.scales(hidden))


def read_deform(weights: Weights, code_size: int = 0) -> DeformNetwork:
    """Read the deformation network of a state dictionary; the unused gate of some files is ignored.

    Args:
        weights: Content of ``deform.pth``.
        code_size: Channels of the code that the network takes besides position and time.

    Raises:
        CheckpointError: The shapes do not match such a network.
    """
    trunk = read_skip_row(weights)
    time_layers: list[Linear] = []
    time_bands, time_width = RAW_TIME_BANDS, 1 + 2 * RAW_TIME_BANDS
    if "timenet.0.weight" in weights:
        time_layers = weights.chain(["timenet.0", "timenet.2"], inputs=None)
        time_bands = _bands(weights, "timenet.0", time_layers[0].inputs, 1)
        time_width = time_layers[1].outputs
    bands = _bands(weights, "linear.0", trunk.inputs - time_width - code_size, 3)
    names = ["gaussian_warp"] if "gaussian_warp.weight" in weights else ["branch_w", "branch_v"]
    return DeformNetwork(
        trunk=trunk,
        time_layers=tuple(time_layers),
        bands=(bands, time_bands),
        shift=tuple(weights.linear(name, inputs=trunk.outputs, outputs=3) for name in names),
        quats=weights.linear("gaussian_rotation", inputs=trunk.outputs, outputs=4),
        scales=weights.linear("gaussian_scaling", inputs=trunk.outputs, outputs=3),
    )


@dataclass(frozen=True)
class CodeField:
    """FreeGave's network from a position to a code, and from a code to the shares of the motion patterns.

    Attributes:
        trunk: Hidden layers.
        bands: Frequency bands of the position.
        output: Head of the code.
        shares: Layers from the code to the shares.
    """

    trunk: SkipRow
    bands: int
    output: Linear
    shares: tuple[Linear, ...]

    @property
    def size(self) -> int:
        """Number of channels of a code."""
        return self.output.outputs

    def codes(self, means: Tensor) -> Tensor:
        """Return the codes of canonical centres. [N, 3] -> [N, C]"""
        return self.output(self.trunk(encode(means, self.bands)))

    def pattern_shares(self, codes: Tensor) -> Tensor:
        """Return the share of each motion pattern in a code; any sign, not normalised. [N, C] -> [N, C]"""
        return chain(self.shares, codes, torch.relu)


def read_code_field(weights: Weights) -> CodeField:
    """Read the code field of a state dictionary, ``code_field.pth``."""
    trunk = read_skip_row(weights)
    output = weights.linear("output.0", inputs=trunk.outputs)
    shares = weights.chain(["seg.0", "seg.2", "seg.4"], inputs=output.outputs, outputs=output.outputs)
    return CodeField(trunk, _bands(weights, "linear.0", trunk.inputs, 3), output, tuple(shares))


@dataclass(frozen=True)
class VelocityNetwork:
    """SiLU network from encoded position and time, or time only, to rates.

    Attributes:
        layers: Layers; the last one has no activation.
        bands: Frequency bands.
        inputs: 4 for position and time, 1 for time only.
    """

    layers: tuple[Linear, ...]
    bands: int
    inputs: int

    @property
    def outputs(self) -> int:
        """Number of rates."""
        return self.layers[-1].outputs

    def __call__(self, inputs: Tensor) -> Tensor:
        """Return the rates at positions and times [N, 4], or at times [N, 1]."""
        return chain(self.layers, encode(inputs, self.bands), functional.silu)

    def value_and_slope(self, t: float) -> tuple[Tensor, Tensor]:
        """Return the rates at a time and their time derivative, for a network of time only. [outputs] each"""
        x = encode(torch.tensor([t]), self.bands)
        waves = x[1:].reshape(-1, 2).flip(-1) * torch.tensor([1.0, -1.0]) * 2.0 ** torch.arange(self.bands)[:, None]
        slope = torch.cat([torch.ones(1), waves.ravel()])
        for layer in self.layers[:-1]:
            x, slope = layer(x), layer.weight @ slope
            gate = torch.sigmoid(x)
            x, slope = x * gate, slope * gate * (1 + x * (1 - gate))
        return self.layers[-1](x), self.layers[-1].weight @ slope


def read_velocity(weights: Weights) -> VelocityNetwork:
    """Read the velocity network of a state dictionary, keys ``vel_net.weight_net.*`` of ``vel.pth``."""
    names = ["vel_net.weight_net.0"]
    while f"vel_net.weight_net.{len(names) + 1}.0.weight" in weights:
        names.append(f"vel_net.weight_net.{len(names) + 1}.0")
    layers = weights.chain(names, inputs=None)
    bands = len(weights.tensor("vel_net.embedder.frequency_bands", (None,)))
    inputs, left = divmod(layers[0].inputs, 1 + 2 * bands)
    if left or inputs not in (1, 4):
        raise CheckpointError(
            f"{weights.path}: 'vel_net.weight_net.0.weight': expected {4 + 8 * bands} or {1 + 2 * bands} inputs for "
            f"{bands} frequency bands, found {layers[0].inputs}"
        )
    return VelocityNetwork(tuple(layers), bands, inputs)


def encode(x: Tensor, bands: int) -> Tensor:
    """Return x, sin(x), cos(x), sin(2 x), cos(2 x), sin(4 x), ... [..., D] -> [..., D (1 + 2 L)]"""
    parts = [x]
    for k in range(bands):
        parts += [torch.sin(x * 2.0**k), torch.cos(x * 2.0**k)]
    return torch.cat(parts, -1)


def chain(layers: Sequence[Linear], x: Tensor, activation: Callable[[Tensor], Tensor]) -> Tensor:
    """Apply layers in sequence, with the activation between them."""
    for layer in layers[:-1]:
        x = activation(layer(x))
    return layers[-1](x)


def screw(w: Tensor, v: Tensor) -> Tensor:
    """Map of a screw as in Deformable-3DGS with 6 degrees of freedom. [N, 3], [N, 3] -> [N, 3, 4]

    The axis is w / |w| + 1e-5, as in training, so the axis is not exactly a unit vector and the map is not exactly
    rigid.
    """
    theta = torch.linalg.norm(w, dim=-1, keepdim=True)
    w, v = w / theta + 1e-5, v / theta + 1e-5
    zero = torch.zeros_like(w[..., 0])
    x, y, z = w.unbind(-1)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(*w.shape[:-1], 3, 3)
    square, angle, one = cross @ cross, theta[..., None], torch.eye(3, dtype=w.dtype)
    turn = one + torch.sin(angle) * cross + (1 - torch.cos(angle)) * square
    shift = (angle * one + (1 - torch.cos(angle)) * cross + (angle - torch.sin(angle)) * square) @ v[..., None]
    return torch.cat([turn, shift], -1)


def _bands(weights: Weights, name: str, width: int, dimensions: int) -> int:
    """Number of frequency bands of an encoding with a given width."""
    bands, left = divmod(width - dimensions, 2 * dimensions)
    if left or bands < 0:
        raise CheckpointError(
            f"{weights.path}: '{name}.weight': {width} inputs are no encoding of {dimensions} numbers; unknown layout"
        )
    return bands
