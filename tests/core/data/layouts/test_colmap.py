"""Images with a COLMAP reconstruction give the same data set as camera files."""

from __future__ import annotations

import json
import shutil
import struct

import numpy as np
import pytest

from r5dgs_core.data import dataset as datasets
from r5dgs_core.data import images
from r5dgs_core.errors import DatasetError
from tests.support import colmap_files, scenes

POINTS = np.array([[0.1, -2.0, 3.5], [1e3, 0.0, -0.25], [4.0, 5.0, 6.0]])


def picture(path, width=12, height=8, value=0.4):
    """Write a small image."""
    images.write_png(path, np.full((height, width, 3), value, np.float32))


def camera(k):
    """One of many cameras around the origin, each with its own lens."""
    view = scenes.orbit_camera(0.31 * k, 12, 8)
    intrinsics = view.intrinsics + [[k, 0, 0.25], [0, 2 * k, -0.5], [0, 0, 0]]
    return scenes.cameras.Camera(12, 8, intrinsics, view.T_cam_world)


@pytest.fixture
def flat(tmp_path):
    """Ten registered images without times, and their cameras."""
    views = {f"img_{k:02d}.png": camera(k) for k in range(10)}
    for name in views:
        picture(tmp_path / "images" / name)
    colmap_files.write(tmp_path / "sparse" / "0", views, POINTS)
    return tmp_path, views


@pytest.fixture
def rig(tmp_path):
    """Nine cameras that stand still, with four frames each, the first of which is registered."""
    views = {f"cam{k}/frame_0004.png": camera(k) for k in range(9)}
    for k in range(9):
        for number in (4, 6, 8, 12):
            picture(tmp_path / "images" / f"cam{k}" / f"frame_{number:04d}.png", value=number / 20)
    colmap_files.write(tmp_path / "sparse" / "0", views, POINTS)
    return tmp_path, views


def same_camera(view, expected):
    """Assert that a view has a camera up to rounding."""
    np.testing.assert_allclose(view.camera.T_cam_world, expected.T_cam_world, atol=1e-12)
    np.testing.assert_allclose(view.camera.intrinsics, expected.intrinsics, atol=1e-10)


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("place", ["sparse/0", "sparse"])
def test_registered_images_are_views_with_colmaps_cameras(tmp_path, flat, text, place):
    root, views = flat
    shutil.rmtree(root / "sparse")
    colmap_files.write(root / place, views, POINTS, text=text)
    dataset = datasets.read(root)
    for view in (*dataset.train, *dataset.val):
        same_camera(view, views[f"{view.name}.png"])
        assert view.t == 0.0
    assert dataset.world_convention == "colmap" and dataset.t_max == 0.0
    np.testing.assert_array_equal(dataset.points, POINTS)
    np.testing.assert_allclose(dataset.point_colors, [[1.0, 0.2, 0.0]] * 3, atol=1e-7)


def test_every_eighth_camera_is_held_out(flat):
    dataset = datasets.read(flat[0])
    assert [view.name for view in dataset.val] == ["img_00", "img_08"]
    assert len(dataset.train) == 8 and dataset.test == ()


def test_fewer_than_eight_cameras_are_all_used_for_training(tmp_path):
    views = {f"{k}.png": camera(k) for k in range(7)}
    for name in views:
        picture(tmp_path / "images" / name)
    colmap_files.write(tmp_path / "sparse" / "0", views, POINTS)
    dataset = datasets.read(tmp_path)
    assert len(dataset.train) == 7 and dataset.val == ()


def test_frames_of_a_standing_camera_share_its_pose_and_have_their_numbers_as_times(rig):
    root, views = rig
    dataset = datasets.read(root)
    assert len(dataset.cameras) == 9
    assert {view.camera.name for view in dataset.val} == {"cam0", "cam8"}
    np.testing.assert_allclose(dataset.times, [0.0, 0.25, 0.5, 1.0])
    assert dataset.frames_per_unit == 8.0  # eight numbers from the first frame to the last
    for view in (*dataset.train, *dataset.val):
        folder, frame = view.name.split("/")
        same_camera(view, views[f"{folder}/frame_0004.png"])
        assert view.t == (int(frame.removeprefix("frame_")) - 4) / 8
        assert datasets.load_image(view)[0, 0, 0] == pytest.approx(int(frame[-2:]) / 20, abs=1 / 255)


def test_an_image_beside_the_folders_gives_the_pose_of_a_camera(rig):
    root, views = rig
    beside = {name.split("/")[0] + ".png": view for name, view in views.items()}
    for name in beside:
        picture(root / "images" / name)
    colmap_files.write(root / "sparse" / "0", beside, POINTS)
    dataset = datasets.read(root)
    assert len(dataset.train) + len(dataset.val) == 36
    same_camera(dataset.train[0], beside[dataset.train[0].camera.name + ".png"])


def test_times_json_sets_the_times_and_the_test_split(rig):
    root, views = rig
    times = {f"cam{k}/frame_{n:04d}.png": 0.1 * n for k in range(9) for n in (4, 6, 8, 12)}
    (root / "times.json").write_text(json.dumps({"times": times, "t_max": 0.8, "frames_per_unit": 25}))
    dataset = datasets.read(root)
    np.testing.assert_allclose(dataset.times, [0.4, 0.6, 0.8])
    assert {view.t for view in dataset.test} == {1.2000000000000002} and len(dataset.test) == 9
    assert (len(dataset.train), len(dataset.val), dataset.frames_per_unit) == (21, 6, 25.0)
    same_camera(dataset.test[3], views[f"{dataset.test[3].camera.name}/frame_0004.png"])


def test_a_moving_camera_has_a_time_and_a_pose_per_image(flat):
    root, views = flat
    (root / "times.json").write_text(json.dumps({name: k / 9 for k, name in enumerate(views)}))
    dataset = datasets.read(root)
    # The first image is held out by its number, but used for training because no other shows its time.
    assert [view.name for view in dataset.val] == ["img_08"]
    assert dataset.train[0].name == "img_00" and dataset.t_max == 1.0
    for view in dataset.train:
        same_camera(view, views[f"{view.name}.png"])


def test_a_held_out_camera_is_never_trained_on(rig, caplog):
    root, _ = rig
    times = {f"cam{k}/frame_{n:04d}.png": 0.1 * n for k in range(9) for n in (6, 8)}
    times |= {"cam0/frame_0004.png": 0.4, "cam8/frame_0012.png": 1.2, "cam3/frame_0012.png": 1.0}
    (root / "times.json").write_text(json.dumps(times))
    with caplog.at_level("INFO"):
        dataset = datasets.read(root)
    assert {v.camera.name for v in dataset.val} == {"cam0", "cam8"} and len(dataset.val) == 4
    assert {v.camera.name for v in dataset.train} == {f"cam{k}" for k in range(1, 8)} and len(dataset.train) == 15
    assert "2 images of held-out cameras are left out" in caplog.text


def test_held_out_cameras_are_used_for_training_if_no_other_covers_the_time_range(rig):
    root, _ = rig
    times = {f"cam{k}/frame_0012.png": 1.2 for k in range(9)} | {"cam0/frame_0004.png": 0.4}
    (root / "times.json").write_text(json.dumps({"times": times, "t_max": 0.5}))
    dataset = datasets.read(root)
    assert [v.name for v in dataset.train] == ["cam0/frame_0004"] and dataset.val == () and len(dataset.test) == 9


def test_masks_and_names_are_found_beside_the_images(flat):
    root, _ = flat
    images.write_png(root / "object_mask" / "img_03.png", np.full((8, 12, 1), 2, np.uint8))
    (root / "objects.json").write_text(json.dumps({"2": "mug"}))
    dataset = datasets.read(root)
    view = next(view for view in dataset.train if view.name == "img_03")
    assert (datasets.load_mask(view) == 2).all() and dataset.object_names == {2: "mug"}


def test_the_lens_is_scaled_for_smaller_images(flat):
    root, views = flat
    for name in views:
        picture(root / "images" / name, 6, 4)
    view = datasets.read(root).train[0]
    expected = views[f"{view.name}.png"].intrinsics * [[0.5], [0.5], [1]]
    np.testing.assert_allclose(view.camera.intrinsics, expected, atol=1e-10)


def test_camera_files_take_precedence_over_a_reconstruction(tiny, flat, tmp_path):
    folder = tmp_path / "both"
    shutil.copytree(tiny.root, folder)
    shutil.copytree(flat[0] / "sparse", folder / "sparse")
    dataset = datasets.read(folder)
    assert dataset.world_convention == "blender" and dataset.points is None


def test_the_digest_follows_the_reconstruction(flat):
    root, views = flat
    before = datasets.read(root).digest
    assert datasets.read(root).digest == before
    colmap_files.write(root / "sparse" / "0", views, POINTS + 1)
    assert datasets.read(root).digest != before


@pytest.mark.parametrize("text", [False, True])
def test_distorted_lenses_are_refused_with_the_remedy(flat, text):
    root, views = flat
    shutil.rmtree(root / "sparse")
    colmap_files.write(root / "sparse" / "0", views, POINTS, text=text, model=colmap_files.OPENCV)
    with pytest.raises(
        DatasetError, match="expected the lens SIMPLE_PINHOLE or PINHOLE, found OPENCV.*r5dgs prepare .*--out .*_data"
    ):
        datasets.read(root)


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
@pytest.mark.parametrize("share", [0.0, 0.5, 0.99])
def test_truncated_files_are_named(flat, name, share):
    path = flat[0] / "sparse" / "0" / f"{name}.bin"
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(DatasetError, match=rf"{name}.bin: the file ends at byte \d+; is it truncated"):
        datasets.read(flat[0])


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("cameras", "1 PINHOLE 12", "cameras.txt: line 1: expected id, model, width"),
        ("cameras", "1 PINHOLE 12 8 10.0 10.0 6.0", "expected 4 parameters and a size"),
        ("cameras", "1 PINHOLE 12 8 -1 10 6 4", "expected 4 parameters and a size"),
        ("cameras", "77 PINHOLE 12 8 10 10 6 4", "image img_00.png: camera 1 is not in cameras.txt"),
        ("images", "101 1 0 0", "images.txt: line 1: expected id, quaternion"),
        ("images", "101 0 0 0 0 1 2 3 1 img_00.png\n", "image img_00.png: expected a finite pose"),
        ("images", f"101 1 0 0 0 1 2 3 1 {'a' * 300}/img_00.png\n", "expected a name that a file can have"),
        ("images", "# nothing\n", "expected registered images, found none"),
        ("points3D", "1 2 3", "points3D.txt: line 1: expected id, x, y, z"),
    ],
)
def test_damaged_text_is_named(flat, name, content, message):
    root, views = flat
    shutil.rmtree(root / "sparse")
    colmap_files.write(root / "sparse" / "0", views, POINTS, text=True)
    (root / "sparse" / "0" / f"{name}.txt").write_text(content)
    with pytest.raises(DatasetError, match=message):
        datasets.read(root)


def test_missing_files_are_named(flat):
    root, _ = flat
    (root / "sparse" / "0" / "images.bin").rename(root / "images.bin")
    with pytest.raises(DatasetError, match=r"images.bin: the file is missing, and so is images.txt"):
        datasets.read(root)
    (root / "images.bin").rename(root / "sparse" / "0" / "images.bin")
    (root / "images" / "img_05.png").unlink()
    with pytest.raises(DatasetError, match="image img_05.png: the image is missing, expected .*img_05.png"):
        datasets.read(root)
    (root / "images").rename(root / "pictures")
    with pytest.raises(DatasetError, match="images: expected the folder of the images, found none"):
        datasets.read(root)


def test_an_unknown_lens_is_named(flat):
    path = flat[0] / "sparse" / "0" / "cameras.bin"
    data = bytearray(path.read_bytes())
    data[12:16] = struct.pack("<i", 99)
    path.write_bytes(data)
    with pytest.raises(DatasetError, match="camera 1: unknown lens 99"):
        datasets.read(flat[0])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ([1, 2], "times.json: expected image names and times, found list"),
        ({}, "expected image names and times, found none"),
        ({"img_00.png": "early"}, "'img_00.png' must be a finite number, found 'early'"),
        ({"img_99.png": 0.0}, "'img_99.png': the image is missing"),
        ({"times": {"img_00.png": 0.5}, "t_max": 0.1}, "t_max 0.1 of times.json: expected images up to it"),
    ],
)
def test_times_that_cannot_be_used_are_named(flat, content, message):
    (flat[0] / "times.json").write_text(json.dumps(content))
    with pytest.raises(DatasetError, match=message):
        datasets.read(flat[0])


def test_frames_without_numbers_need_times(rig):
    root, _ = rig
    (root / "images" / "cam3" / "frame_0006.png").rename(root / "images" / "cam3" / "last.png")
    with pytest.raises(DatasetError, match=r"last.png: expected a number at the end .* give the times in .*times.json"):
        datasets.read(root)


def test_points_are_optional(flat):
    (flat[0] / "sparse" / "0" / "points3D.bin").unlink()
    assert datasets.read(flat[0]).points is None


def test_a_reconstruction_of_few_of_the_images_is_refused_with_the_remedy(flat):
    root, _ = flat
    for k in range(90):
        picture(root / "images" / f"lost_{k:02d}.png")
    message = r"found 10 of 100 registered by COLMAP \(lost_00.png is not\). Remedy: match more.*min_registered to 0.1"
    with pytest.raises(DatasetError, match=message):
        datasets.read(root)
    assert len(datasets.read(root, min_registered=0.1).train) == 8


def test_images_missing_in_times_json_need_no_pose(flat):
    root, views = flat
    for k in range(90):
        picture(root / "images" / f"lost_{k:02d}.png")
    (root / "times.json").write_text(json.dumps({name: k for k, name in enumerate(views)}))
    assert len(datasets.read(root).train) > 0


@pytest.mark.parametrize("suffix, remedy", [(".heic", "convert it to PNG"), (".MP4", "r5dgs prepare")])
def test_files_of_unreadable_kinds_are_named_as_such(rig, suffix, remedy):
    root, _ = rig
    for k in range(9):
        for number in (6, 8, 12):
            path = root / "images" / f"cam{k}" / f"frame_{number:04d}.png"
            path.rename(path.with_suffix(suffix))
    kind = suffix.lower().removeprefix(".")
    message = rf"cam0/frame_\d+{suffix}: expected an image.*unreadable kind {kind}.*{remedy}"
    with pytest.raises(DatasetError, match=message):
        datasets.read(root)
    kinds = {4: ".png", 6: suffix}
    times = {f"cam{k}/frame_{number:04d}{kinds[number]}": number for k in range(9) for number in kinds}
    (root / "times.json").write_text(json.dumps(times))
    with pytest.raises(DatasetError, match=f"frame_0006{suffix}.*unreadable kind {kind}"):
        datasets.read(root)


def test_a_registered_image_that_is_missing_or_unreadable_is_not_left_out(rig):
    root, views = rig
    colmap_files.write(root / "sparse" / "0", {**views, "extra/a.png": camera(20), "extra/b.png": camera(21)}, POINTS)
    with pytest.raises(DatasetError, match=r"extra/a.png: the image is missing"):
        datasets.read(root)
    for name in ("a.png", "b.png"):
        picture(root / "images" / "extra" / name)
    assert len(datasets.read(root).train) == 7 * 4  # two of the nine cameras are held out
