"""Held-out cameras are moved into the world of the reconstructed cameras."""

import numpy as np
from scipy.spatial.transform import Rotation

from r5dgs_core.scene import cameras
from tests.support import benchmark_modules, tiny_datasets


def test_a_similarity_of_the_world_keeps_the_pictures(monkeypatch):
    with benchmark_modules.importing(monkeypatch) as load:
        similarity = load("cameras.uncalibrated").Similarity
    true = [tiny_datasets.orbit_camera(angle, 96, 72) for angle in (0.0, 0.5, 1.3)]
    turn, scale, shift = Rotation.from_rotvec([0.4, -1.1, 2.0]).as_matrix(), 3.0, np.array([5.0, -2.0, 0.5])
    known = similarity(turn, scale, shift)
    found = similarity.of(true, [known.camera(camera) for camera in true])
    np.testing.assert_allclose(found.turn, turn, atol=1e-9)
    np.testing.assert_allclose([found.scale, *found.shift], [scale, *shift], atol=1e-9)
    points = np.random.default_rng(0).normal(size=(20, 3)) * 0.2
    held_out = tiny_datasets.orbit_camera(0.9, 96, 72)
    moved = cameras.project(found.camera(held_out), scale * points @ turn.T + shift)[0]
    np.testing.assert_allclose(moved, cameras.project(held_out, points)[0], atol=1e-6)
