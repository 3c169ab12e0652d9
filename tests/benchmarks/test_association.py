"""The benchmark of association: what it spoils, what it measures, and that its rows say so."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from tests.support import benchmark_modules


@pytest.fixture
def load(monkeypatch):
    """Import of the benchmark's modules by name."""
    with benchmark_modules.importing(monkeypatch) as load:
        yield load


@pytest.fixture
def plan(load):
    """A small scene."""
    return load("association_scenes").Plan(bodies=3, gaussians=900, floor=20, views=2, times=4, pixels=48, pairs=1)


def test_truth_is_of_exact_places_whatever_the_error(load, plan):
    scenes = load("association_scenes")
    scene = scenes.make(plan, 1)
    exact, off = (list(scenes.observe(scene, error, "drift", 5)) for error in (0.0, 2.0))
    for a, b in zip(exact, off, strict=True):
        np.testing.assert_array_equal(a.truth, b.truth)
        assert (a.indices != b.indices).any()
        assert (np.diff(a.weights, axis=1) <= 0).all() and (a.weights.sum(axis=1) <= 1 + 1e-6).all()


def test_errors_are_as_large_as_they_are_called(load, plan):
    scenes = load("association_scenes")
    scene = scenes.make(replace(plan, gaussians=9000), 1)
    moved = scenes.displaced(scene, 2.0, "drift", np.random.default_rng(0)) - scene.paths
    floor = moved[scene.objects == 0] / scene.pixel
    assert np.allclose(floor, floor[:, :1], atol=1e-9)
    assert floor[:, 0].std() == pytest.approx(2.0, rel=0.1)
    assert np.ptp(moved[scene.objects == 1], axis=1).max() > 0


@pytest.mark.parametrize(("model", "stays"), [("drift", True), ("jitter", False)])
def test_errors_of_the_floor_stay_with_drift_and_are_new_in_each_image_with_jitter(load, plan, model, stays):
    scenes = load("association_scenes")
    scene = scenes.make(replace(plan, still=1.0), 1)
    seen = list(scenes.observe(scene, 2.0, model, 5))[:2]
    assert seen[0].view == seen[1].view
    floor = [((image.indices >= 0) & (scene.objects[image.indices] == 0)).all(axis=1) for image in seen]
    same = (seen[0].indices == seen[1].indices).all(axis=1)[floor[0] & floor[1]]
    assert len(same) > 100 and (same.mean() > 0.95 if stays else same.mean() < 0.1)


def test_without_errors_masks_are_the_truth_and_score_one(load, plan):
    scenes, masks = load("association_scenes"), load("association_masks")
    images = list(scenes.observe(scenes.make(plan, 1), 0.0, "drift", 0))
    spoilt = masks.spoil(images, masks.Errors(), plan.pixels, 0)
    assert all((mask == image.truth).all() for mask, image in zip(spoilt, images, strict=True))
    assert masks.miou(spoilt, images) == masks.miou(masks.oracle(spoilt, images), images) == 1.0


@pytest.mark.parametrize("case", ["A", "B", "C", "D", "E", "F"])
def test_errors_cost_and_the_oracle_is_above_what_came(load, plan, case):
    scenes, masks = load("association_scenes"), load("association_masks")
    images = list(scenes.observe(scenes.make(plan, 1), 0.0, "drift", 0))
    spoilt = [masks.spoil(images, masks.CASES[case], plan.pixels, seed) for seed in range(8)]
    scores = [masks.miou(mask, images) for mask in spoilt]
    best = [masks.miou(masks.oracle(mask, images), images) for mask in spoilt]
    assert np.mean(scores) < 1.0 and all(b >= s - 1e-9 for s, b in zip(scores, best, strict=True))


def test_ids_of_unknown_and_background_count_for_no_object(load, plan):
    scenes, masks = load("association_scenes"), load("association_masks")
    images = list(scenes.observe(scenes.make(plan, 1), 0.0, "drift", 0))
    for nobody in (0, masks.UNKNOWN):
        lost = [np.where(image.truth == 2, nobody, image.truth) for image in images]
        assert masks.miou(lost, images) == pytest.approx(2 / 3)


def test_rows_say_what_was_repaired(load, plan, tmp_path, capsys, monkeypatch):
    benchmark, scenes = load("association"), load("association_scenes")
    monkeypatch.setitem(scenes.PLANS, "tiny", plan)
    out = tmp_path / "rows"
    benchmark.main(["--scenes", "tiny", "--cases", "C", "--errors", "0,0.7", "--seeds", "1,2", "--out", str(out)])
    rows = json.loads(out.with_suffix(".json").read_text())
    assert [(r["error_px"], r["model"], r["seed"]) for r in rows] == [
        *((0.0, "drift", s) for s in (1, 2)),
        *((0.7, model, s) for model in ("drift", "jitter") for s in (1, 2)),
    ]
    assert all(row["in"] <= row["ours"] <= row["oracle"] + 1e-9 for row in rows)
    assert all(row["ours"] > row["in"] for row in rows if row["error_px"] == 0)
    assert len(out.with_suffix(".md").read_text().splitlines()) == 5 and "| tiny | C |" in capsys.readouterr().out


def test_time_is_told_by_stages_that_add_up(load, tmp_path):
    file = tmp_path / "time.json"
    sizes = {"gaussians": 3000, "objects": 4, "images": 20, "pixels": 48}
    load("association_time").main([f"--{key}={value}" for key, value in sizes.items()] + [f"--json={file}"])
    found = json.loads(file.read_text())
    assert {key: found[key] for key in sizes} == sizes and 0 <= found["in"] < found["out"] <= 1
    stages = found["read_s"] + found["draw_s"] + found["rest_s"]
    assert stages == pytest.approx(found["whole_s"], abs=0.003) and min(stages, found["draw_s"], found["rest_s"]) > 0
