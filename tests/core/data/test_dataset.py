"""Reading data sets: both layouts, every optional entry of the files, and one clear error for each fault."""

import dataclasses
import json
import math
import re
import shutil

import hypothesis
import numpy as np
import pytest
from hypothesis import strategies as st

from r5dgs_core import errors
from r5dgs_core.data import dataset, images, memory, view_masks
from r5dgs_core.scene import cameras
from r5dgs_core.scene.units import Units

WIDTH, HEIGHT = 12, 8
ANGLE = 0.8


def camera_matrix(angle: float) -> list[list[float]]:
    """Camera to world with OpenGL axes, on a circle about the origin, looking at it."""
    back = np.array([math.cos(angle), math.sin(angle), 0.0])
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([np.cross([0, 0, 1], back), [0, 0, 1], back], axis=-1)
    matrix[:3, 3] = 3 * back
    return matrix.tolist()


def write_image(root, file_path: str, channels: int = 3, value: int = 100) -> None:
    images.write_png(root / f"{file_path}.png", np.full((HEIGHT, WIDTH, channels), value, np.uint8))


def write_json(path, content) -> None:
    path.write_text(json.dumps(content))


def write_flat(root, **extra) -> dict[str, dict]:
    """Two observed cameras at three times, a novel one in val, one later time in test; returns the camera files."""
    files = {}
    plan = {
        "train": [(k, t) for t in (0.0, 0.25, 0.5) for k in (0, 1)],
        "val": [(2, 0.25)],
        "test": [(0, 1.0), (2, 1.0)],
    }
    for split, views in plan.items():
        frames = []
        for i, (k, t) in enumerate(views):
            frames.append({"file_path": f"./{split}/r_{i:03d}", "time": t, "transform_matrix": camera_matrix(0.7 * k)})
            write_image(root, f"{split}/r_{i:03d}", value=10 * i + 5)
            ids = np.zeros((HEIGHT, WIDTH), np.uint8)
            ids[2:4, i : i + 3] = 1 + i % 2
            images.write_png(root / "object_mask" / split / f"r_{i:03d}.png", ids)
        files[split] = {"camera_angle_x": ANGLE, "frames": frames, **extra}
        write_json(root / f"transforms_{split}.json", files[split])
    write_json(root / "objects.json", {"1": "mug", "2": {"name": "red apple", "aliases": ["fruit"]}})
    return files


@pytest.fixture
def flat(tmp_path):
    write_flat(tmp_path)
    return tmp_path


def change(root, edit, split: str = "train"):
    """Change one camera file in place."""
    path = root / f"transforms_{split}.json"
    content = json.loads(path.read_text())
    edit(content)
    write_json(path, content)


def test_the_flat_layout_is_read(flat):
    data = dataset.read(flat)
    assert [len(data.train), len(data.val), len(data.test)] == [6, 1, 2]
    view = data.train[3]
    assert (view.name, view.t, view.split) == ("train/r_003", 0.25, "train")
    np.testing.assert_allclose(cameras.cam_world_to_opengl(view.camera.T_cam_world), camera_matrix(0.7), atol=1e-12)
    assert view.camera.intrinsics[0, 0] == pytest.approx(0.5 * WIDTH / math.tan(0.5 * ANGLE))
    assert (view.camera.width, view.camera.height) == (WIDTH, HEIGHT)
    assert data.object_names == {1: "mug", 2: "red apple"}
    assert data.object_aliases == {2: ("fruit",)}
    np.testing.assert_array_equal(data.times, [0.0, 0.25, 0.5])
    assert (data.t_max, data.frames_per_unit, data.world_convention) == (0.5, 60.0, "blender")
    assert data.ground_truth is None and not data.has_alpha


def test_views_of_one_camera_share_its_name_across_splits(flat):
    data = dataset.read(flat)
    assert [view.camera.name for view in data.train] == ["cam0", "cam1"] * 3
    assert [view.camera.name for view in data.test] == ["cam0", "cam2"]
    assert [camera.name for camera in data.cameras] == ["cam0", "cam1", "cam2"]


def test_named_cameras_keep_their_name_and_moving_ones_stay_distinct(flat):
    def edit(content):
        for i, frame in enumerate(content["frames"]):
            frame["view"] = "left" if i % 2 == 0 else "walk"
            if i == 5:
                frame["transform_matrix"] = camera_matrix(2.0)

    change(flat, edit)
    data = dataset.read(flat)
    assert [view.camera.name for view in data.train] == ["left", "walk", "left", "walk", "left", "walk@1"]


def test_generated_names_differ_from_the_given_ones(flat):
    names = ["cam0", "", "walk@1", "walk", "cam1", "walk"]

    def edit(content):
        for i, (frame, name) in enumerate(zip(content["frames"], names, strict=True)):
            frame["transform_matrix"] = camera_matrix(0.3 * i)
            if name:
                frame["view"] = name

    change(flat, edit)
    data = dataset.read(flat)
    assert [view.camera.name for view in data.train] == ["cam0", "cam2", "walk@1", "walk", "cam1", "walk@2"]
    assert len({camera.name for camera in data.cameras}) == len(data.cameras)


@pytest.mark.parametrize("scale", [1e-7, 1.0, 1e5])
@pytest.mark.parametrize("shift", [0.0, 20.0])
def test_the_identity_of_cameras_does_not_depend_on_the_unit_or_the_origin(flat, scale, shift):
    """Two cameras stand a hundredth of their distance from the scene apart; a third repeats one up to rounding."""
    positions = [
        (4.0, 0.0, 2.0),
        (4.0, 0.04, 2.0),
        (4.0, 1e-10, 2.0),
        (0.0, 4.0, 2.0),
        (-4.0, 0.0, 2.0),
        (0, -4.0, 2.0),
    ]

    def edit(content):
        for frame, position in zip(content["frames"], positions, strict=True):
            matrix = np.array(camera_matrix(0.0))
            matrix[:3, 3] = scale * (np.array(position) + shift)
            frame["transform_matrix"] = matrix.tolist()

    change(flat, edit)
    assert [view.camera.name for view in dataset.read(flat).train] == ["cam0", "cam1", "cam0", "cam2", "cam3", "cam4"]


def test_the_nested_layout_gives_the_same_views(flat, tmp_path_factory):
    root = tmp_path_factory.mktemp("nested")
    shutil.copytree(flat, root, dirs_exist_ok=True)
    for split in dataset.SPLITS:
        content = json.loads((root / f"transforms_{split}.json").read_text())
        parts = {}
        for frame in content["frames"]:
            key = json.dumps(frame["transform_matrix"])
            part = parts.setdefault(key, {"transform_matrix": frame["transform_matrix"], "frames": []})
            part["frames"].append({"file_path": frame["file_path"], "time": frame["time"]})
        nested = {f"camera{i}": part for i, part in enumerate(parts.values())}
        write_json(root / f"transforms_{split}.json", {"camera_angle_x": ANGLE, "data": nested})
    a, b = dataset.read(flat), dataset.read(root)
    for split in dataset.SPLITS:
        nested = {view.name: view for view in b.views(split)}
        assert set(nested) == {view.name for view in a.views(split)}
        for view in a.views(split):
            assert nested[view.name].t == view.t
            np.testing.assert_array_equal(nested[view.name].camera.T_cam_world, view.camera.T_cam_world)
            np.testing.assert_array_equal(nested[view.name].camera.intrinsics, view.camera.intrinsics)
    assert b.train[0].camera.name == "camera0"


def test_missing_times_are_spread_evenly(flat):
    change(flat, lambda content: [frame.pop("time") for frame in content["frames"]])
    np.testing.assert_allclose([view.t for view in dataset.read(flat).train], np.arange(6) / 5)


@pytest.mark.parametrize(
    ("suffix", "given"), [(".png", True), (".PNG", True), (".jpg", True), (".jpg", False), (".exr", False)]
)
def test_images_are_found_with_any_suffix_or_none(flat, suffix, given):
    source = flat / "train" / "r_000.png"
    target = source.with_suffix(suffix)
    if suffix.lower() == ".png":
        source.rename(target)
    else:
        import OpenImageIO as oiio

        oiio.ImageBuf(str(source)).write(str(target))
        source.unlink()
    change(flat, lambda content: content["frames"][0].update(file_path=f"train/r_000{suffix if given else ''}"))
    view = dataset.read(flat).train[0]
    assert view.name == "train/r_000"
    assert view.mask_path is not None
    assert dataset.load_image(view).shape == (HEIGHT, WIDTH, 3)


def test_intrinsics_of_the_file_take_precedence_and_are_scaled_to_the_image(flat):
    lens = {"fl_x": 40.0, "fl_y": 44.0, "cx": 11.0, "cy": 9.0, "w": 2 * WIDTH, "h": 2 * HEIGHT}
    change(flat, lambda content: content.update(lens))
    k = dataset.read(flat).train[0].camera.intrinsics
    np.testing.assert_allclose(k, [[20.0, 0, 5.5], [0, 22.0, 4.5], [0, 0, 1]])


def test_one_frame_may_have_its_own_lens(flat):
    change(flat, lambda content: content["frames"][2].update(camera_angle_x=1.1))
    views = dataset.read(flat).train
    assert views[2].camera.intrinsics[0, 0] == pytest.approx(0.5 * WIDTH / math.tan(0.55))
    assert views[2].camera.name != views[0].camera.name


@hypothesis.given(st.floats(0.01, 20.0), st.floats(0, 2 * math.pi))
def test_a_uniform_scale_of_the_camera_matrix_is_removed(scale, angle):
    from r5dgs_core.data import transforms

    matrix = np.array(camera_matrix(angle))
    scaled = matrix.copy()
    scaled[:3, :3] *= scale
    checked = transforms.rigid_matrix("here", scaled.tolist())
    expected = cameras.opengl_to_cam_world(matrix)
    np.testing.assert_allclose(cameras.opengl_to_cam_world(checked), expected, atol=1e-9)


def test_absent_splits_are_empty(flat):
    (flat / "transforms_val.json").unlink()
    (flat / "transforms_test.json").unlink()
    data = dataset.read(flat)
    assert data.val == data.test == ()


def test_masks_are_optional_view_by_view(flat):
    (flat / "object_mask" / "train" / "r_001.png").unlink()
    data = dataset.read(flat)
    assert dataset.load_mask(data.train[1]) is None
    assert set(np.unique(dataset.load_mask(data.train[0]))) == {0, 1}
    shutil.rmtree(flat / "object_mask")
    assert all(view.mask_path is None for view in dataset.read(flat).train)


def test_masks_of_another_size_are_resized_to_the_image(flat):
    small = np.arange(6, dtype=np.uint8).reshape(2, 3)
    images.write_png(flat / "object_mask" / "train" / "r_000.png", small)
    ids = dataset.load_mask(dataset.read(flat).train[0])
    np.testing.assert_array_equal(ids, np.repeat(np.repeat(small, 4, 0), 4, 1))


def test_masks_coded_by_colour_agree_between_splits(flat):
    for path in (flat / "object_mask").rglob("*.png"):  # which hold ids
        path.unlink()
    for split, color in (("train", (0, 0, 9)), ("test", (0, 0, 5))):
        pixels = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
        pixels[0, 0] = (0, 0, 9)
        pixels[0, 1] = color
        images.write_png(flat / "object_mask" / split / "r_000.png", pixels)
    data = dataset.read(flat)
    assert dataset.load_mask(data.train[0])[0, :2].tolist() == [2, 2]
    assert dataset.load_mask(data.test[0])[0, :2].tolist() == [2, 1]


def test_the_data_sets_own_masks_are_recognised_by_any_path(flat, tmp_path):
    """Colours are numbered over all splits then, too."""
    for path in (flat / "object_mask").rglob("*.png"):
        path.unlink()
    for split, color in (("train", (0, 0, 9)), ("test", (0, 0, 5))):
        images.write_png(flat / "object_mask" / split / "r_000.png", np.full((HEIGHT, WIDTH, 3), color, np.uint8))
    (tmp_path / "link").symlink_to(flat)
    for path in (flat / "object_mask", tmp_path / "link" / "object_mask", flat / "train" / ".." / "object_mask"):
        data = dataset.read(flat, str(path))
        assert (dataset.load_mask(data.train[0])[0, 0], dataset.load_mask(data.test[0])[0, 0]) == (2, 1)
        assert data.digest == dataset.read(flat).digest


def test_transparent_pixels_show_the_background(flat):
    pixels = np.zeros((HEIGHT, WIDTH, 4), np.uint8)
    pixels[..., 0], pixels[..., 3] = 200, 51
    images.write_png(flat / "train" / "r_000.png", pixels)
    data = dataset.read(flat)
    assert data.has_alpha
    np.testing.assert_allclose(dataset.load_rgba(data.train[0])[0, 0], np.array([200, 0, 0, 51]) / 255, atol=1e-6)
    white = dataset.load_image(data.train[0])
    np.testing.assert_allclose(white[0, 0], 0.2 * np.array([200 / 255, 0, 0]) + 0.8, atol=1e-6)
    black = dataset.load_image(data.train[0], np.zeros(3))
    np.testing.assert_allclose(black[0, 0], [0.2 * 200 / 255, 0, 0], atol=1e-6)


@pytest.mark.parametrize(
    ("hints", "expected"),
    [
        ({"frames_per_unit": 24}, 24.0),
        ({"fps": 30, "duration": 4.0}, 120.0),
        ({"fps": 30}, 60.0),
        ({}, 60.0),
    ],
)
def test_frames_per_unit_follows_the_hints(tmp_path, hints, expected):
    write_flat(tmp_path, **hints)
    assert dataset.read(tmp_path).frames_per_unit == expected


def test_frames_per_unit_follows_frame_numbers(flat):
    for split in dataset.SPLITS:
        change(
            flat,
            lambda content: [frame.update(frame=int(80 * frame["time"]) + 1) for frame in content["frames"]],
            split,
        )
    assert dataset.read(flat).frames_per_unit == pytest.approx(80.0)


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({}, Units()),
        ({"seconds_per_unit": 2.5, "meters_per_unit": None}, Units(2.5)),
        ({"meters_per_unit": 1}, Units(None, 1.0)),
    ],
)
def test_units_are_those_of_the_camera_file(tmp_path, given, expected):
    write_flat(tmp_path, **given)
    assert dataset.read(tmp_path).units == expected


@pytest.mark.parametrize("value", [0, -1, "one", True, 1e13])
def test_impossible_units_are_refused(tmp_path, value):
    write_flat(tmp_path, seconds_per_unit=value)
    with pytest.raises(errors.DatasetError, match="'seconds_per_unit' must be a positive number"):
        dataset.read(tmp_path)


def test_a_machine_without_memory_for_a_few_images_is_refused_with_the_remedy(flat, monkeypatch):
    found = dataset.read(flat)
    needed = memory.at_once(found)
    assert needed == sum(4 * view.camera.width * view.camera.height for view in found.train)
    monkeypatch.setattr(memory, "available", lambda: needed - 1)
    with pytest.raises(errors.DatasetError, match="GB of memory for . images at the same time.*smaller --size"):
        memory.check_images(found)
    for free in (None, needed):
        monkeypatch.setattr(memory, "available", lambda free=free: free)
        memory.check_images(found)
    with pytest.raises(errors.DatasetError, match="at the same time in each of 2 processes.*start fewer processes"):
        memory.check_images(found, processes=2)
    assert 1e6 < memory.total() < 1e15


def test_many_images_need_no_more_memory_than_allowed(flat, monkeypatch):
    found = dataset.read(flat)
    monkeypatch.setattr(memory, "available", lambda: 10 * memory.GB)
    assert (memory.for_images(2.0), memory.for_images(8.0)) == (2 * memory.GB, 5 * memory.GB)
    assert (memory.for_images(2.0, 2), memory.for_images(2.0, 5)) == (2 * memory.GB, memory.GB)
    many = dataclasses.replace(found, train=1000 * found.train)
    assert memory.at_once(many) <= 32 * memory.of_images(found)
    assert "images of 0.0 GB are read again while training" in memory.note(many, 1e-4)
    assert "data.memory=1 keeps all of them" in memory.note(many, 1e-4)
    assert memory.note(found, 1.0) == ""
    monkeypatch.setattr(memory, "available", lambda: memory.of_images(many))
    assert "all of them need more than half of what is free" in memory.note(many, 1e-4)


def test_the_digest_changes_with_cameras_and_images_only(flat):
    before = dataset.read(flat).digest
    assert dataset.read(flat).digest == before
    write_image(flat, "train/r_000", value=6)
    after_image = dataset.read(flat).digest
    change(flat, lambda content: content["frames"][0].update(time=0.01))
    assert len({before, after_image, dataset.read(flat).digest}) == 3


def ground_truth(times=(0.0, 0.25, 0.5, 1.0)) -> dict:
    matrices = [camera_matrix(t) for t in times]
    return {"t_max": 0.5, "times": list(times), "objects": [{"id": 3, "name": "car", "matrices": matrices}]}


def test_true_poses_are_read_and_name_their_objects(flat):
    write_json(flat / "ground_truth.json", ground_truth())
    data = dataset.read(flat)
    assert data.ground_truth.matrices.shape == (1, 4, 4, 4)
    assert data.ground_truth.object_ids == (3,) and data.object_names[3] == "car"


@pytest.mark.parametrize(
    "edit",
    [
        lambda content: content.pop("times"),
        lambda content: content["objects"][0]["matrices"].pop(),
        lambda content: content["objects"][0].update(id="three"),
        lambda content: content.update(times=[0.0, 0.5, 0.25, 1.0]),
        lambda content: content.update(objects=content["objects"] * 2),
        lambda content: content["objects"][0]["matrices"][1][0].__setitem__(0, math.nan),
    ],
)
def test_faulty_true_poses_are_one_clear_error(flat, edit):
    content = ground_truth()
    edit(content)
    write_json(flat / "ground_truth.json", content)
    with pytest.raises(errors.DatasetError, match=r"ground_truth\.json: "):
        dataset.read(flat)


def mirrored(frame):
    frame["transform_matrix"] = (np.array(frame["transform_matrix"]) @ np.diag([-1.0, 1, 1, 1])).tolist()


def sheared(frame):
    frame["transform_matrix"][0][1] += 0.3


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda frame: frame.pop("file_path"), "frame 2: expected an object with a 'file_path'"),
        (lambda frame: frame.update(file_path="train/gone"), r"frame 2 \(train/gone\): the image is missing"),
        (lambda frame: frame.update(file_path="train/r_001"), r"frame 2 .*listed twice"),
        (lambda frame: frame.pop("time"), "frame 2 has no 'time'"),
        (lambda frame: frame.update(time="noon"), "frame 2 .*'time' must be a finite number, found 'noon'"),
        (lambda frame: frame.update(time=math.nan), "frame 2 .*'time' must be a finite number, found nan"),
        (lambda frame: frame.pop("transform_matrix"), "frame 2 .*'transform_matrix' is missing"),
        (lambda frame: frame.update(transform_matrix=[[1, 2], [3]]), "frame 2 .*4x4"),
        (lambda frame: frame["transform_matrix"][0].__setitem__(0, math.nan), "frame 2 .*holds NaN"),
        (lambda frame: frame.update(transform_matrix=np.zeros((4, 4)).tolist()), "frame 2 .*not a rigid"),
        (sheared, "frame 2 .*not rigid"),
        (mirrored, "frame 2 .*mirrors"),
        (lambda frame: frame.update(camera_angle_x=4.0), "frame 2 .*radians"),
        (lambda frame: frame.update(k1=0.1), "frame 2 .*distortion"),
        (lambda frame: frame.update(w=100, h=20, fl_x=50), "frame 2 .*the image is 12x8, but 'w' and 'h' are 100x20"),
        (lambda frame: frame.update(fl_x=-3.0), "frame 2 .*positive"),
    ],
)
def test_a_faulty_frame_is_one_clear_error(flat, edit, message):
    change(flat, lambda content: edit(content["frames"][2]))
    with pytest.raises(errors.DatasetError, match=rf"transforms_train\.json.*{message}"):
        dataset.read(flat)


@pytest.mark.parametrize(
    "edit",
    [
        lambda content: content["frames"][1].update(p1=0.01),
        lambda content: content.update(k1=0.1),
        lambda content: content.update(camera_model="OPENCV_FISHEYE"),
        lambda content: content.update(is_fisheye=True),
    ],
)
def test_distorted_cameras_are_refused_with_the_command_that_undistorts(flat, edit):
    change(flat, edit)
    with pytest.raises(
        errors.DatasetError, match=rf"Remedy: r5dgs prepare {re.escape(str(flat))} --out {re.escape(str(flat))}_data"
    ):
        dataset.read(flat)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ('{"frames": [', "line 1, column"),
        ("[]", "expected a JSON object"),
        ('{"camera_angle_x": 1}', "expected 'frames'"),
        ('{"frames": []}', "at least one frame"),
        ('{"data": {"a": {}}}', r"data\['a'\]"),
    ],
)
def test_a_faulty_camera_file_is_one_clear_error(flat, content, message):
    (flat / "transforms_train.json").write_text(content)
    with pytest.raises(errors.DatasetError, match=rf"transforms_train\.json.*{message}"):
        dataset.read(flat)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ([], "expected an object"),
        ({"mug": "1"}, "object ids as keys"),
        ({"1": {"label": "mug"}}, "expected a name"),
        ({"1": "mug", "2": "mug"}, "used twice"),
    ],
)
def test_faulty_object_names_are_one_clear_error(flat, content, message):
    write_json(flat / "objects.json", content)
    with pytest.raises(errors.DatasetError, match=rf"objects\.json: .*{message}"):
        dataset.read(flat)


def test_folders_that_are_not_data_sets_raise(tmp_path):
    with pytest.raises(errors.DatasetError, match="found nothing"):
        dataset.read(tmp_path / "nowhere")
    with pytest.raises(errors.DatasetError, match=r"transforms_train\.json: the file is missing"):
        dataset.read(tmp_path)
    write_json(tmp_path / "transforms.json", {})
    with pytest.raises(errors.DatasetError, match="r5dgs prepare"):
        dataset.read(tmp_path)


def test_an_image_that_changed_since_reading_is_noticed(flat):
    data = dataset.read(flat)
    images.write_png(flat / "train" / "r_000.png", np.zeros((4, 4, 3), np.uint8))
    with pytest.raises(errors.DatasetError, match="the image changed"):
        dataset.load_image(data.train[0])


def test_a_data_set_is_immutable(flat):
    with pytest.raises(dataclasses.FrozenInstanceError):
        dataset.read(flat).name = "other"


def test_training_masks_may_come_from_another_folder(flat, tmp_path_factory):
    folder = tmp_path_factory.mktemp("masks")
    name = dataset.read(flat).train[0].name
    images.write_png(folder / f"{name}.png", np.full((HEIGHT, WIDTH), 7, np.uint8))
    own, other, without = dataset.read(flat), dataset.read(flat, str(folder)), dataset.read(flat, view_masks.NO_MASKS)
    assert (dataset.load_mask(other.train[0]) == 7).all()
    assert [view.mask_path for view in other.train[1:]] == [None] * (len(own.train) - 1)
    assert all(view.mask_path is None for view in without.train)
    for some in (other, without):  # held-out masks do not change
        assert [view.mask_path for view in some.test] == [view.mask_path for view in own.test] != [None, None]
    assert other.object_names == own.object_names
    assert len({own.digest, other.digest, without.digest}) == 3


def test_a_folder_of_masks_with_its_own_names_has_its_own_ids(flat, tmp_path_factory):
    write_json(flat / "ground_truth.json", {"times": [0.0], "t_max": 0.5, "objects": []})
    folder = tmp_path_factory.mktemp("masks")
    write_json(folder / "objects.json", {"3": "cup"})
    with pytest.raises(errors.DatasetError, match=r"expected masks such as .*\.png, found none"):
        dataset.read(flat, str(folder))
    shutil.copytree(flat / "object_mask" / "train", folder / "train")
    other = dataset.read(flat, str(folder))
    assert other.object_names == {3: "cup"}
    assert other.ground_truth is None and dataset.read(flat).ground_truth is not None


def test_a_folder_of_masks_that_is_missing_is_an_error(flat):
    with pytest.raises(errors.DatasetError, match=r"nowhere: no such folder of masks; give another with --masks"):
        dataset.read(flat, "nowhere")


@pytest.mark.parametrize("listed", ["./train/r_000", "./train/r_000.heic"])
def test_an_image_of_an_unreadable_kind_is_named_as_such(tmp_path, listed):
    files = write_flat(tmp_path)
    image = tmp_path / "train" / "r_000.png"
    image.rename(image.with_suffix(".heic"))
    files["train"]["frames"][0]["file_path"] = listed
    write_json(tmp_path / "transforms_train.json", files["train"])
    message = r"expected an image, found r_000.heic, of the unreadable kind heic. Remedy: convert it to PNG or JPEG"
    with pytest.raises(errors.DatasetError, match=message):
        dataset.read(tmp_path)
