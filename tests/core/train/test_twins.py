"""The torch twins of kernels, and of functions that would make a GPU wait, compute what these compute."""

import numpy as np
import pytest
import torch

from r5dgs_core.model.group_poses import GroupPoses
from r5dgs_core.motion import rotations
from r5dgs_core.train import losses
from r5dgs_core.train.representations import fused_posing, rigidity
from r5dgs_core.train.running_loss import RunningLoss


def draws(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("partly", [False, True])
@pytest.mark.parametrize("weight", [0.0, 0.2, 1.0])
def test_the_photometric_loss(weight, partly):
    x, y = draws(21, 17, 3).abs().requires_grad_(), draws(21, 17, 3, seed=1).abs()
    left_out = (draws(21, 17, seed=2) > 0.5).numpy() if partly else None
    expected = losses.photometric(x, y, weight, left_out)
    (expected_gradient,) = torch.autograd.grad(expected, x)
    found, gradient = losses._in_torch(x.detach(), y, weight, left_out)
    torch.testing.assert_close(found, expected.detach(), atol=1e-6, rtol=1e-5)
    torch.testing.assert_close(gradient, expected_gradient, atol=1e-7, rtol=1e-3)


def test_posing():
    n, groups = 40, 5
    turn = rotations.normalize(draws(groups, 4, seed=2))
    tensors = [draws(n, 3), draws(n, 4), draws(n, 3), draws(n), draws(n, 3), draws(n, 3), draws(3)]
    tensors += [turn, rotations.quats_to_rotmats(turn), draws(groups, 3)]
    ids, centers = torch.arange(n) % groups, draws(groups, 3, seed=3)
    results = []
    for pose in (fused_posing.pose, fused_posing._pose_in_torch):
        leaves = [t.clone().requires_grad_() for t in tensors]
        found = pose(*leaves[:7], ids, GroupPoses(*leaves[7:]), centers)
        parts = (found.means, found.quats, found.scales, found.opacities, found.colors)
        sum((part * draws(*part.shape, seed=k)).sum() for k, part in enumerate(parts)).backward()
        results.append((parts, [leaf.grad for leaf in leaves]))
    for expected, found in zip(*results, strict=True):
        for a, b in zip(expected, found, strict=True):
            torch.testing.assert_close(b, a, atol=2e-5, rtol=1e-4)


def test_nearest_rotations():
    spread = draws(30, 3, 3, seed=4).double()
    spread[0] = torch.eye(3)
    found = rotations.quats_to_rotmats(rigidity._nearest_quats(spread))
    torch.testing.assert_close(found, rotations.nearest_rotmats(spread), atol=1e-9, rtol=0)


def test_representatives():
    rng = np.random.default_rng(5)
    means, labels = draws(200, 3), torch.from_numpy(rng.integers(-1, 6, 200))
    labels[labels == 4] = 1
    opacities = torch.from_numpy(rng.uniform(0, 1, 200))
    opacities[labels == 2] = 0.1  # none is opaque
    expected = rigidity.representatives(means, labels, opacities)
    assert torch.equal(rigidity._representatives_in_torch(means, labels, opacities, len(expected)), expected)


class OnDevice:
    """Scalar of a GPU."""

    device = torch.device("cuda")

    def __init__(self, value):
        self._value = value

    def double(self):
        return torch.tensor(self._value).double()


def test_the_running_loss_of_a_device_is_that_of_the_cpu():
    numbers, there = RunningLoss(), RunningLoss()
    for k in range(20):
        numbers.add(torch.tensor(0.1 + 0.01 * k))
        there.add(OnDevice(0.1 + 0.01 * k))
    assert isinstance(there._value, torch.Tensor)  # reading it would wait for the device
    assert numbers.value == there.value
