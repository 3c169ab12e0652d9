"""The fused pass from canonical Gaussians to splats, against the same formulas in plain torch and float64."""

import pytest
import torch

from r5dgs_core.model.tracks import GroupPoses
from r5dgs_core.motion import rotations
from r5dgs_core.raster import thread_pool
from r5dgs_core.train.representations import fused_posing

NAMES = ("means", "quats", "log_scales", "logits", "colors", "shading", "light", "group_quats", "rotmats", "shifts")
OUTPUTS = ("means", "quats", "scales", "opacities", "colors")


def inputs(n, groups=4, seed=0):
    draws = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=draws)

    quats = rotations.normalize(normal(groups, 4))
    values = [normal(n, 3), 2 * normal(n, 4), normal(n, 3) - 2, 2 * normal(n), normal(n, 3) + 0.5, 0.7 * normal(n, 3)]
    values += [normal(3), quats, rotations.quats_to_rotmats(quats), normal(groups, 3)]
    ids = torch.randint(0, groups, (n,), generator=draws)
    return dict(zip(NAMES, values, strict=True)), ids, normal(groups, 3)


def fused(values, ids, centers):
    v = values
    poses = GroupPoses(v["group_quats"], v["rotmats"], v["shifts"])
    return fused_posing.pose(
        v["means"], v["quats"], v["log_scales"], v["logits"], v["colors"], v["shading"], v["light"], ids, poses, centers
    )  # fmt: skip


def plain(values, ids, centers):
    v = values
    rotmats, c = v["rotmats"][ids], centers[ids]
    means = (rotmats @ (v["means"] - c)[..., None])[..., 0] + c + v["shifts"][ids]
    quats = rotations.multiply(v["group_quats"][ids], v["quats"])
    change = (rotmats.transpose(1, 2) @ v["light"]) - v["light"]
    factor = (1 + (change * v["shading"]).sum(-1)).clamp(min=0)
    colors = v["colors"].clamp(min=0) * factor[:, None]
    return fused_posing.PosedSplats(means, quats, v["log_scales"].exp(), v["logits"].sigmoid(), colors)


def weighted_sum(splats, seed=9):
    draws = torch.Generator().manual_seed(seed)
    total = 0.0
    for name in OUTPUTS:
        value = getattr(splats, name)
        total = total + (value * torch.randn(value.shape, generator=draws).to(value.dtype)).sum()
    return total


@pytest.mark.parametrize("n", [1, 7, 300])
def test_values_and_every_gradient_are_those_of_plain_autograd(n):
    values, ids, centers = inputs(n)
    single = {k: v.clone().requires_grad_(True) for k, v in values.items()}
    double = {k: v.double().requires_grad_(True) for k, v in values.items()}
    ours, theirs = fused(single, ids, centers), plain(double, ids, centers.double())
    for name in OUTPUTS:
        torch.testing.assert_close(getattr(ours, name).double(), getattr(theirs, name), rtol=2e-5, atol=2e-5)
    weighted_sum(ours).backward()
    weighted_sum(theirs).backward()
    for name in NAMES:
        expected = double[name].grad
        scale = max(1.0, float(expected.abs().max()))
        torch.testing.assert_close(single[name].grad.double() / scale, expected / scale, rtol=0, atol=2e-6, msg=name)


def test_results_do_not_depend_on_the_number_of_threads():
    values, ids, centers = inputs(1000)
    before = thread_pool.threads()
    results = []
    try:
        for threads in (1, 2, 3, 8):
            thread_pool.set_threads(threads)
            leaves = {k: v.clone().requires_grad_(True) for k, v in values.items()}
            splats = fused(leaves, ids, centers)
            weighted_sum(splats).backward()
            results.append([getattr(splats, n).detach() for n in OUTPUTS] + [leaves[n].grad for n in NAMES])
    finally:
        thread_pool.set_threads(before)
    for other in results[1:]:
        for a, b in zip(results[0], other, strict=True):
            assert torch.equal(a, b)


def test_the_identity_pose_activates_and_moves_nothing():
    values, ids, centers = inputs(20)
    values["group_quats"] = torch.tensor([1.0, 0, 0, 0]).expand(4, 4)
    values["rotmats"] = torch.eye(3).expand(4, 3, 3)
    values["shifts"] = torch.zeros(4, 3)
    splats = fused(values, ids, centers)
    torch.testing.assert_close(splats.means, values["means"], rtol=0, atol=1e-6)
    torch.testing.assert_close(splats.quats, values["quats"], rtol=0, atol=0)
    torch.testing.assert_close(splats.colors, values["colors"].clamp(min=0), rtol=0, atol=0)


def test_no_gaussians_and_an_empty_group_are_fine():
    values, ids, centers = inputs(0)
    leaves = {k: v.clone().requires_grad_(True) for k, v in values.items()}
    splats = fused(leaves, ids, centers)
    assert splats.means.shape == (0, 3)
    weighted_sum(splats).backward()
    assert (leaves["rotmats"].grad == 0).all()
    values, _, centers = inputs(5)
    leaves = {k: v.clone().requires_grad_(True) for k, v in values.items()}
    weighted_sum(fused(leaves, torch.ones(5, dtype=torch.int64), centers)).backward()
    assert (leaves["shifts"].grad[[0, 2, 3]] == 0).all() and (leaves["shifts"].grad[1] != 0).all()
