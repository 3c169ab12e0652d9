"""The networks of the field: encodings, deformation field, TRD."""

from __future__ import annotations

import math

import pytest
import torch

from r5dgs_core.model import deformation, encoding, trd


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def disturb(module: torch.nn.Module) -> None:
    """Weights as after some training: heads no longer at zero."""
    with torch.no_grad():
        for parameter in module.parameters():
            parameter += 0.05 * torch.randn(parameter.shape, generator=generator(1))


def test_the_encoding_is_the_input_and_its_octaves():
    x = torch.tensor([[0.3, -1.2]], dtype=torch.float64)
    found = encoding.encode(x, 2)[0].tolist()
    expected = [0.3, -1.2]
    for k in (1, 2):
        expected += [math.sin(k * 0.3), math.sin(k * -1.2), math.cos(k * 0.3), math.cos(k * -1.2)]
    assert found == pytest.approx(expected, abs=1e-15)
    assert len(found) == encoding.encoded_size(2, 2)


@pytest.mark.parametrize("size", deformation.SHAPES)
def test_the_untrained_field_is_the_identity(size):
    field = deformation.DeformationField(deformation.SHAPES[size], generator())
    deltas = field(torch.randn(7, 3, generator=generator(2)), 0.4)
    assert (deltas.offsets == 0).all() and (deltas.log_scales == 0).all()
    assert (deltas.quats == torch.tensor([1.0, 0, 0, 0])).all()


@pytest.mark.parametrize("size", trd.SHAPES)
def test_the_untrained_trd_keeps_gaussians_at_rest_and_can_learn_accelerations(size):
    network = trd.TRD(trd.SHAPES[size], generator())
    state = network(torch.randn(7, 3, generator=generator(2)), 0.4)
    assert (state.equiv_velocity == 0).all() and (state.angular_velocity == 0).all()
    assert state.equiv_acceleration.abs().max() <= 0.0011
    (state.equiv_acceleration.sum() + state.angular_acceleration.sum()).backward()
    assert (network.head.bias.grad[6:] != 0).all()


def test_the_papers_networks_have_the_papers_layers():
    field = deformation.DeformationField(deformation.SHAPES["complex"], generator())
    assert [tuple(layer.weight.shape) for layer in field.layers] == [(256, 81)] + [(256, 256)] * 4 + [
        (256, 337),
        (256, 256),
        (256, 256),
    ]
    assert [tuple(layer.weight.shape) for layer in field.time_network] == [(256, 13), (30, 256)]
    network = trd.TRD(trd.SHAPES["complex"], generator())
    assert [tuple(layer.weight.shape) for layer in network.layers] == [(256, 52)] + [(256, 256)] * 8
    light = trd.TRD(trd.SHAPES["light"], generator())
    assert [tuple(layer.weight.shape) for layer in light.layers] == [(128, 28)] + [(128, 128)] * 6


@pytest.mark.parametrize("size", deformation.SHAPES)
def test_a_time_as_a_bias_is_a_time_beside_every_position(size):
    shape = deformation.SHAPES[size]
    field = deformation.DeformationField(shape, generator()).double()
    disturb(field)
    means, t = torch.randn(5, 3, generator=generator(3), dtype=torch.float64), 0.37
    time = encoding.encode(torch.full((5, 1), t, dtype=torch.float64), shape.time_bands)
    first, second = field.time_network
    time = second(torch.relu(first(time)))
    inputs = torch.cat([encoding.encode(means, shape.position_bands), time], dim=1)
    hidden = inputs
    for k, layer in enumerate(field.layers):
        hidden = torch.relu(layer(hidden))
        if k == shape.depth // 2:
            hidden = torch.cat([inputs, hidden], dim=1)
    expected = field.head(hidden)
    found = field(means, t)
    torch.testing.assert_close(found.offsets, expected[:, :3], atol=1e-12, rtol=0)
    torch.testing.assert_close(found.log_scales, expected[:, 7:], atol=1e-12, rtol=0)
    torch.testing.assert_close(found.quats.norm(dim=1), torch.ones(5, dtype=torch.float64))


def test_chunks_change_only_the_memory():
    field = deformation.DeformationField(deformation.SHAPES["small"], generator()).double()
    network = trd.TRD(trd.SHAPES["small"], generator()).double()
    disturb(field)
    disturb(network)
    means = torch.randn(23, 3, generator=generator(3), dtype=torch.float64)
    torch.testing.assert_close(field(means, 0.2, chunk=5).offsets, field(means, 0.2).offsets, atol=1e-14, rtol=0)
    whole, parts = network(means, 0.2), network(means, 0.2, chunk=4)
    torch.testing.assert_close(parts.angular_velocity, whole.angular_velocity, atol=1e-14, rtol=0)


def test_accelerations_pass_through_a_signed_square():
    network = trd.TRD(trd.SHAPES["small"], generator())
    with torch.no_grad():
        network.head.bias.copy_(torch.arange(12.0) - 8)
    state = network(torch.zeros(1, 3), 0.0)
    assert state.equiv_velocity[0].tolist() == [-8, -7, -6] and state.angular_velocity[0].tolist() == [-5, -4, -3]
    assert state.equiv_acceleration[0].tolist() == pytest.approx([-0.4, -0.1, 0.0])
    assert state.angular_acceleration[0].tolist() == pytest.approx([0.1, 0.4, 0.9])
