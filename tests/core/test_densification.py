"""Densification: grows where the image asks, within its cap, and removes what nobody sees."""

import numpy as np
import pytest
import torch

from r5dgs_core.model.gaussians import Gaussians
from r5dgs_core.train import densification
from r5dgs_core.train.config import DensifySection
from tests import scenes

PIXEL = 0.05
SECTION = DensifySection(share=0.25, split_pixels=1.0, prune_opacity=0.01)


def make(n=40, size=0.5 * PIXEL, seed=0):
    draws = torch.Generator().manual_seed(seed)
    params = {
        "means": torch.randn(n, 3, generator=draws),
        "quats": torch.randn(n, 4, generator=draws),
        "log_scales": torch.full((n, 3), size).log(),
        "opacity_logits": torch.ones(n),
        "sh": torch.randn(n, 1, 3, generator=draws),
    }
    gaussians = Gaussians(params, torch.arange(n) % 4)
    optimizer = torch.optim.Adam([{"params": [p], "name": k} for k, p in gaussians.params.items()])
    return gaussians, optimizer


def gradients(values):
    found = densification.ScreenGradients(len(values))
    found.add(torch.as_tensor(values), torch.ones(len(values), dtype=torch.bool))
    return found


def densify(gaussians, optimizer, found, cap=1000, section=SECTION, width_limit=10.0, seed=0):
    densification.densify(
        gaussians, optimizer, found, section, cap, PIXEL, width_limit, [], torch.Generator().manual_seed(seed)
    )


def test_the_mean_counts_only_views_that_show_the_gaussian():
    found = densification.ScreenGradients(3)
    found.add(torch.tensor([2.0, 5, 7]), torch.tensor([True, True, False]))
    found.add(torch.tensor([4.0, 5, 7]), torch.tensor([True, False, False]))
    assert found.mean().tolist() == [3, 5, 0]


def test_small_ones_with_the_largest_gradients_are_cloned():
    gaussians, optimizer = make()
    scores = torch.linspace(0.1, 1, 40)
    before = gaussians.means.detach().clone()
    densify(gaussians, optimizer, gradients(scores))
    assert len(gaussians) == 50
    torch.testing.assert_close(gaussians.means[:40].detach(), before)
    assert {tuple(row) for row in gaussians.means[40:].tolist()} == {tuple(row) for row in before[30:].tolist()}


def test_large_ones_become_two_smaller_ones_near_their_place():
    gaussians, optimizer = make(n=8, size=4 * PIXEL)
    parents, scale = gaussians.means.detach().clone(), 4 * PIXEL
    densify(gaussians, optimizer, gradients(torch.tensor([0.0, 1, 0, 0, 0, 2, 0, 0])))
    assert len(gaussians) == 10
    torch.testing.assert_close(gaussians.means[:6].detach(), parents[[0, 2, 3, 4, 6, 7]])
    children = gaussians.means[6:].detach()
    nearest = torch.cdist(children, parents[[1, 5]]).min(1)
    assert sorted(nearest.indices.tolist()) == [0, 0, 1, 1] and nearest.values.max() < 4 * scale
    assert (nearest.values > 0).all()
    torch.testing.assert_close(gaussians.log_scales[6:].exp(), torch.full((4, 3), scale / 1.6))


@pytest.mark.parametrize("size", [0.5 * PIXEL, 4 * PIXEL])
def test_children_belong_to_their_parents_motion_group(size):
    gaussians, optimizer = make(size=size)
    gaussians.params["sh"].data[:, 0, 0] = gaussians.motion_ids.float()  # children inherit colours
    for seed in range(3):
        densify(gaussians, optimizer, gradients(torch.rand(len(gaussians)) + 0.1), seed=seed)
    assert len(gaussians) > 40
    assert gaussians.motion_ids.tolist() == gaussians.sh[:, 0, 0].tolist()


@pytest.mark.parametrize("size", [0.5 * PIXEL, 4 * PIXEL])
@pytest.mark.parametrize("cap", [30, 40, 43, 60])
def test_the_cap_holds_round_after_round(size, cap):
    gaussians, optimizer = make(size=size)
    for seed in range(6):
        densify(gaussians, optimizer, gradients(torch.rand(len(gaussians)) + 0.1), cap=cap, seed=seed)
        assert len(gaussians) <= max(cap, 40)
    assert len(gaussians) == max(cap, 40)


def test_faint_and_oversized_ones_go_and_without_gradients_nothing_grows():
    gaussians, optimizer = make()
    with torch.no_grad():
        gaussians.opacity_logits[:5] = torch.tensor(0.009).logit()
        gaussians.opacity_logits[5:8] = torch.tensor(0.011).logit()
        gaussians.log_scales[10, 1] = torch.tensor(1.1).log()
    kept = gaussians.means[[*range(5, 10), *range(11, 40)]].detach().clone()
    densify(gaussians, optimizer, gradients(torch.zeros(40)), width_limit=1.0)
    torch.testing.assert_close(gaussians.means.detach(), kept)


def test_no_gaussians_at_all_are_no_error():
    gaussians, optimizer = make(n=0)
    densify(gaussians, optimizer, densification.ScreenGradients(0))
    assert len(gaussians) == 0


def test_the_same_draws_give_the_same_gaussians():
    results = []
    for _ in range(2):
        gaussians, optimizer = make(size=4 * PIXEL)
        densify(gaussians, optimizer, gradients(torch.linspace(0.1, 1, 40)), seed=5)
        results.append(gaussians.means.detach())
    assert torch.equal(*results)


def test_background_close_before_a_camera_that_no_other_sees_goes():
    eyes = [scenes.orbit_camera(angle, 48, 36) for angle in (0.0, 1.5, 3.0)]
    before_first = torch.tensor(eyes[0].center + 0.5 * eyes[0].forward).float()
    middle = torch.tensor(eyes[0].center + np.linalg.norm(eyes[0].center) * eyes[0].forward).float()
    gaussians, _ = make(n=4)
    with torch.no_grad():
        gaussians.means.copy_(torch.stack([before_first, before_first, middle, -50 * before_first]))
    gaussians.motion_ids = torch.tensor([0, 1, 0, 0])  # the second belongs to a body
    assert densification.floaters(gaussians, eyes, 1.0).tolist() == [True, False, False, False]
    assert not densification.floaters(gaussians, eyes[:2], 1.0).any()  # no second opinion


def test_nothing_grows_under_the_gradient_of_the_configuration():
    gaussians, optimizer = make()
    densify(gaussians, optimizer, gradients(torch.full((40,), 0.9 * SECTION.gradient)))
    assert len(gaussians) == 40
