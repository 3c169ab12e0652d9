"""Densification as a Markov chain: division keeps the picture, dead Gaussians are relocated, and noise explores."""

import numpy as np
import pytest
import torch

from r5dgs_core.config.sections.densification import DensifyMcmcSection
from r5dgs_core.model.gaussians import Gaussians
from r5dgs_core.train.densification import mcmc
from tests.core.train.densification.test_densifier import conditions, make

SECTION = DensifyMcmcSection()


def strategy(cap=1000, seed=0, **section):
    return mcmc.MCMC(DensifyMcmcSection(**section), conditions(cap, seed))


def with_opacities(values, seed=0):
    gaussians, optimizer = make(len(values), seed=seed)
    with torch.no_grad():
        gaussians.opacity_logits.copy_(torch.logit(torch.as_tensor(values, dtype=torch.float32)))
    return gaussians, optimizer


@pytest.mark.parametrize("opacity", [0.01, 0.3, 0.9, 0.999])
@pytest.mark.parametrize("count", [1, 2, 3, 10, 51])
def test_equal_parts_cover_the_same_as_the_whole(opacity, count):
    each, factor = mcmc.divided(torch.tensor([opacity], dtype=torch.float64), torch.tensor([count]))
    assert 1 - (1 - float(each)) ** count == pytest.approx(opacity, rel=1e-9)
    x = np.linspace(-40, 40, 200001)
    whole = opacity * np.exp(-0.5 * x**2)
    parts = 1 - (1 - float(each) * np.exp(-0.5 * (x / float(factor)) ** 2)) ** count
    assert np.trapezoid(parts, x) == pytest.approx(np.trapezoid(whole, x), rel=1e-6)


def test_rows_are_divided_by_their_own_counts():
    opacities, counts = torch.tensor([0.5, 0.5, 0.8]), torch.tensor([1, 4, 2])
    together = mcmc.divided(opacities, counts)
    for row in range(3):
        alone = mcmc.divided(opacities[row : row + 1], counts[row : row + 1])
        torch.testing.assert_close([t[row] for t in together], [t[0] for t in alone])
    assert together[0][0] == pytest.approx(0.5) and together[1][0] == pytest.approx(1.0)


def test_dead_gaussians_are_relocated_onto_live_ones():
    gaussians, optimizer = with_opacities([0.9, 0.001, 0.004, 0.5, 0.003])
    (gaussians.means.sum() + gaussians.opacity_logits.sum()).backward()
    optimizer.step()
    means, ids = gaussians.means.detach().clone(), gaussians.motion_ids.clone()
    strategy().relocate(gaussians, optimizer)
    opacities = torch.sigmoid(gaussians.opacity_logits).detach()
    assert len(gaussians) == 5 and (opacities > SECTION.dead_opacity).all()
    assert torch.equal(gaussians.means[[0, 3]].detach(), means[[0, 3]])
    for row in (1, 2, 4):
        source = next(k for k in (0, 3) if torch.equal(gaussians.means[row], gaussians.means[k]))
        assert gaussians.motion_ids[row] == ids[source]
        for tensor in gaussians.params.values():
            assert torch.equal(tensor[row], tensor[source])
        assert not optimizer.state[gaussians.means]["exp_avg"][[row, source]].any()
    for source, before in ((0, 0.9), (3, 0.5)):  # together they cover what the one covered
        same = (gaussians.means == gaussians.means[source]).all(1)
        assert 1 - float((1 - opacities[same]).prod()) == pytest.approx(before, abs=1e-3)


def test_opaque_gaussians_are_drawn_more_often():
    gaussians, optimizer = with_opacities([0.9] + [0.001] * 3000 + [0.1])
    source = strategy()._draw(torch.tensor([0.9, 0.0, 0.1, 0.0]), 4000)
    assert set(source.tolist()) == {0, 2}
    assert (source == 0).float().mean() == pytest.approx(0.9, abs=0.02)


def test_growth_is_a_share_up_to_the_cap_and_inherits_groups():
    gaussians, optimizer = make(100)
    gaussians.params["sh"].data[:, 0, 0] = gaussians.motion_ids.float()
    chain = strategy(cap=112)
    sizes = []
    for _ in range(4):
        chain.add(gaussians, optimizer)
        sizes.append(len(gaussians))
    assert sizes == [105, 110, 112, 112]
    assert gaussians.motion_ids.tolist() == gaussians.sh[:, 0, 0].tolist()


def test_all_dead_or_no_gaussians_are_no_error():
    gaussians, optimizer = with_opacities([0.001, 0.002])
    before = gaussians.means.detach().clone()
    strategy().relocate(gaussians, optimizer)
    assert torch.equal(gaussians.means, before)
    empty, optimizer = make(0)
    chain = strategy()
    chain.after_step(empty, optimizer, 600, 1e-3)
    assert len(empty) == 0 and chain.penalty(empty) is None


def test_noise_has_the_shape_of_the_gaussian_and_spares_opaque_gaussians():
    n = 4000
    turn = torch.tensor([0.8, 0.0, 0.0, 0.6]).repeat(n, 1)  # about z, 73.7 degrees
    logits = torch.logit(torch.cat([torch.full((n - 1,), 0.001), torch.tensor([0.9])]))
    params = {
        "means": torch.zeros(n, 3),
        "quats": turn,
        "log_scales": torch.tensor([2.0, 1.0, 0.5]).log().repeat(n, 1),
        "opacity_logits": logits,
    }
    gaussians = Gaussians(params, torch.zeros(n, dtype=torch.int64))
    strategy().shake(gaussians, 0.1)
    moved = gaussians.means.detach().double()
    assert moved[-1].abs().max() < 1e-12 * 4 + 1e-9
    c, s = 0.28, 0.96
    axes = torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]], dtype=torch.float64)
    covariance = axes @ torch.diag(torch.tensor([4.0, 1.0, 0.25], dtype=torch.float64)) @ axes.T
    gate = 1 / (1 + np.exp(-100 * (0.005 - 0.001)))
    expected = (0.1 * gate) ** 2 * covariance @ covariance
    found = moved[:-1].T @ moved[:-1] / (n - 1)
    torch.testing.assert_close(found, expected, atol=0.08 * float(expected.max()), rtol=0)


def test_the_penalty_lets_opacity_and_size_fall_and_nothing_else():
    gaussians, _ = make(10)
    strategy(opacity=0.3, scale=0.2).penalty(gaussians).backward()
    assert (gaussians.opacity_logits.grad > 0).all() and (gaussians.log_scales.grad > 0).all()
    assert gaussians.means.grad is None and gaussians.quats.grad is None
    o, s = torch.sigmoid(gaussians.opacity_logits), gaussians.log_scales.exp()
    torch.testing.assert_close(gaussians.opacity_logits.grad, (0.3 * o * (1 - o) / 10).detach())
    torch.testing.assert_close(gaussians.log_scales.grad, (0.2 * s / 30).detach())
