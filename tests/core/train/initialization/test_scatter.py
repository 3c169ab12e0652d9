"""Random points in the view of the cameras."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.spatial import KDTree

from r5dgs_core.config import config
from r5dgs_core.data import dataset as datasets
from r5dgs_core.errors import ConfigError
from r5dgs_core.scene import cameras
from r5dgs_core.train.initialization import background_images, plane_sweep, scatter
from r5dgs_core.train.trainer import Trainer
from tests.support import tiny_datasets

RANDOM = (
    "train.representation='field'",
    "field.movers='all'",
    "init.placement='random'",
    "init.background_points=300",
    "train.iterations=4",
    "field.place_steps=5",
    "field.trd_steps=5",
)


def test_every_point_is_seen_by_two_cameras(tiny):
    trainer = Trainer(datasets.read(tiny.root), tiny_datasets.settings(*RANDOM))
    scenes = background_images.compute(trainer.views)
    points, colors = scatter.random_points(scenes, 200, np.random.default_rng(0))
    assert points.shape == colors.shape == (200, 3)
    assert colors.min() >= 0 and colors.max() <= 1
    seen = 0
    for scene in scenes:
        pixels, depth = cameras.project(scene.camera, points)
        size = [scene.camera.width, scene.camera.height]
        seen = seen + ((pixels > 0).all(1) & (pixels < size).all(1) & (depth > 0))
    assert seen.min() >= 2


def test_a_run_may_start_from_random_points_without_masks(tiny):
    trainer = Trainer(datasets.read(tiny.root), tiny_datasets.settings(*RANDOM))
    assert len(trainer.gaussians) == 300 and (trainer.gaussians.motion_ids == 0).all()
    while not trainer.done:
        trainer.step()


def test_tracks_do_not_start_from_random_points():
    with pytest.raises(ConfigError, match="init.placement"):
        config.load(None, ["init.placement='random'"])


def test_points_of_a_reconstruction_outside_objects_become_background(tiny):
    trainer = Trainer(datasets.read(tiny.root), tiny_datasets.settings("train.iterations=4"))
    rng = np.random.default_rng(0)
    floor = np.concatenate([rng.uniform(-0.2, 0.2, (50, 2)) + [1.4, 1.4], np.zeros((50, 1))], 1)
    brick = tiny.center(tiny_datasets.BRICK, 0.3) + rng.normal(size=(50, 3)) * 0.03
    world = np.concatenate([floor, brick])
    points = (world - trainer.normalization.origin) / trainer.normalization.scale
    then = [view for view in trainer.views if abs(view.t - 0.3) < 1e-6]
    kept, colors = scatter.behind_objects(points, np.tile([0.2, 0.4, 0.6], (100, 1)), then, 1000, rng)
    assert len(kept) == len(colors) >= 10  # the ball hides some of the floor
    assert np.linalg.norm(kept[:, None] - points[None, 50:], axis=-1).min() > 0.05
    fewer, _ = scatter.behind_objects(points, points, then, 10, rng)
    assert len(fewer) == 10


def test_a_data_set_with_a_reconstruction_starts_from_its_points(tiny):
    data = datasets.read(tiny.root)
    points = np.random.default_rng(1).uniform(-1, 1, (80, 3)) * [1.5, 1.5, 0.01]
    known = dataclasses.replace(data, points=points, point_colors=np.full((80, 3), 0.25))
    trainer = Trainer(known, tiny_datasets.settings("train.iterations=4"))
    means = trainer.normalization.points_to_world(trainer.gaussians.means.detach().numpy())
    nearest = np.linalg.norm(means[:, None] - points[None], axis=-1).min(0)
    assert (nearest < 1e-4).mean() > 0.4  # masks cover the others


@pytest.mark.parametrize("cap", [0, 900])
def test_a_large_reconstruction_is_thinned_only_to_the_cap(tiny, cap, monkeypatch):
    data, sweep, swept = datasets.read(tiny.root), plane_sweep.Sweep, []
    monkeypatch.setattr(plane_sweep, "Sweep", lambda *given: swept.append(given[1]) or sweep(*given))
    points = np.random.default_rng(1).uniform(-1, 1, (9000, 3)) * [1.5, 1.5, 0.01]
    known = dataclasses.replace(data, points=points, point_colors=np.full((9000, 3), 0.25))
    settings = ("train.iterations=4", "init.background_points=9000", f"densify.max_gaussians={cap}")
    trainer = Trainer(known, tiny_datasets.settings(*settings))
    groups = trainer.gaussians.motion_ids.numpy()
    assert swept == [5000] * len(swept)  # it takes long, and places none of them
    if cap:
        assert len(groups) == cap > (groups == 0).sum()
        return
    normalised = (points - trainer.normalization.origin) / trainer.normalization.scale
    free = scatter.behind_objects(normalised, points, trainer.views, 9000, np.random.default_rng(0))[0]
    assert trainer._conditions.cap == len(groups) > len(free) > 4000
    near = KDTree(trainer.gaussians.means[groups == 0].detach().numpy()).query(free)[0]
    assert near.max() < 1e-5
    solid = groups <= 2  # the others are shadows, which are flat
    means, sizes = (trainer.gaussians.params[name].detach().numpy()[solid] for name in ("means", "log_scales"))
    spacing = KDTree(means).query(means, k=4)[0][:, 1:].mean(1)
    np.testing.assert_allclose(np.exp(sizes[:, 0]), np.clip(spacing, 0.005, 0.2), rtol=1e-3)
