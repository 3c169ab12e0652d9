"""Densification: Gaussians with large gradients grow, within the cap, and unneeded ones are removed."""

import dataclasses
import re

import numpy as np
import pytest
import torch

from r5dgs_core.config import config as configs
from r5dgs_core.config.config import Config
from r5dgs_core.config.sections.densification import DensifyDefaultSection, DensifySection
from r5dgs_core.data import dataset as datasets
from r5dgs_core.errors import ConfigError
from r5dgs_core.model.gaussians import Gaussians
from r5dgs_core.raster import RasterStats
from r5dgs_core.train import checkpoint
from r5dgs_core.train.densification import densifier, gradient, registry
from r5dgs_core.train.trainer import Trainer
from tests.support import scenes, tiny_datasets

pytestmark = pytest.mark.heavy

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
    found = densifier.ScreenGradients(len(values))
    found.add(torch.as_tensor(values), torch.ones(len(values), dtype=torch.bool))
    return found


def conditions(cap=1000, seed=0, extent=1.0, eyes=(), iterations=1000):
    return densifier.Conditions(
        cap=cap,
        iterations=iterations,
        pixel_size=PIXEL,
        image_width=100.0,
        extent=extent,
        eyes=eyes,
        generator=torch.Generator().manual_seed(seed),
    )


def densify(gaussians, optimizer, found, cap=1000, section=SECTION, width_limit=10.0, seed=0):
    section = dataclasses.replace(section, prune_width=width_limit / (100 * PIXEL))
    strategy = gradient.TopGradientShare(section, conditions(cap, seed), len(gaussians))
    strategy.gradients = found
    strategy.round(gaussians, optimizer)


def adapt(gaussians, optimizer, found, cap=1000, seed=0, extent=1.0, sizes=False, **section):
    strategy = gradient.AdaptiveDensityControl(
        DensifyDefaultSection(**section), conditions(cap, seed, extent), len(gaussians)
    )
    strategy.gradients = found
    strategy.round(gaussians, optimizer, sizes=sizes)


def test_the_mean_counts_only_views_that_show_the_gaussian():
    found = densifier.ScreenGradients(3)
    found.add(torch.tensor([2.0, 5, 7]), torch.tensor([True, True, False]))
    found.add(torch.tensor([4.0, 5, 7]), torch.tensor([True, False, False]))
    assert found.mean().tolist() == [3, 5, 0]


def test_small_gaussians_with_the_largest_gradients_are_cloned():
    gaussians, optimizer = make()
    scores = torch.linspace(0.1, 1, 40)
    before = gaussians.means.detach().clone()
    densify(gaussians, optimizer, gradients(scores))
    assert len(gaussians) == 50
    torch.testing.assert_close(gaussians.means[:40].detach(), before)
    assert {tuple(row) for row in gaussians.means[40:].tolist()} == {tuple(row) for row in before[30:].tolist()}


def test_large_gaussians_are_split_into_two_smaller_ones_near_their_place():
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


@pytest.mark.parametrize("densify", [densify, adapt])
@pytest.mark.parametrize("size", [0.5 * PIXEL, 4 * PIXEL])
def test_children_belong_to_their_parents_motion_group(size, densify):
    gaussians, optimizer = make(size=size)
    gaussians.params["sh"].data[:, 0, 0] = gaussians.motion_ids.float()  # children inherit colours
    for seed in range(3):
        densify(gaussians, optimizer, gradients(torch.rand(len(gaussians)) + 0.1), seed=seed)
    assert len(gaussians) > 40
    assert gaussians.motion_ids.tolist() == gaussians.sh[:, 0, 0].tolist()


@pytest.mark.parametrize("size", [0.5 * PIXEL, 4 * PIXEL])
@pytest.mark.parametrize("cap", [40, 43, 60])
@pytest.mark.parametrize("densify", [densify, adapt])
def test_the_cap_holds_round_after_round(size, cap, densify):
    gaussians, optimizer = make(size=size)
    for seed in range(6):
        densify(gaussians, optimizer, gradients(torch.rand(len(gaussians)) + 0.1), cap=cap, seed=seed)
        assert len(gaussians) <= cap
    assert len(gaussians) == cap


def test_faint_and_oversized_gaussians_are_removed_and_without_gradients_nothing_grows():
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
    densify(gaussians, optimizer, densifier.ScreenGradients(0))
    assert len(gaussians) == 0


def test_the_same_draws_give_the_same_gaussians():
    results = []
    for _ in range(2):
        gaussians, optimizer = make(size=4 * PIXEL)
        densify(gaussians, optimizer, gradients(torch.linspace(0.1, 1, 40)), seed=5)
        results.append(gaussians.means.detach())
    assert torch.equal(*results)


def test_background_near_a_camera_that_no_other_camera_sees_is_removed():
    eyes = [scenes.orbit_camera(angle, 48, 36) for angle in (0.0, 1.5, 3.0)]
    before_first = torch.tensor(eyes[0].center + 0.5 * eyes[0].forward).float()
    middle = torch.tensor(eyes[0].center + np.linalg.norm(eyes[0].center) * eyes[0].forward).float()
    gaussians, _ = make(n=4)
    with torch.no_grad():
        gaussians.means.copy_(torch.stack([before_first, before_first, middle, -50 * before_first]))
    gaussians.motion_ids = torch.tensor([0, 1, 0, 0])  # the second belongs to a body
    assert densifier.floaters(gaussians, eyes, 1.0).tolist() == [True, False, False, False]
    assert densifier.seen_by_one_camera(gaussians, eyes).tolist() == [True, False, False, True]
    assert not densifier.floaters(gaussians, eyes, 0.0).any()
    assert not densifier.floaters(gaussians, eyes[:2], 1.0).any()  # no second opinion


def test_nothing_grows_under_the_gradient_of_the_configuration():
    gaussians, optimizer = make()
    densify(gaussians, optimizer, gradients(torch.full((40,), 0.9 * SECTION.gradient)))
    assert len(gaussians) == 40


def test_gaussians_that_no_image_needs_fade_and_are_removed():
    gaussians, optimizer = make(n=6)
    wanted = torch.arange(6) < 4
    strategy = gradient.TopGradientShare(SECTION, conditions(), 6)
    optimizer.param_groups[3]["lr"] = 0.05
    for iteration in range(1, 301):
        optimizer.zero_grad()
        image = (torch.sigmoid(gaussians.opacity_logits) - 0.7).abs() * wanted[: len(gaussians)]
        (image.sum() + strategy.penalty(gaussians)).backward()
        optimizer.step()
        strategy.after_step(gaussians, optimizer, iteration, 1e-3)
    assert len(gaussians) == 4
    torch.testing.assert_close(
        torch.sigmoid(gaussians.opacity_logits).detach(), torch.full((4,), 0.7), atol=0.03, rtol=0
    )
    kept = gradient.TopGradientShare(dataclasses.replace(SECTION, opacity=0.0), conditions(), 6)
    assert kept.penalty(gaussians) is None


def test_the_default_strategy_grows_all_that_reach_the_threshold_whatever_their_share():
    gaussians, optimizer = make()
    adapt(gaussians, optimizer, gradients(torch.where(torch.arange(40) < 30, 3e-4, 1e-4)))
    assert len(gaussians) == 70


def test_the_default_strategy_splits_by_the_extent_of_the_cameras():
    for extent, cloned in ((100.0, True), (1.0, False)):
        gaussians, optimizer = make(n=4, size=0.5)  # a hundredth of the first extent is 1, of the second 0.01
        adapt(gaussians, optimizer, gradients(torch.tensor([1.0, 0, 0, 0])), extent=extent)
        sizes = gaussians.log_scales.exp()[:, 0].tolist()
        expected = [0.5] * 5 if cloned else [0.5] * 3 + [0.5 / 1.6] * 2
        assert sizes == pytest.approx(expected)


def test_the_default_strategy_removes_large_gaussians_only_after_opacities_were_reset():
    for sizes, expected in ((False, 40), (True, 37)):
        gaussians, optimizer = make()
        with torch.no_grad():
            gaussians.log_scales[3, 1] = torch.tensor(0.11).log()
        found = gradients(torch.zeros(40))
        found.add(torch.zeros(40), torch.ones(40, dtype=torch.bool), torch.arange(40) - 17.0)  # two beyond 20 px
        adapt(gaussians, optimizer, found, sizes=sizes)
        assert len(gaussians) == expected


def test_a_reset_lowers_high_opacities_and_clears_their_moments():
    gaussians, optimizer = make(n=3)
    with torch.no_grad():
        gaussians.opacity_logits.copy_(torch.tensor([0.9, 0.5, 0.006]).logit())
    (gaussians.opacity_logits.sum() + gaussians.means.sum()).backward()
    optimizer.step()
    strategy = gradient.AdaptiveDensityControl(DensifyDefaultSection(), conditions(iterations=30000), 3)
    strategy.after_step(gaussians, optimizer, 2999, 1e-3)
    assert torch.sigmoid(gaussians.opacity_logits)[0] > 0.8
    strategy.gradients = gradients(torch.zeros(3))
    strategy.after_step(gaussians, optimizer, 3000, 1e-3)
    opacities = torch.sigmoid(gaussians.opacity_logits).detach()
    torch.testing.assert_close(opacities, torch.tensor([0.01, 0.01, 0.006]), atol=1e-4, rtol=0)
    assert not optimizer.state[gaussians.opacity_logits]["exp_avg"].any()
    assert optimizer.state[gaussians.means]["exp_avg"].all()


@pytest.mark.parametrize(("white", "expected"), [(False, [100, 200]), (True, [30, 100, 200])])
def test_opacities_are_reset_as_growth_begins_where_the_background_is_white(white, expected):
    section = DensifyDefaultSection(start=30, every=1000, reset_every=100)
    place = dataclasses.replace(conditions(iterations=500), white=white)
    gaussians, optimizer = make()
    strategy, found = gradient.AdaptiveDensityControl(section, place, 40), []
    for iteration in range(1, 501):
        with torch.no_grad():
            gaussians.opacity_logits.fill_(1.0)
        strategy.after_step(gaussians, optimizer, iteration, 1e-3)
        if torch.sigmoid(gaussians.opacity_logits).max() < 0.011:
            found.append(iteration)
    assert found == expected


def test_rounds_follow_the_schedule_of_the_section():
    section = DensifyDefaultSection(start=100, stop=0.5, every=50, reset_every=0)
    strategy = gradient.AdaptiveDensityControl(section, conditions(cap=10**6), 40)
    gaussians, optimizer = make()
    grew = []
    for iteration in range(1, 1001):
        strategy.gradients = gradients(torch.ones(len(gaussians)) * (torch.arange(len(gaussians)) < 1))
        before = len(gaussians)
        strategy.after_step(gaussians, optimizer, iteration, 1e-3)
        if len(gaussians) > before:
            grew.append(iteration)
    assert grew == list(range(150, 500, 50))


@pytest.mark.parametrize("name", ["share", "default", "mcmc"])
def test_a_strategy_restored_from_its_tensors_continues_identically(name):
    results = []
    for again in (False, True):
        place = conditions(cap=60, seed=3)
        config = Config().replace(**{"densify.strategy": name, "densify.start": 0, "densify_default.start": 50})
        gaussians, optimizer = make(size=4 * PIXEL)
        strategy = registry.make(config, place, 40)
        eye = scenes.orbit_camera(0.0, 48, 36)
        draws = torch.Generator().manual_seed(1)
        stats = RasterStats(torch.rand(40, generator=draws) > 0.3, torch.rand(40, generator=draws) * 9)
        stats.grad_norm = torch.rand(40, generator=draws)
        strategy.observe(stats, eye)
        if again:
            kept = {n: t.clone() for n, t in strategy.tensors().items()}
            strategy = registry.make(config, place, 40)
            strategy.restore(kept)
        strategy.after_step(gaussians, optimizer, 100, 1e-3)
        results.append((gaussians.means.detach(), strategy.tensors()))
    assert len(results[0][0]) > 40 or name == "mcmc"
    assert torch.equal(results[0][0], results[1][0])
    assert all(torch.equal(tensor, results[1][1][n]) for n, tensor in results[0][1].items())


def test_the_extent_is_that_of_the_cameras():
    eyes = [scenes.orbit_camera(angle, 48, 36) for angle in np.linspace(0, 2 * np.pi, 8, endpoint=False)]
    centers = np.stack([eye.center for eye in eyes])
    radius = np.linalg.norm(centers - centers.mean(0), axis=1).max()
    assert densifier.extent_of(eyes) == pytest.approx(1.1 * radius)
    assert densifier.extent_of(eyes[:1]) == 0.0


SETTINGS = {
    "share": [],
    "default": ["start=10", "every=10", "reset_every=25", "prune_extent=10.0"],
    "mcmc": ["start=10", "every=10"],
}


@pytest.mark.default_cases("share")
@pytest.mark.parametrize("name", SETTINGS)
def test_a_run_keeps_its_cap_and_resumes_to_the_same_bits(tiny, tmp_path, name):
    def begin():
        keys = [f"densify_{name}.{setting}" for setting in SETTINGS[name]]
        sets = ("train.iterations=60", f"densify.strategy={name}", "densify.max_gaussians=1100", *keys)
        return Trainer(datasets.read(tiny.root), tiny_datasets.settings(*sets))

    whole, sizes = begin(), set()
    while not whole.done:
        if whole.iteration == 35:
            checkpoint.save(tmp_path, whole.state())
        whole.step()
        sizes.add(len(whole.gaussians))
    assert len(sizes) > 1 and max(sizes) <= 1100
    again = begin()
    again.restore(checkpoint.load(tmp_path))
    while not again.done:
        again.step()
    expected, found = whole.state().tensors, again.state().tensors
    assert expected.keys() == found.keys()
    assert all(torch.equal(tensor, found[n]) for n, tensor in expected.items())


def test_harmonics_join_one_degree_at_a_time(tiny):
    sets = ("train.iterations=60", "train.sh_degree=2", "train.sh_every=4")
    trainer = Trainer(datasets.read(tiny.root), tiny_datasets.settings(*sets))
    trained = []
    for _ in range(10):
        trainer.step()
        trained.append(int(trainer.gaussians.sh_rest.detach().abs().amax((0, 2)).count_nonzero()))
    assert trained == [0] * 4 + [3] * 4 + [8] * 2


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("densify.strategy=mcmcc", "densify.strategy: expected share or default or mcmc, got 'mcmcc'"),
        ("densify_default.reset_opacity=1", "densify_default.reset_opacity: expected between 0 and 1, got 1.0"),
        ("densify_mcmc.noize=1", "densify_mcmc.noize: unknown key; did you mean 'noise'?"),
    ],
)
def test_thresholds_that_no_strategy_can_use_are_named(override, message):
    with pytest.raises(ConfigError, match=re.escape(message)):
        configs.load(None, [override])
