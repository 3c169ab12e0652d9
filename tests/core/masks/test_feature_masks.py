"""Masks of rigid bodies from image features."""

import json
import sys

import cv2
import numpy as np
import pytest

from r5dgs_core import errors
from r5dgs_core.cli.commands import masks as cli_masks
from r5dgs_core.data import dataset as datasets
from r5dgs_core.data import images, mask_notes, masks
from r5dgs_core.masks import feature_masks, feature_points
from r5dgs_core.scene import cameras
from tests.support import board_films
from tests.support.board_films import CHARUCO, MATRICES, POSES, SIZE

CORNERS = np.array([[0, 0, 0], [0.5, 0, 0], [0.5, 0.4, 0], [0, 0.4, 0]])  # of the printed squares, m
TIMES = 8


def written(folder, moments, count=3):
    """A data set of a board that is carried before some cameras, at moments of `board_films.carried`."""
    content = {}
    films = board_films.films(CHARUCO, max(moments) + 1)[:count]
    for film, matrix, pose in zip(films, MATRICES, POSES, strict=False):
        frames = []
        for k, moment in enumerate(moments):
            images.write_png(folder / "train" / film.name / f"{k}.png", film.frames[moment])
            frames.append({"file_path": f"train/{film.name}/{k}.png", "time": k / len(moments)})
        lens = {"fl_x": matrix[0, 0], "fl_y": matrix[1, 1], "cx": 320.0, "cy": 240.0, "w": SIZE[0], "h": SIZE[1]}
        place = cameras.cam_world_to_opengl(np.linalg.inv(pose)).tolist()
        content[film.name] = {**lens, "transform_matrix": place, "frames": frames}
    (folder / "transforms_train.json").write_text(json.dumps({"world_convention": "blender", "data": content}))
    return folder


@pytest.fixture(scope="module")
def carried(tmp_path_factory):
    return written(tmp_path_factory.mktemp("carried"), range(TIMES))


@pytest.fixture(scope="module")
def masked(carried):
    """The same data set, with its masks."""
    return cli_masks.run_masks(carried, backend="features"), datasets.read(carried)


def overlap(view, moment):
    """Intersection over union of the mask of a view and the true board."""
    world = board_films.carried(moment)
    pixels = cameras.project(view.camera, CORNERS @ world[:3, :3].T + world[:3, 3])[0]
    drawn = np.zeros(SIZE[::-1], np.uint8)
    cv2.fillConvexPoly(drawn, np.round(pixels - 0.5).astype(np.int32), 1)
    mask = datasets.load_mask(view)
    return ((mask == 1) & (drawn == 1)).sum() / ((mask == 1) | (drawn == 1)).sum()


def test_a_carried_board_is_found_and_masked(masked):
    made, dataset = masked
    assert (made.images, made.objects, made.numbering) == (3 * TIMES, 1, mask_notes.SCENE)
    overlaps = [overlap(view, round(view.t * TIMES)) for view in dataset.train]
    assert np.median(overlaps) > 0.85 and min(overlaps) > 0.75


def test_finished_masks_are_kept_and_equal_new_ones(masked, tmp_path):
    made, dataset = masked
    assert cli_masks.run_masks(dataset.root, backend="features").kept == 3
    cli_masks.run_masks(dataset.root, backend="features", out=tmp_path)
    for view in dataset.train:
        assert (tmp_path / f"{view.name}.png").read_bytes() == (made.folder / f"{view.name}.png").read_bytes()


@pytest.mark.parametrize(("moments", "count"), [((2, 2, 2), 3), ((0, 1, 2), 1), ((4,), 3)])
def test_data_without_a_moving_body_is_refused_and_gets_no_masks(moments, count, tmp_path):
    data = written(tmp_path, moments, count)
    with pytest.raises(errors.DatasetError, match=r"no rigid body moves.*Remedy"):
        cli_masks.run_masks(data, backend="features")
    assert list((data / "object_mask").iterdir()) == []


def test_a_search_without_result_keeps_other_masks(masked, tmp_path):
    data = written(tmp_path, (2, 2, 2))
    for view in datasets.read(data).train:
        images.write_png(data / "object_mask" / f"{view.name}.png", np.ones(SIZE[::-1], np.uint8))
    (data / "object_mask" / "objects.json").write_text('{"1": "mug"}')
    before = {path: path.read_bytes() for path in (data / "object_mask").rglob("*") if path.is_file()}
    with pytest.raises(errors.DatasetError, match="no rigid body moves"):
        cli_masks.run_masks(data, backend="features", overwrite=True)
    assert {path: path.read_bytes() for path in (data / "object_mask").rglob("*") if path.is_file()} == before


def test_names_of_the_data_set_are_not_those_of_found_objects(tmp_path):
    data = written(tmp_path, range(4))
    (data / "objects.json").write_text('{"1": "mug", "2": "robot"}')
    cli_masks.run_masks(data, backend="features")
    assert datasets.read(data).object_names == {1: "object 1"}


def test_masks_of_other_views_are_not_continued(tmp_path):
    cli_masks.run_masks(written(tmp_path, range(4), 2), backend="features")
    with pytest.raises(errors.DatasetError, match=r"other settings \(views\)"):
        cli_masks.run_masks(written(tmp_path, range(4), 3), backend="features")


def test_missing_opencv_is_reported(carried, monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(errors.BackendError, match=r"--backend features: .*r5dgs\[prepare\]"):
        cli_masks.run_masks(carried, backend="features", out=tmp_path)


def track(times, step):
    """A point that moves along x."""
    count = len(times)
    centers = np.array([[0.1 * t, 0.0, 0.0] for t in times])
    return feature_masks._Track(
        np.zeros((1, 3)), 0.1, np.array(times), np.tile([1.0, 0, 0, 0], (count, 1)), centers, step
    )


def test_poses_are_interpolated_between_neighbours_only():
    body = track([1.0, 2.0, 5.0, 6.0], 1.0)
    np.testing.assert_allclose(body.at(1.25), [[0.125, 0, 0]])
    np.testing.assert_allclose(body.at(0.0), [[0.1, 0, 0]])
    assert [body.is_guessed(t) for t in (0.0, 1.5, 3.0, 3.5, 6.5, 7.5)] == [False, False, False, True, False, True]
    assert [body.is_present(t) for t in (-1.5, -0.5, 3.5, 8.0, 8.5)] == [False, True, True, True, False]


def test_images_of_guessed_poses_are_unknown(carried):
    camera = datasets.read(carried).train[0].camera
    assert (feature_masks._drawn([track([1.0, 2.0, 5.0], 1.0)], camera, 3.5) == masks.UNKNOWN).all()


def test_times_between_those_that_are_searched_have_interpolated_masks(carried, monkeypatch):
    monkeypatch.setattr(feature_masks, "MAX_TIMES", 4)
    views = datasets.read(carried).train
    backend = feature_masks.FeatureMasks(views)
    for video in feature_masks.videos.of(views):
        for view, mask in zip(video.views, backend.label(video, carried, lambda share: None), strict=True):
            assert (mask == 1).any(), view.name


def test_the_search_for_bodies_is_part_of_the_progress(carried):
    shares = []
    feature_masks.find(datasets.read(carried).train, shares.append)
    assert shares == sorted(shares) and shares[-1] == 1.0
    assert sum(feature_masks.EXTRACTION < share < 1.0 for share in shares) >= TIMES


def test_large_images_are_reduced(carried, monkeypatch, tmp_path):
    monkeypatch.setattr(feature_points, "MAX_SIDE", 400)
    monkeypatch.setattr(feature_masks, "MAX_SIDE", 200)
    cli_masks.run_masks(carried, backend="features", out=tmp_path)
    views = datasets.read(carried, str(tmp_path)).train
    assert np.median([overlap(view, round(view.t * TIMES)) for view in views]) > 0.8


@pytest.mark.parametrize("fields", [{"words": "board"}, {"unknown": 255}, {"points": 8}, {"source": "elsewhere"}])
def test_options_of_other_backends_are_refused(carried, fields):
    with pytest.raises(errors.UsageError, match="does not apply to --backend features"):
        cli_masks.run_masks(carried, backend="features", **fields)
