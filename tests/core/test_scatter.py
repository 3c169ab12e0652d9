"""Points at random where cameras look."""

from __future__ import annotations

import numpy as np
import pytest

from r5dgs_core.data import dataset as datasets
from r5dgs_core.errors import ConfigError
from r5dgs_core.scene import cameras
from r5dgs_core.train import config, scatter, sweep
from r5dgs_core.train.trainer import Trainer
from tests import datasets as tiny_datasets

RANDOM = (
    "train.representation='field'",
    "field.movers='all'",
    "init.placement='random'",
    "init.background_points=300",
    "train.iterations=4",
)


def test_every_point_is_seen_by_two_cameras(tiny):
    trainer = Trainer(datasets.read(tiny.root), tiny_datasets.settings(*RANDOM))
    scenes = sweep.backdrops(trainer.views)
    points, colors = scatter.everywhere(scenes, 200, np.random.default_rng(0))
    assert points.shape == colors.shape == (200, 3)
    assert colors.min() >= 0 and colors.max() <= 1
    seen = 0
    for scene in scenes:
        pixels, depth = cameras.project(scene.camera, points)
        size = [scene.camera.width, scene.camera.height]
        seen = seen + ((pixels > 0).all(1) & (pixels < size).all(1) & (depth > 0))
    assert seen.min() >= 2


def test_a_run_may_start_from_points_at_random_without_the_masks_help(tiny):
    trainer = Trainer(datasets.read(tiny.root), tiny_datasets.settings(*RANDOM))
    assert len(trainer.gaussians) == 300 and (trainer.gaussians.motion_ids == 0).all()
    while not trainer.done:
        trainer.step()


def test_tracks_do_not_start_from_points_at_random():
    with pytest.raises(ConfigError, match="init.placement"):
        config.load(None, ["init.placement='random'"])
