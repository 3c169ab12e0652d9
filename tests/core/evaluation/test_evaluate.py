"""Evaluation of scenes against data sets of their own pictures, for which every number is known."""

import dataclasses
import io
import json
import shutil

import numpy as np
import pytest
from rich.console import Console

from r5dgs_core.data import dataset, images, masks
from r5dgs_core.evaluation import evaluate, evaluation_table, ground_truth_poses
from tests.support import pictures, scenes

BACKEND = pictures.BACKEND


@pytest.fixture(scope="module")
def result(scene, data):
    return evaluate.evaluate(scene, data, backend=BACKEND)


def changed_group(scene, index: int, **model):
    groups = list(scene.groups)
    groups[index] = dataclasses.replace(groups[index], model=dataclasses.replace(groups[index].model, **model))
    return dataclasses.replace(scene, groups=tuple(groups))


def test_the_result_has_its_fixed_shape_and_is_json(result, scene):
    assert set(result) == {"scene", "splits", "objects", "horizon", "train"}
    assert set(result["splits"]) == {"val", "test"}
    for split in result["splits"].values():
        assert tuple(split["rigid"]) == evaluate.METRICS
    for row in result["objects"]:
        keys = {"id", "name", "position_error", "rotation_error_deg", "warning", "half_width", "half_width_percent"}
        assert set(row) == keys
    assert set(result["train"]) == {"seconds", "iterations", "gaussians"}
    assert result["train"]["gaussians"] == len(scene.gaussians.means)
    assert json.loads(json.dumps(result, allow_nan=False)) == result


def test_a_scene_is_perfect_on_its_own_pictures(result):
    for split, count in (("val", 2), ("test", 4)):
        values = result["splits"][split]["rigid"]
        assert values["images"] == count
        assert values["psnr"] == values["psnr_pooled"] == values["psnr_objects"] == 100.0
        assert values["ssim"] == pytest.approx(1.0)
        assert values["miou"] == values["miou_matched"] == 1.0
        assert values["lpips"] is None
        assert values["ms_motion"] > 0 and values["ms_raster"] > 0
    for row in result["objects"]:
        assert row["position_error"] == pytest.approx(0, abs=1e-6)
        assert row["rotation_error_deg"] == pytest.approx(0, abs=1e-5)


def test_a_wrong_extrapolation_lowers_test_and_not_val(scene, data):
    wrong = changed_group(scene, 2, velocity=np.asarray(scene.groups[2].model.velocity) + [0.0, 0.0, 2.0])
    result = evaluate.evaluate(wrong, data, backend=BACKEND)
    assert result["splits"]["val"]["rigid"]["psnr"] == 100.0
    assert result["splits"]["test"]["rigid"]["psnr"] < 40
    assert result["splits"]["test"]["rigid"]["psnr_objects"] < result["splits"]["test"]["rigid"]["psnr"]
    assert result["splits"]["test"]["rigid"]["ssim_objects"] < result["splits"]["test"]["rigid"]["ssim"]
    assert result["splits"]["test"]["rigid"]["miou"] < 0.95
    errors = {row["id"]: row for row in result["objects"]}
    assert errors[2]["position_error"] == pytest.approx(2.0 * 0.25, abs=1e-6)
    assert errors[2]["rotation_error_deg"] == pytest.approx(0, abs=1e-5)
    assert errors[1]["position_error"] == pytest.approx(0, abs=1e-6)


def test_a_wrong_spin_is_a_rotation_error_of_that_many_degrees(scene, data):
    still = changed_group(scene, 2, kind="ballistic_spin", angular_velocity=np.array([0.0, 0.0, 1.0]))
    row = next(row for row in evaluate.object_errors(still, data.ground_truth) if row["id"] == 2)
    assert row["rotation_error_deg"] == pytest.approx(np.degrees(0.25), rel=1e-6)
    assert row["position_error"] == pytest.approx(0, abs=1e-6)


def test_swapped_ids_lower_only_the_same_id_score(scene, data):
    swapped = np.array([0, 2, 1, 3])
    ids = np.where(
        scene.gaussians.object_ids > 0, swapped[np.maximum(scene.gaussians.object_ids, 0)], scene.gaussians.object_ids
    ).astype(np.int32)
    result = evaluate.evaluate(scene.with_arrays(object_ids=ids), data, splits=("val",), backend=BACKEND)
    values = result["splits"]["val"]["rigid"]
    assert values["miou_matched"] == 1.0
    assert values["miou"] < 0.5
    assert values["psnr"] == 100.0


def test_an_object_that_the_scene_lacks_counts_as_missed(scene, data, tmp_path):
    shutil.copytree(data.root, tmp_path / "more")
    for path in (tmp_path / "more" / "object_mask" / "val").iterdir():
        ids = images.read_png(path)
        ids[ids == 3] = 9
        images.write_png(path, ids)
    result = evaluate.evaluate(scene, dataset.read(tmp_path / "more"), splits=("val",), backend=BACKEND)
    assert result["splits"]["val"]["rigid"]["miou"] == pytest.approx(2 / 3)
    assert result["splits"]["val"]["rigid"]["miou_matched"] == 1.0


def test_a_true_object_that_the_scene_lacks_has_no_errors(scene, data):
    known = data.ground_truth
    more = dataclasses.replace(
        known,
        object_ids=(*known.object_ids, 99),
        names=(*known.names, "lost"),
        matrices=np.concatenate([known.matrices, known.matrices[:1]]),
    )
    rows = {row["id"]: row for row in evaluate.object_errors(scene, more)}
    assert rows[99]["name"] == "lost" and rows[99]["position_error"] is None
    assert [rows[row["id"]] for row in evaluate.object_errors(scene, known)] == list(rows.values())[:-1]
    assert len(ground_truth_poses.bodies(scene, more, every=True)) == len(known.object_ids)


def test_metrics_without_reference_data_are_none(scene, data):
    bare = dataclasses.replace(
        data,
        ground_truth=None,
        val=tuple(dataclasses.replace(view, mask_path=None) for view in data.val),
        test=(),
    )
    result = evaluate.evaluate(scene, bare, backend=BACKEND)
    values = result["splits"]["val"]["rigid"]
    assert values["psnr"] == 100.0
    assert values["miou"] is values["miou_matched"] is values["psnr_objects"] is None
    assert result["splits"]["test"]["rigid"]["images"] == 0
    assert result["splits"]["test"]["rigid"]["psnr"] is None
    assert all(row["position_error"] is None for row in result["objects"])


def test_the_classifier_decides_the_id_map_if_there_is_one(scene):
    classes = [item.id for item in scene.objects if item.id >= 0]
    codes = np.zeros((len(scene.gaussians.means), 16), np.float16)
    rows = scene.gaussians.object_ids >= 0
    codes[rows, [classes.index(i) for i in scene.gaussians.object_ids[rows]]] = 1
    weight = np.zeros((len(classes), 16), np.float32)
    weight[:, : len(classes)] = np.eye(len(classes))
    bias = np.array([0.05, 0, 0, 0], np.float32)
    coded = scene.with_arrays(identities=codes, classifier_weight=weight, classifier_bias=bias)
    camera = scenes.orbit_camera(0.5, pictures.WIDTH, pictures.HEIGHT)
    by_votes = evaluate.render(scene, camera, 0.9, backend=BACKEND).ids
    by_codes = evaluate.render(coded, camera, 0.9, backend=BACKEND).ids
    assert set(np.unique(by_codes)) == {0, 1, 2, 3}
    assert (by_votes == by_codes).mean() > 0.9
    turned = coded.with_arrays(classifier_weight=np.roll(weight, 1, axis=0), classifier_bias=np.roll(bias, 1))
    again = evaluate.render(turned, camera, 0.9, backend=BACKEND).ids
    np.testing.assert_array_equal(again, (by_codes + 1) % 4)


def test_transparent_pixels_are_compared_on_the_background_of_the_training(scene, data, tmp_path):
    shutil.copytree(data.root, tmp_path / "clear")
    for path in (tmp_path / "clear" / "val").iterdir():
        images.write_png(path, np.zeros((pictures.HEIGHT, pictures.WIDTH, 4), np.uint8))
    clear = dataset.read(tmp_path / "clear")
    empty = scene.with_arrays(opacity_logits=np.full_like(scene.gaussians.opacity_logits, -20))
    for name, level in (("white", 1.0), ("black", 0.0)):
        sky = np.full((1, 3), (level - 0.5) / 0.28209479177387814, np.float32)
        provenance = {"config": {"train": {"background": name}}}
        shown = dataclasses.replace(empty.with_arrays(background_sh=sky), provenance=provenance)
        result = evaluate.evaluate(shown, clear, splits=("val",), backend=BACKEND)
        assert result["splits"]["val"]["rigid"]["psnr"] == 100.0


def test_progress_counts_every_image(scene, data):
    seen = []
    evaluate.evaluate(scene, data, backend=BACKEND, progress=lambda done, total: seen.append((done, total)))
    assert seen == [(i, 6) for i in range(1, 7)]


def test_the_table_shows_every_available_number(result):
    console = Console(width=100, record=True, file=io.StringIO())
    console.print(evaluation_table.make(result))
    text = console.export_text()
    for word in ("PSNR", "SSIM", "mIoU", "motion", "rasterization", "100.00", "mug", "red apple", "toy car", "deg"):
        assert word in text
    assert "LPIPS" not in text


def test_brackets_in_names_are_shown_unchanged(result):
    objects = [{**row, "name": f"{row['name']} [/left]"} for row in result["objects"]]
    console = Console(width=100, record=True, file=io.StringIO())
    console.print(evaluation_table.make({**result, "scene": "[red]", "objects": objects}))
    rows = [{"object": "mug [/left]", "name": "rotation", "value": 1.0, "threshold": 1.0, "reason": "[/b]"}]
    console.print(evaluation_table.needs(rows))
    text = console.export_text()
    assert "mug [/left] (1)" in text and "[red]" in text and "[/b]" in text and text.count("[/left]") == 7


def test_several_modes_are_rows_that_fit_a_narrow_terminal(result):
    modes = ("rigid", "rigid/least_squares", "hybrid", "standard")
    splits = {split: {mode: found["rigid"] for mode in modes} for split, found in result["splits"].items()}
    console = Console(width=80, record=True, file=io.StringIO())
    console.print(evaluation_table.make({**result, "splits": splits}))
    text = console.export_text()
    assert all(text.count(f" {mode} ") == len(splits) for mode in modes[1:])
    for word in ("PSNR", "SSIM", "mIoU", "motion", "100.00", "mug", "deg", "mode rigid"):
        assert word in text


def test_numbers_are_of_the_eight_bit_picture(scene):
    shown = evaluate.render(scene, scenes.orbit_camera(0.5, pictures.WIDTH, pictures.HEIGHT), 0.5, backend=BACKEND)
    np.testing.assert_allclose(shown.color * 255, np.rint(shown.color * 255), atol=1e-4)


def test_unknown_pixels_of_the_true_masks_do_not_count(scene, data, tmp_path):
    shutil.copytree(data.root, tmp_path / "part")
    for path in (tmp_path / "part" / "object_mask" / "val").iterdir():
        ids = images.read_png(path).astype(np.uint16)
        ids[ids == 3] = masks.UNKNOWN
        images.write_png(path, ids)
    part = dataset.read(tmp_path / "part")
    values = evaluate.evaluate(scene, part, splits=("val",), backend=BACKEND)["splits"]["val"]["rigid"]
    assert values["miou"] == values["iou_background"] == 1.0 and set(values["iou_objects"]) == {"1", "2"}


def test_the_images_past_t_max_are_counted(scene, result):
    assert [result["splits"][split]["rigid"]["images_later"] for split in ("val", "test")] == [0, 4]
    assert scene.t_max == 0.75


def test_the_table_explains_its_overlap_columns(scene, data):
    swapped = np.array([0, 2, 1, 3])
    ids = np.where(
        scene.gaussians.object_ids > 0, swapped[np.maximum(scene.gaussians.object_ids, 0)], scene.gaussians.object_ids
    ).astype(np.int32)
    wrong = evaluate.evaluate(scene.with_arrays(object_ids=ids), data, backend=BACKEND)
    console = Console(width=200, record=True, file=io.StringIO())
    console.print(evaluation_table.make(wrong))
    text = " ".join(console.export_text().split())
    assert "val: 2 held-out images, interpolated; test: 4 held-out images, extrapolated" in text
    assert "Hungarian" in text and "0.000 (1.000 as 2)" in text and "toy car (3) │ 1.000 │ 1.000" in text
