"""The optimizer's state of each row follows Gaussians that are added and removed."""

import pytest
import torch

from r5dgs_core.model.gaussians import Gaussians

SHAPES = {"means": (3,), "quats": (4,), "log_scales": (3,), "opacity_logits": (), "sh": (1, 3), "sh_rest": (0, 3)}


def make(n, seed=0):
    draws = torch.Generator().manual_seed(seed)
    params = {name: torch.randn(n, *shape, generator=draws) for name, shape in SHAPES.items()}
    return Gaussians(params, torch.arange(n) % 3)


def adam(gaussians):
    return torch.optim.Adam([{"params": [p], "name": n} for n, p in gaussians.params.items()], lr=0.1)


def step(gaussians, optimizer, gradients):
    for name, p in gaussians.params.items():
        p.grad = gradients[name].clone()
    optimizer.step()


def gradients(n, seed):
    draws = torch.Generator().manual_seed(seed)
    return {name: torch.randn(n, *shape, generator=draws) for name, shape in SHAPES.items()}


def moments(gaussians, optimizer, name):
    state = optimizer.state[gaussians.params[name]]
    return state["exp_avg"], state["exp_avg_sq"]


def test_keeping_rows_and_optimizing_are_interchangeable():
    mask = torch.tensor([True, False, True, True, False, False, True])
    late, early = make(7), make(7)
    late_adam, early_adam = adam(late), adam(early)
    early.keep(early_adam, mask)
    for k in range(6):
        grads = gradients(7, k)
        if k == 3:
            late.keep(late_adam, mask)
        step(late, late_adam, grads if k < 3 else {n: g[mask] for n, g in grads.items()})
        step(early, early_adam, {n: g[mask] for n, g in grads.items()})
    for name in SHAPES:
        torch.testing.assert_close(late.params[name], early.params[name], rtol=1e-6, atol=1e-6)
    assert late.motion_ids.tolist() == early.motion_ids.tolist() == [0, 2, 0, 0]


def test_new_rows_start_without_moments_and_old_ones_keep_theirs():
    gaussians = make(4)
    optimizer = adam(gaussians)
    step(gaussians, optimizer, gradients(4, 1))
    before = {n: [m.clone() for m in moments(gaussians, optimizer, n)] for n in SHAPES}
    old = {n: p.detach().clone() for n, p in gaussians.params.items()}
    new = make(2, seed=5)
    gaussians.extend(optimizer, new.params, new.motion_ids + 1)
    assert len(gaussians) == 6 and gaussians.motion_ids.tolist() == [0, 1, 2, 0, 1, 2]
    for name in SHAPES:
        torch.testing.assert_close(gaussians.params[name].detach(), torch.cat([old[name], new.params[name].detach()]))
        for now, then in zip(moments(gaussians, optimizer, name), before[name], strict=True):
            torch.testing.assert_close(now[:4], then, rtol=0, atol=0)
            assert (now[4:] == 0).all()


def test_the_optimizer_updates_the_current_tensors_after_every_change():
    gaussians = make(5)
    optimizer = adam(gaussians)
    gaussians.extend(optimizer, make(3, seed=2).params, torch.tensor([1, 1, 2]))
    gaussians.keep(optimizer, torch.arange(8) != 6)
    held = {id(p) for p in gaussians.params.values()}
    assert {id(p) for group in optimizer.param_groups for p in group["params"]} == held
    before = gaussians.means.detach().clone()
    step(gaussians, optimizer, gradients(7, 3))
    assert (gaussians.means != before).all()


def test_all_rows_may_be_replaced():
    gaussians = make(3)
    optimizer = adam(gaussians)
    gaussians.keep(optimizer, torch.zeros(3, dtype=torch.bool))
    assert len(gaussians) == 0 and gaussians.means.shape == (0, 3)
    gaussians.extend(optimizer, make(2).params, torch.tensor([0, 1]))
    step(gaussians, optimizer, gradients(2, 0))
    assert torch.isfinite(gaussians.means).all()


def test_unknown_names_and_different_lengths_are_refused():
    with pytest.raises(ValueError, match="unknown parameter 'mean'"):
        Gaussians({"mean": torch.zeros(2, 3)}, torch.zeros(2, dtype=torch.int64))
    with pytest.raises(ValueError, match="'means' has 3 rows, motion_ids has 2"):
        Gaussians({"means": torch.zeros(3, 3)}, torch.zeros(2, dtype=torch.int64))
    with pytest.raises(AttributeError, match="shading"):
        _ = make(2).shading
