"""LLFF, Panoptic and Nerfies, compared with the formulas of their authors, written out here."""

import json

import numpy as np
import pytest

from r5dgs_core import errors
from r5dgs_core.capture.calibration import reading
from tests.support.projections import BOUND, POINTS, pixels, rotation

WORLD_TO_CAMERA = [rotation(seed) for seed in (4, 5, 6)]
CENTERS = [turn.T @ [0.1, -0.2 * k, -2.0] for k, turn in enumerate(WORLD_TO_CAMERA)]


def in_camera(k: int) -> np.ndarray:
    return (POINTS - CENTERS[k]) @ WORLD_TO_CAMERA[k].T


def llff_rows() -> np.ndarray:
    rows = []
    for turn, center in zip(WORLD_TO_CAMERA, CENTERS, strict=True):
        right, down, forward = turn
        matrix = np.stack([down, right, -forward, center, [480.0, 640.0, 505.5]], 1)
        rows.append(np.append(matrix.ravel(), [0.5, 10.0]))
    return np.array(rows)


def test_llff_rows_project_with_a_centred_principal_point(tmp_path):
    np.save(tmp_path / "poses_bounds.npy", llff_rows())
    for name in ("cam10.mp4", "cam02.mp4", "cam00.mp4"):
        (tmp_path / name).touch()
    calibration = reading.read_calibration(tmp_path)
    assert (calibration.format, calibration.names) == ("llff", ("cam00", "cam02", "cam10"))
    for k, camera in enumerate(calibration.cameras):
        x, y, z = in_camera(k).T
        expected = np.stack([505.5 * x / z + 320, 505.5 * y / z + 240], 1)
        assert np.abs(pixels(camera.lens, camera.camera_to_world) - expected).max() < BOUND
        assert (camera.width, camera.height) == (640, 480)


def test_llff_rows_are_the_sorted_images(tmp_path):
    np.save(tmp_path / "poses_bounds.npy", llff_rows())
    (tmp_path / "images").mkdir()
    for name in ("c.jpg", "a.jpg", "b.jpg"):
        (tmp_path / "images" / name).touch()
    calibration = reading.read_calibration(tmp_path)
    assert calibration.names == ("a", "b", "c")
    assert calibration.cameras[1].frames[0].path == tmp_path / "images" / "b.jpg"


@pytest.mark.parametrize(
    "table, message",
    [
        (np.zeros((3, 16)), "expected rows of 17 numbers"),
        (np.full((3, 17), np.nan), "expected finite numbers in row 0"),
        (llff_rows()[:2], "found 2 rows and 3 videos"),
        (llff_rows() * ([1.0] * 14 + [-1.0, 1.0, 1.0]), "row 0: expected a focal length above 0"),
        (llff_rows() * ([-1.0, 1, 1, 1, 1] * 3 + [1.0, 1.0]), "row 0: expected a rotation matrix"),
    ],
)
def test_damaged_llff_files_are_refused(tmp_path, table, message):
    np.save(tmp_path / "poses_bounds.npy", table)
    for k in range(3):
        (tmp_path / f"cam{k}.mp4").touch()
    with pytest.raises(errors.DatasetError, match=message):
        reading.read_calibration(tmp_path)


def panoptic(mirror: bool = False) -> dict:
    sign = np.array([-1.0, 1.0, 1.0]) if mirror else np.ones(3)
    poses, lenses = [], []
    for turn, center in zip(WORLD_TO_CAMERA, CENTERS, strict=True):
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = turn * sign, -turn @ center
        poses.append(matrix.tolist())
        lenses.append([[500.5, 0.0, 321.0], [0.0, 498.5, 239.0], [0.0, 0.0, 1.0]])
    names = [[f"{c}/{t:06d}.jpg" for c in (0, 7, 9)] for t in range(2)]
    return {"w": 640, "h": 360, "k": [lenses] * 2, "w2c": [poses] * 2, "cam_id": [[0, 7, 9]] * 2, "fn": names}


@pytest.mark.parametrize("mirror", [False, True])
def test_panoptic_cameras_project_by_their_matrices(tmp_path, mirror):
    content = panoptic(mirror)
    (tmp_path / "train_meta.json").write_text(json.dumps(content))
    colored = np.concatenate([POINTS * ([-1, 1, 1] if mirror else 1), np.full((len(POINTS), 4), 0.5)], 1)
    np.savez(tmp_path / "init_pt_cld.npz", data=colored)
    calibration = reading.read_calibration(tmp_path)
    assert (calibration.format, calibration.names, calibration.meters_per_unit) == ("panoptic", ("0", "7", "9"), 1.0)
    assert calibration.seconds_per_time == pytest.approx(1 / 30)
    for k, camera in enumerate(calibration.cameras):
        points = np.concatenate([colored[:, :3], np.ones((len(POINTS), 1))], 1)
        u = points @ (np.array(content["k"][0][k]) @ np.array(content["w2c"][0][k])[:3]).T
        found = pixels(camera.lens, camera.camera_to_world, calibration.points)
        assert np.abs(found - u[:, :2] / u[:, 2:]).max() < BOUND
        assert not camera.moves and [frame.time for frame in camera.frames] == [0.0, 1.0]
        assert camera.frames[1].path == tmp_path / "ims" / content["fn"][1][k]


def test_panoptic_test_cameras_are_a_split_of_their_own(tmp_path):
    (tmp_path / "train_meta.json").write_text(json.dumps(panoptic()))
    held = panoptic()
    held["cam_id"] = [[20, 21, 22]] * 2
    (tmp_path / "test_meta.json").write_text(json.dumps(held))
    calibration = reading.read_calibration(tmp_path)
    assert {camera.name: camera.frames[0].split for camera in calibration.cameras}["21"] == "test"


@pytest.mark.parametrize(
    "key, value, message",
    [
        ("w", 0, "expected an image size"),
        ("k", [[]], "time 0: expected as many 'k'"),
        ("fn", None, "'fn': expected one list per time"),
        ("w2c", [[np.diag([1, 1, 2, 1]).tolist()] * 3] * 2, "time 0, camera 0: expected a rotation matrix"),
    ],
)
def test_damaged_panoptic_files_are_refused(tmp_path, key, value, message):
    (tmp_path / "train_meta.json").write_text(json.dumps({**panoptic(), key: value}))
    with pytest.raises(errors.DatasetError, match=message):
        reading.read_calibration(tmp_path)


def nerfies_camera(k: int, **changes) -> dict:
    return {
        "orientation": WORLD_TO_CAMERA[k].tolist(),
        "position": CENTERS[k].tolist(),
        "focal_length": 505.25,
        "principal_point": [322.5, 238.5],
        "skew": 3.5,
        "pixel_aspect_ratio": 1.001,
        "radial_distortion": [0.1, -0.2, 0.05],
        "tangential_distortion": [1.1e-3, -2.5e-3],
        "image_size": [640, 480],
    } | changes


def write_nerfies(folder, cameras: list[dict]) -> None:
    (folder / "camera").mkdir()
    (folder / "rgb" / "2x").mkdir(parents=True)
    for k, camera in enumerate(cameras):
        (folder / "camera" / f"{k:06d}.json").write_text(json.dumps(camera))
        (folder / "rgb" / "2x" / f"{k:06d}.png").touch()
    ids = [f"{k:06d}" for k in range(len(cameras))]
    listing = {"count": 3, "ids": ids, "train_ids": ids[:2], "val_ids": ids[2:]}
    (folder / "dataset.json").write_text(json.dumps(listing))
    metadata = {item: {"warp_id": 5 * k, "appearance_id": k, "camera_id": k % 2} for k, item in enumerate(ids)}
    (folder / "metadata.json").write_text(json.dumps(metadata))


def test_nerfies_cameras_project_by_the_formula_of_their_authors(tmp_path):
    old = nerfies_camera(2)
    old["tangential"] = old.pop("tangential_distortion")
    write_nerfies(tmp_path, [nerfies_camera(0), nerfies_camera(1), old])
    np.save(tmp_path / "points.npy", POINTS)
    calibration = reading.read_calibration(tmp_path)
    assert (calibration.format, calibration.names) == ("nerfies", ("cam_0", "cam_1"))
    assert np.array_equal(calibration.points, POINTS)
    moving, fixed = calibration.cameras
    assert moving.moves and [frame.time for frame in moving.frames] == [0.0, 10.0]
    assert [frame.split for frame in moving.frames] == ["train", "val"]
    assert moving.frames[1].path == tmp_path / "rgb" / "2x" / "000002.png"
    for k, frame in {0: moving.frames[0], 1: fixed.frames[0], 2: moving.frames[1]}.items():
        x, y = (in_camera(k)[:, :2] / in_camera(k)[:, 2:]).T
        r2 = x**2 + y**2
        factor = 1.0 + r2 * (0.1 + r2 * (-0.2 + 0.05 * r2))
        u = x * factor + 2.0 * 1.1e-3 * x * y - 2.5e-3 * (r2 + 2.0 * x**2)
        v = y * factor + 2.0 * -2.5e-3 * x * y + 1.1e-3 * (r2 + 2.0 * y**2)
        expected = np.stack([505.25 * u + 3.5 * v + 322.5, 505.25 * 1.001 * v + 238.5], 1)
        assert np.abs(pixels(frame.lens, frame.camera_to_world) - expected).max() < BOUND


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"focal_length": None}, "'focal_length': expected a finite number"),
        ({"principal_point": [1.0]}, "'principal_point': expected 2 numbers"),
        ({"orientation": [[1, 0, 0], [0, 1, 0], [0, 1, 1]]}, "expected a rotation matrix"),
        ({"image_size": [640.5, 480]}, "expected an image size in whole pixels"),
        ({"focal_length": -1.0}, "focal lengths above 0"),
    ],
)
def test_damaged_nerfies_cameras_are_refused_by_file(tmp_path, changes, message):
    write_nerfies(tmp_path, [nerfies_camera(0), nerfies_camera(1, **changes)])
    with pytest.raises(errors.DatasetError, match=message) as caught:
        reading.read_calibration(tmp_path)
    assert "000001.json" in str(caught.value)
