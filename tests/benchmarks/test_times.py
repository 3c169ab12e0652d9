"""The benchmark of held-out times: which times leave, what stays of the data, and what its rows compare."""

import numpy as np
import pytest

from r5dgs_core.data import dataset as datasets
from tests.support import benchmark_modules, tiny_datasets


@pytest.fixture
def held_out_times(monkeypatch):
    """The benchmark as a module."""
    with benchmark_modules.importing(monkeypatch) as load:
        yield load("held_out_times")


@pytest.mark.parametrize("count", [1, 2, 3, 15])
@pytest.mark.parametrize("offset", [0, 1, 2])
def test_times_are_kept_or_held_out_and_both_ends_are_kept(held_out_times, count, offset):
    times = [k / 10 for k in range(count)] * 2
    removed, others = (held_out_times.held_out(times, 3, offset, sparse) for sparse in (False, True))
    inner = sorted(set(times))[1:-1]
    assert sorted(removed + others) == inner and not set(removed) & set(others)
    if count == 15:
        assert abs(len(removed) - len(inner) / 3) <= 1


def test_the_copy_lacks_the_frames_of_those_times_and_nothing_else(held_out_times, tiny, tmp_path):
    removed = held_out_times.held_out(tiny_datasets.OBSERVED, 3, 1)
    copy, whole = datasets.read(held_out_times.derive(tiny.root, removed, tmp_path)), datasets.read(tiny.root)
    assert [v.name for v in copy.train] == [v.name for v in whole.train if not np.isclose(v.t, removed).any()]
    assert len(copy.train) < len(whole.train) and copy.val and len(copy.val) == len(whole.val)
    assert all(v.mask_path is not None for v in copy.train)


def test_data_without_camera_files_are_named(held_out_times, tmp_path):
    (tmp_path / "data" / "sparse").mkdir(parents=True)
    with pytest.raises(SystemExit, match=r"transforms_train\.json: expected the camera file .* found none; .*COLMAP"):
        held_out_times.derive(tmp_path / "data", [0.5], tmp_path / "copy")
    assert not (tmp_path / "copy").exists()


@pytest.mark.parametrize("variant", ["tracks", "field"])
def test_steps_are_timed_on_all_observed_times(monkeypatch, tiny, variant):
    with benchmark_modules.importing(monkeypatch) as load:
        step = load("step")
        settings = step.settings(step.VARIANTS[variant], 12000).override(tiny_datasets.SETTINGS)
        run = step.trainer.Trainer(datasets.read(tiny.root), settings)
        run.step()
        assert run.entered == (0, len(tiny_datasets.OBSERVED) - 1)


def test_rows_compare_the_same_scene_at_observed_and_at_held_out_times(held_out_times, tiny, baked):
    removed = held_out_times.held_out(tiny_datasets.OBSERVED, 3, 1)
    rows = held_out_times.measure(baked, datasets.read(tiny.root), removed)
    found = {(row["cameras"], row["times"]): row for row in rows}
    assert {key: row["images"] for key, row in found.items()} == {
        ("val", "held out"): 2,
        ("train", "observed"): 24,
        ("train", "held out"): 12,
    }
    # This scene was trained on all of them, so that neither kind of time is worse.
    assert found["train", "held out"]["psnr"] == pytest.approx(found["train", "observed"]["psnr"], abs=1.0)
