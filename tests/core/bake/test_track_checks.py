"""A fault in one track is reported and leaves the other tracks as they are."""

from __future__ import annotations

import logging

import numpy as np
import pytest

from r5dgs_core.bake import bake, track_checks
from r5dgs_core.data import dataset as datasets
from r5dgs_core.motion import rotations
from r5dgs_core.scene import validation
from r5dgs_core.train import checkpoint, run_folder
from tests.support import tiny_datasets

pytestmark = pytest.mark.heavy

TIMES = np.array([0.0, 0.25, 0.5, 0.75])


@pytest.mark.parametrize(("name", "bad"), [("translations", float("nan")), ("base_quats", float("inf"))])
def test_a_bad_track_is_held_in_place_and_the_others_keep_their_bits(trained, kept, tmp_path, caplog, name, bad):
    state = checkpoint.load(trained.folder)
    state.tensors[f"tracks.{name}"] = state.tensors[f"tracks.{name}"].clone()
    state.tensors[f"tracks.{name}"][2, 3] = bad
    trained = tiny_datasets.as_trained(trained)
    made = run_folder.create_run(tmp_path, datasets.read(trained.dataset_root), trained.config)
    checkpoint.save(tmp_path, state)
    with caplog.at_level(logging.WARNING):
        scene = bake.bake(made)
    validation.check(scene, "scene")
    assert scene.groups[2].role == "body"
    assert scene.groups[2].model.is_static
    assert "ball" in caplog.text and "not finite" in caplog.text
    for group, healthy in zip(scene.groups, kept.groups, strict=True):
        if group.object_id == 2:
            continue
        assert group.model.kind == healthy.model.kind  # its noise is measured in images, where the other one has gone
        np.testing.assert_allclose(group.model.velocity, healthy.model.velocity, atol=0.01)
        np.testing.assert_array_equal(scene.tracks.poses[group.id], kept.tracks.poses[group.id])
        mine, theirs = scene.gaussians.motion_ids == group.id, kept.gaussians.motion_ids == group.id
        np.testing.assert_array_equal(scene.gaussians.means[mine], kept.gaussians.means[theirs])


@pytest.mark.parametrize(("degrees", "told"), [(100, False), (150, True)])
def test_large_steps_are_logged_once_with_name_angle_and_times(degrees, told, caplog):
    turns = np.radians(degrees) * np.array([0.0, 0.1, 1.1, 1.2])[:, None] * [0, 0, 1.0]
    track = np.concatenate([rotations.rotvecs_to_quats(turns), np.zeros((4, 3))], axis=1)
    with caplog.at_level(logging.WARNING):
        track_checks.warn_of_aliasing("the fan", TIMES, track)
    assert len(caplog.records) == told
    if told:
        for part in ("the fan", "150 degrees", "0.25", "0.5", "Remedy"):
            assert part in caplog.text
