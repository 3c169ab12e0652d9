"""Recordings become a data set: images, cameras, times, masks, record; resumable, reproducible, refused in words."""

import dataclasses
import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from r5dgs_core import errors
from r5dgs_core.capture.calibration import undistort
from r5dgs_core.capture.calibration.calibration import CalibratedCamera, CalibratedFrame, Calibration
from r5dgs_core.capture.calibration.formats import r5dgs_json
from r5dgs_core.cli.commands import prepare as command
from r5dgs_core.config.sections.training import DataSection
from r5dgs_core.data import dataset, images, masks
from r5dgs_core.prepare import camera_source, image_size, prepare, rectify
from tests.support import recordings
from tests.support.prepared_data import content, prepared

WIDTH, HEIGHT, COEFFICIENTS, COUNT = (
    recordings.TINY_WIDTH,
    recordings.TINY_HEIGHT,
    recordings.COEFFICIENTS,
    recordings.TINY_FRAMES,
)
RIG = recordings.tiny_rig()


@pytest.fixture(scope="module")
def data(capture, tmp_path_factory):
    out = tmp_path_factory.mktemp("data") / "data"
    prepared(capture, out, lossless=True)
    return out


def test_images_are_those_of_pinhole_cameras_at_their_times(data):
    found = dataset.read(data)
    assert len(found.train) == 3 * COUNT and found.t_max == pytest.approx(0.8)
    rig = recordings.tiny_rig()
    for view in found.train[:: COUNT + 1]:
        number = rig.names.index(view.camera.name)
        np.testing.assert_allclose(view.camera.T_cam_world, rig.cameras[number].T_cam_world, atol=1e-6)
        pinhole = undistort.undistortion(rig.lenses[number], (WIDTH, HEIGHT))
        np.testing.assert_allclose(view.camera.intrinsics, pinhole.intrinsics, rtol=1e-9)
        t = view.t * 0.5 / found.t_max  # seconds
        wanted = recordings.draw_tiny(rig.cameras[number], rig.lenses[number], t)
        off = images.read(view.image_path) - pinhole.apply(wanted) / 255
        assert np.sqrt(np.mean(np.square(off))) < 0.035  # compression


def test_the_record_has_the_input_and_the_camera_files_have_the_units(data):
    record = json.loads((data / "capture.json").read_text())
    assert record["finished"] and [camera["name"] for camera in record["cameras"]] == ["cam0", "cam1", "cam2"]
    assert record["cameras"][0]["used"] == record["cameras"][0]["frames"] == COUNT
    assert record["calibration"]["format"] == "anipose"
    top = json.loads((data / "transforms_train.json").read_text())
    assert top["seconds_per_unit"] == pytest.approx(0.5 / 0.8) and top["meters_per_unit"] is None
    assert top["frames_per_unit"] == pytest.approx(10 * 0.5 / 0.8)


def test_the_record_has_the_findings_of_the_check_with_relative_places(data):
    checks = json.loads((data / "capture.json").read_text())["checks"]
    assert "D72" in {row["code"] for row in checks}  # the clocks were not compared
    assert not any(str(data) in value for row in checks for value in row.values())
    assert {row["severity"] for row in checks} == {"warning"}


def test_two_runs_are_equal_bit_for_bit(capture, tmp_path):
    for name in ("one", "two"):
        prepared(capture, tmp_path / name, lines=36)
    assert content(tmp_path / "one") == content(tmp_path / "two")
    assert len(list((tmp_path / "one").rglob("*.jpg"))) == 3 * COUNT


def test_nothing_outside_the_output_is_written(capture, tmp_path):
    before = content(capture)
    prepared(capture, tmp_path / "data", lines=36)
    assert content(capture) == before and {path.name for path in tmp_path.iterdir()} == {"data"}


def test_the_next_command_follows_the_findings(capture, tmp_path, capsys):
    out = tmp_path / "my data"
    command.run_prepare(capture, out, sync="none", lines=36, progress_kind="auto")
    *before, last = capsys.readouterr().out.splitlines()
    assert last == f"written: {out}. Next: r5dgs train '{out}' --out RUN --scene SCENE.r5dgs"
    assert [line for line in before if line.startswith("D72 warning")]
    assert len([line for line in before if line.startswith(f"images {3 * COUNT} of")]) == 1


def test_json_progress_has_the_findings(capture, tmp_path, capsys):
    command.run_prepare(capture, tmp_path / "data", sync="none", lines=36, progress_kind="json")
    events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert events[-1]["event"] == "checked"
    assert events[-1]["findings"] == json.loads((tmp_path / "data" / "capture.json").read_text())["checks"] != []


def test_a_folder_among_the_recordings_is_refused(capture):
    for out in (capture, capture / "data", capture / "cam0" / "data"):
        with pytest.raises(errors.ConfigError, match="is among the recordings"):
            prepared(capture, out)


def test_a_capture_without_features_is_complete_but_for_its_masks(capture, tmp_path, capsys):
    with pytest.raises(
        errors.DatasetError, match=r"no rigid body moves.*--masks sam2.*The data set without masks is complete"
    ):
        prepared(capture, tmp_path / "data", masks="features", progress_kind="auto")
    assert "Next:" not in capsys.readouterr().out
    assert "checks" in json.loads((tmp_path / "data" / "capture.json").read_text())
    assert all(view.mask_path is None for view in dataset.read(tmp_path / "data").train)


def test_masks_of_the_frames_are_undistorted_like_them(capture, tmp_path):
    folder = tmp_path / "masks"
    for name in ("cam0", "cam1", "cam2"):
        for k in range(COUNT):
            ids = np.zeros((HEIGHT, WIDTH), np.uint8)
            ids[20:50, 30:70] = 3
            images.write_png(folder / name / f"frame_{k + 1:04d}.png", ids)
    (folder / "objects.json").write_text(json.dumps({"3": "box"}))
    found = prepared(capture, tmp_path / "data", masks=str(folder), hold_out={"every": 3})
    assert found.object_names == {3: "box"} and len(found.val) == 3
    rig = recordings.tiny_rig()
    pinhole = undistort.undistortion(rig.lenses[0], (WIDTH, HEIGHT))
    square = np.zeros((HEIGHT, WIDTH), np.float32)
    square[20:50, 30:70] = 1
    wanted = cv2.remap(square, pinhole.map_x, pinhole.map_y, cv2.INTER_LINEAR) > 0.5
    for view in (*found.train, *found.val):
        ids = dataset.load_mask(view)
        assert ids is not None and set(np.unique(ids)) == {0, 3}
        if view.camera.name == "cam0":
            assert ((ids == 3) != wanted).mean() < 0.01


def test_options_of_unknown_cameras_beside_a_calibration_are_refused(capture, tmp_path):
    with pytest.raises(errors.UsageError, match="--board.*remove the calibration"):
        prepared(capture, tmp_path / "data", unknown={"shared_lens": True})


def write_masks(folder, names):
    """Write a mask of id k + 1 for each frame k, by its name."""
    for camera in ("cam0", "cam1", "cam2"):
        for k, name in names.items():
            images.write_png(folder / camera / f"{name}.png", np.full((HEIGHT, WIDTH), k + 1, np.uint8))
    return str(folder)


@pytest.mark.parametrize("name", ["frame_{:03d}", "{:06d}"])
@pytest.mark.parametrize("first", [0, 1])
def test_masks_of_few_frames_belong_to_their_frames(capture, tmp_path, name, first):
    end = COUNT - 1 if first else 0
    folder = write_masks(tmp_path / "masks", {k: name.format(k + first) for k in (3, end)})
    found = prepared(capture, tmp_path / "data", masks=folder)
    ids = [dataset.load_mask(view) for view in found.train if view.camera.name == "cam0"]
    assert {k: one.max() for k, one in enumerate(ids) if one is not None} == {3: 4, end: end + 1}


def test_masks_that_may_be_numbered_from_0_or_1_are_refused(capture, tmp_path):
    folder = write_masks(tmp_path / "masks", {3: "frame_4"})
    with pytest.raises(errors.DatasetError, match=r"frame_4\.png may be numbered from 0 or from 1.*000000\.png"):
        prepared(capture, tmp_path / "data", masks=folder)


def test_pixels_beyond_the_frame_are_unknown_in_masks():
    lens = recordings.make_rig(1, WIDTH, HEIGHT, COEFFICIENTS).lenses[0]
    whole = undistort.undistortion(lens, (WIDTH, HEIGHT), field=1.0)
    made = rectify.Rectifier(whole, WIDTH, HEIGHT).mask(np.full((HEIGHT, WIDTH), 2), "mask")
    assert set(np.unique(made)) == {2, masks.UNKNOWN}
    np.testing.assert_array_equal(made == masks.UNKNOWN, ~whole.known)


def test_frames_as_images_give_the_same_data_set_as_their_video(capture, tmp_path, data):
    frames = tmp_path / "frames"
    for camera in ("cam0", "cam1", "cam2"):
        (source,) = prepare.cameras.source_files.find(capture / f"{camera}.mp4")
        for index, pixels in camera_source.open_camera(source).read(range(COUNT)):
            images.write_png(frames / camera / f"{index:06d}.png", pixels)
    shutil.copy(capture / "calibration.toml", frames)
    prepared(frames, tmp_path / "data", lossless=True, rate=10.0)
    one, other = content(tmp_path / "data"), content(data)
    del one[next(p for p in one if p.name == "capture.json")], other[next(p for p in other if p.name == "capture.json")]
    assert set(one) == set(other)
    assert all(one[path] == other[path] for path in one if path.suffix == ".png")


ZOOM = [
    dataclasses.replace(recordings.make_rig(1, WIDTH, HEIGHT, COEFFICIENTS).lenses[0], fx=f, fy=f) for f in (80, 99)
]


def write_zooming(folder, lenses):
    """Write a frame for each lens, and the calibration; returns the frames."""
    rng = np.random.default_rng(0)
    pictures = [rng.integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8) for _ in lenses]
    names = [Path("cam0") / f"{k:04d}.png" for k in range(len(lenses))]
    for name, pixels in zip(names, pictures, strict=True):
        images.write_png(folder / name, pixels)
    frames = tuple(CalibratedFrame(name, None, lens, np.eye(4)) for name, lens in zip(names, lenses, strict=True))
    camera = CalibratedCamera("cam0", WIDTH, HEIGHT, lenses[0], np.eye(4), frames)
    r5dgs_json.write(folder / r5dgs_json.FILES, Calibration((camera,), 1.0, "", folder))
    return pictures


def test_each_frame_of_a_zooming_camera_is_undistorted_with_its_own_lens(tmp_path):
    lenses = [ZOOM[0], ZOOM[0], ZOOM[1]]
    pictures = write_zooming(tmp_path / "frames", lenses)
    found = prepared(tmp_path / "frames", tmp_path / "data", lossless=True, rate=10.0)
    for view, lens, pixels in zip(found.train, lenses, pictures, strict=True):
        pinhole = undistort.undistortion(lens, (WIDTH, HEIGHT))
        np.testing.assert_allclose(view.camera.intrinsics, pinhole.intrinsics, rtol=1e-9)
        np.testing.assert_allclose(images.read(view.image_path) * 255, pinhole.apply(pixels), atol=1e-3)


def test_other_lenses_of_later_frames_and_other_units_need_overwrite(tmp_path):
    write_zooming(tmp_path / "frames", [ZOOM[0], ZOOM[1], ZOOM[1]])
    prepared(tmp_path / "frames", tmp_path / "data", rate=10.0)
    with pytest.raises(errors.DatasetError, match=r"other input or settings \(scale\)"):
        prepared(tmp_path / "frames", tmp_path / "data", rate=10.0, meters_per_unit=2.0)
    write_zooming(tmp_path / "frames", [ZOOM[0], ZOOM[1], ZOOM[0]])
    with pytest.raises(errors.DatasetError, match=r"other input or settings \(calibration\)"):
        prepared(tmp_path / "frames", tmp_path / "data", rate=10.0)


def test_the_calibration_of_other_cameras_is_refused(capture, tmp_path):
    shutil.copytree(capture, tmp_path / "videos")
    (tmp_path / "videos" / "cam2.mp4").rename(tmp_path / "videos" / "side.mp4")
    with pytest.raises(
        errors.DatasetError, match="expected .* cam1, side, found cam0, cam1, cam2; no camera matches side"
    ):
        prepared(tmp_path / "videos", tmp_path / "data")
    assert not (tmp_path / "data").exists()


def test_cameras_that_cannot_be_reconstructed_are_named_with_the_options(capture, tmp_path):
    shutil.copy(capture / "cam0.mp4", tmp_path)
    with pytest.raises(errors.DatasetError, match="cam0.*Remedy: .*--board.*--calibration"):
        prepared(tmp_path, tmp_path.with_name("out"))


def test_recordings_of_different_lengths_are_cut_and_named(capture, tmp_path):
    shutil.copytree(capture, tmp_path / "videos")
    frames = [recordings.draw_tiny(RIG.cameras[0], RIG.lenses[0], k / 10) for k in range(3)]
    recordings.write_video(tmp_path / "videos" / "cam0.mp4", frames, np.arange(3) / 10)
    plan = command.run_prepare(tmp_path / "videos", tmp_path / "data", sync="none")
    assert [len(indices) for indices in plan.choice.indices] == [3, 3, 3]
    assert plan.notes[0] == "cam1, cam2: up to 0.30 s are not used, because cam0 ends earlier"


def test_frames_that_cannot_be_decoded_are_left_out_and_listed(capture, tmp_path, monkeypatch):
    read = camera_source.CameraSource.read
    without = lambda self, wanted: (item for item in read(self, wanted) if item[0] != 2 or self.name != "cam1")  # noqa: E731
    monkeypatch.setattr(camera_source.CameraSource, "read", without)
    found = prepared(capture, tmp_path / "data", lines=36)
    assert len(found.train) == 3 * COUNT - 1
    record = json.loads((tmp_path / "data" / "capture.json").read_text())
    assert [camera["undecodable"] for camera in record["cameras"]] == [[], [2], []]
    assert [camera["used"] for camera in record["cameras"]] == [COUNT, COUNT - 1, COUNT]
    note = f"1 of {COUNT} frames cannot be decoded and are left out, the first is frame 2; copy the recording again"
    assert record["cameras"][1]["notes"] == [note]
    plan = command.run_prepare(capture, tmp_path / "data", sync="none", lines=36)
    lines = command.summary(plan)
    assert f"  {note}" in lines
    assert lines[1].startswith(f"cam1: {COUNT - 1} of {COUNT} frames")


def test_calibrated_cameras_without_a_recording_are_named(capture, tmp_path):
    shutil.copytree(capture, tmp_path / "videos")
    (tmp_path / "videos" / "cam1.mp4").unlink()
    plan = command.run_prepare(tmp_path / "videos", tmp_path / "data", sync="none", lines=36)
    assert "cam1: calibrated, but without a recording" in command.summary(plan)


def test_messages_name_at_most_five_cameras():
    names = [f"cam{k}" for k in range(7)]
    assert prepare._listed(names) == "cam0, cam1, cam2, cam3, cam4 and 2 more"
    assert prepare._listed(names[:5]) == "cam0, cam1, cam2, cam3, cam4"


def test_the_estimate_counts_no_more_pixels_than_training_keeps():
    assert DataSection().memory * 2**30 == image_size.PIXELS
    few, many = (image_size.training_memory([(1920, 1080)], [count], 1080) for count in (10_000, 20_000))
    assert few == many


def test_the_size_is_the_largest_whose_training_fits_half_of_the_memory(monkeypatch):
    monkeypatch.setattr(image_size.memory, "total", lambda: 8e9)
    sizes, counts = [(3840, 2160)] * 24, [300] * 24
    size = image_size.choose(sizes, counts, None)
    memory = [image_size.training_memory(sizes, counts, lines) for lines in (size.lines, size.lines + 8)]
    assert memory[0] <= 4e9 < memory[1] and size.training_bytes == memory[0]
    assert image_size.choose([(640, 480)], [10], None).lines == 480
    assert image_size.choose([(3840, 2160)], [10], None).lines == 960


def test_a_data_set_with_errors_is_not_recommended_for_training(capture, tmp_path, capsys):
    with pytest.raises(errors.DatasetError, match="cannot be trained: D23 error.*seconds_per_unit"):
        prepared(capture, tmp_path / "data", lines=36, hold_out={"horizon": 1e12}, progress_kind="auto")
    assert "Next: r5dgs train" not in capsys.readouterr().out
