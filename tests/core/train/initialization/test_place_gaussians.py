"""A cap below the number of initial points keeps the same share of every group and covers the same surface."""

import math

import hypothesis
import numpy as np
import pytest
import torch
from hypothesis import strategies as st

from r5dgs_core.data import dataset as datasets
from r5dgs_core.model.gaussians import Gaussians
from r5dgs_core.train.initialization import place_gaussians
from r5dgs_core.train.trainer import Trainer
from tests.support import tiny_datasets


def gaussians(counts):
    """Gaussians of one group per count; the first coordinate of a mean is its row."""
    n = sum(counts)
    params = {
        "means": torch.arange(n).float()[:, None].repeat(1, 3),
        "quats": torch.ones(n, 4),
        "log_scales": torch.full((n, 3), -3.0),
        "opacity_logits": torch.zeros(n),
        "sh": torch.zeros(n, 1, 3),
        "sh_rest": torch.zeros(n, 0, 3),
        "shading": torch.zeros(n, 3),
    }
    return Gaussians(params, torch.repeat_interleave(torch.arange(len(counts)), torch.tensor(counts)))


@hypothesis.given(st.lists(st.integers(1, 300), min_size=1, max_size=5), st.integers(5, 800), st.integers(0, 9))
def test_every_group_keeps_its_share_under_the_cap(counts, cap, seed):
    before = gaussians(counts)
    after = place_gaussians.thin(before, cap, np.random.default_rng(seed))
    assert len(after) == min(cap, sum(counts))
    share = len(after) / len(before)
    left = torch.bincount(after.motion_ids, minlength=len(counts)).tolist()
    groups = len(counts)  # one of each comes first
    assert all(kept >= 1 and abs(kept - share * count) <= groups for kept, count in zip(left, counts, strict=True))
    rows = after.params["means"][:, 0].detach().long()
    assert (rows.diff() > 0).all() and torch.equal(after.motion_ids, before.motion_ids[rows])


@hypothesis.given(st.integers(1, 500), st.integers(1, 500))
def test_surfaces_stay_covered(count, cap):
    after = place_gaussians.thin(gaussians([count]), cap, np.random.default_rng(0))
    area = float((2 * after.log_scales[:, 0].detach()).exp().sum())
    assert area == pytest.approx(min(count * math.exp(-6.0), len(after) * place_gaussians.WIDEST**2), rel=1e-4)


def test_thinning_does_not_enlarge_wide_gaussians():
    before = gaussians([100])
    before.log_scales.data[:] = math.log(2 * place_gaussians.WIDEST)
    after = place_gaussians.thin(before, 10, np.random.default_rng(0))
    assert torch.equal(after.log_scales, before.log_scales[:10])


def test_few_gaussians_are_not_thinned_and_use_no_random_numbers():
    few, rng = gaussians([3, 4]), np.random.default_rng(1)
    assert place_gaussians.thin(few, 7, rng) is few
    assert rng.random() == np.random.default_rng(1).random()


@pytest.mark.parametrize("cap", [30, 200])
def test_a_cap_is_obeyed_from_the_first_step_on(tiny, cap):
    overrides = (f"densify.max_gaussians={cap}", "train.iterations=60", "densify.gradient=0", "densify.share=1")
    trainer = Trainer(datasets.read(tiny.root), tiny_datasets.settings(*overrides))
    counts = [len(trainer.gaussians)]
    assert counts == [cap]
    while not trainer.done:
        trainer.step()
        counts.append(len(trainer.gaussians))
    assert max(counts) <= cap and min(counts) > 0
