"""Tracks of balls in rendered scenes, against their true rotations."""

import json

import numpy as np
import pytest

from r5dgs_core.config import config
from r5dgs_core.data import dataset as datasets
from r5dgs_core.motion import rotations
from r5dgs_core.train import run
from r5dgs_core.train.trainer import Trainer
from tests.support import benchmark_modules

BEHIND = 2  # the ball behind the screen


def turn_errors(trainer, folder):
    """Angles of the ball's track to its true rotations, but for a constant turn, degrees. [S]"""
    truth = json.loads((folder / "ground_truth.json").read_text())
    matrices = np.array(next(one["matrices"] for one in truth["objects"] if one["id"] == BEHIND))
    rows = [int(np.abs(np.array(truth["times"]) - t).argmin()) for t in trainer.times]
    true = rotations.rotmats_to_quats(matrices[rows, :3, :3])
    body = [int(trainer.object_ids[owner]) for owner in trainer.motion.tracks.owners].index(BEHIND)
    own = rotations.normalize(trainer.motion.tracks.knot_quats().detach().numpy()[body].astype(np.float64))
    off = rotations.multiply(rotations.conjugate(true), own)
    every = np.degrees(rotations.angle_between(off[:, None], off[None]))
    return every[np.median(every, axis=1).argmin()]


@pytest.mark.slow
def test_a_ball_that_passes_behind_a_screen_keeps_its_rotation(tmp_path, monkeypatch):
    with benchmark_modules.importing(monkeypatch) as load:
        load("futures.rendered_scenes").write(tmp_path, "hidden", 41)
        settings = config.load(None, [*load("futures.rendered").SETTINGS, "train.repair=true"])
    trainer = Trainer(datasets.read(tmp_path), settings)
    while trainer.iteration < 302:
        run.take_step(trainer, None, lambda event: None)
    errors = turn_errors(trainer, tmp_path)  # up to 71 degrees before the alignment
    assert np.median(errors) < 3 and errors.max() < 8
