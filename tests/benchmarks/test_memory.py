"""The benchmark of training's memory draws a data set that can be trained, and has a row for each phase."""

import sys

import numpy as np
import pytest

from r5dgs_core.data import dataset as datasets
from tests.support import benchmark_modules, tiny_datasets


@pytest.fixture
def memory(monkeypatch):
    with benchmark_modules.importing(monkeypatch) as load:
        yield load("memory")


@pytest.fixture
def data(memory, tmp_path):
    memory.make_dataset(tmp_path / "data", 48, 5, 3, 2)
    return tmp_path / "data"


def test_the_drawn_balls_are_where_their_masks_say(memory):
    camera = np.eye(4)
    camera[:3, 3] = 0, 0, 6  # looks straight down
    colors, ids = memory.ray_cast(camera, 0.5 * memory.T_MAX, 64, 2)
    focal = 32 / np.tan(0.5 * memory.ANGLE_X)
    for k, side in ((1, -1.1), (2, 1.1)):
        rows, columns = np.nonzero(ids == k)
        assert columns.mean() + 0.5 - 32 == pytest.approx(focal * side / (6 - 0.35), abs=1)
        assert rows.mean() + 0.5 == pytest.approx(32, abs=1)
    assert colors.min() >= 0 and colors.max() <= 1 and colors.std() > 0.05


def test_the_data_set_is_one_and_moves(memory, data):
    found = datasets.read(data)
    assert (len(found.train), len(found.val), len(found.times)) == (15, 2, 3)
    first, last = (datasets.load_mask(found.train[k]) for k in (0, 10))
    assert set(np.unique(first)) <= {0, 1, 2} and (first != last).any()


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells a process its largest memory")
def test_every_phase_has_its_memory(memory, data, tmp_path, capsys):
    small = [*tiny_datasets.SETTINGS[:4], "init.object_points=40", "init.background_points=200"]
    rows = memory.measure(data, tmp_path, 500, 3, small)
    assert [row["phase"] for row in rows][2:] == [
        "images and placing, first step",
        "growth",
        "steps, probe and checkpoint",
        "labels, first step of identities",
        "identities and last checkpoint",
        "bake",
    ]
    assert all(row["peak_mb"] > 50 and row["cpu_s"] >= 0 for row in rows)
    assert 0 < rows[3]["gaussians"] <= 500 and "checkpoint" in capsys.readouterr().out
