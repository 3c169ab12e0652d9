"""The comparison of pictures of stock viewers, and its scenes."""

import numpy as np
import pytest

from r5dgs_core.playback.scene_player import Player
from r5dgs_core.scene import validation
from tests.support import benchmark_modules, scenes


@pytest.fixture
def load(monkeypatch):
    with benchmark_modules.importing(monkeypatch) as load:
        yield load


def test_the_displacement_of_a_shifted_picture_is_its_shift(load):
    viewers = load("viewers.__main__")
    x, y = np.meshgrid(np.arange(64.0), np.arange(64.0))

    def blob(dx, dy):
        return np.repeat(np.exp(-((x - 31 - dx) ** 2 + (y - 33 - dy) ** 2) / 200)[..., None], 3, axis=-1)

    assert viewers.displacement(blob(0, 0), blob(0.3, -0.4)) == pytest.approx(0.5, abs=0.02)


@pytest.mark.parametrize("name", ["demo", "harmonics", "interpenetrating", "impact", "large"])
def test_cases_are_valid_scenes(load, name):
    scene = scenes.make_scene(n=100, objects=3, identities=False)
    made = load("viewers.cases").CASES[name](scene)
    validation.check(made, name)
    assert len(made.gaussians.means) == 100 * (24 if name == "large" else 1)
    Player(made).frame(1.0)


def test_the_motion_reverses_at_the_impact(load):
    cases, scene = load("viewers.cases"), scenes.make_scene(n=100, objects=3)
    made = cases.impact(scene)
    group = cases._bodies(scene)[0]
    speeds = np.diff(made.tracks.poses[group, :, 4:], axis=0) / np.diff(made.tracks.times)[:, None]
    np.testing.assert_allclose(speeds[0], -speeds[-1], atol=1e-9)
    assert np.linalg.norm(speeds[0]) > 0.1
