"""Recordings without a calibration: cameras are reconstructed once and kept."""

import json
import shutil

import numpy as np
import pytest

from r5dgs_core import errors
from r5dgs_core.capture.calibration.calibration import CalibratedCamera, Calibration
from r5dgs_core.capture.calibration.formats import r5dgs_json
from r5dgs_core.capture.calibration.lens import Lens
from r5dgs_core.cli import main
from r5dgs_core.cli.commands import prepare as command
from r5dgs_core.data import dataset, images
from r5dgs_core.prepare import unknown_cameras
from tests.support.board_films import CHARUCO, POSES, films
from tests.support.room import pose_errors


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    """Folders of frames of a carried board."""
    folder = tmp_path_factory.mktemp("board") / "frames"
    for film in films(CHARUCO, times=8):
        for index, pixels in enumerate(film.frames):
            images.write_png(folder / film.name / f"{index:04d}.png", pixels)
    return folder


def prepared(source, out, **fields):
    command.run_prepare(source, out, sync="none", rate=10.0, **{"lines": 120, **fields})
    return dataset.read(out)


def unit(data):
    """Metres per unit of a data set."""
    return json.loads((data / "transforms_train.json").read_text())["meters_per_unit"]


@pytest.mark.slow
def test_a_board_replaces_the_calibration(recordings, tmp_path, monkeypatch):
    known = {"board": CHARUCO, "distance": ("cam0", "cam2", 0.5)}
    found = prepared(recordings, tmp_path / "data", unknown=known, up="board")
    cameras = {view.camera.name: np.linalg.inv(view.camera.T_cam_world) for view in found.train}
    shifts, angles = pose_errors([cameras[name] for name in sorted(cameras)], POSES)
    assert shifts.max() < 0.05 and angles.max() < 1.5
    apart = np.linalg.norm(cameras["cam0"][:3, 3] - cameras["cam2"][:3, 3])
    assert unit(tmp_path / "data") == pytest.approx(0.5 / apart)

    def refuse(*_, **__):
        raise AssertionError("reconstructed twice")

    monkeypatch.setattr(unknown_cameras.reconstruction, "reconstruct", refuse)
    again = prepared(recordings, tmp_path / "data", unknown=known, up="board")
    assert again.digest == found.digest
    with pytest.raises(AssertionError, match="reconstructed twice"):
        prepared(recordings, tmp_path / "data", unknown=known, overwrite=True)


@pytest.fixture()
def counted(monkeypatch, tmp_path):
    """Replace the reconstruction by cameras whose x is its number; returns a function that gives the number of runs."""
    runs = []

    def reconstruct(sources, *_):
        runs.append(sources)
        lens, pose = Lens("pinhole", 50.0, 50.0, 32.0, 24.0), np.eye(4)
        pose[0, 3] = len(runs)
        found = [CalibratedCamera(one.name, one.width, one.height, lens, pose) for one in sources]
        return Calibration(tuple(found), None, "", tmp_path)

    monkeypatch.setattr(unknown_cameras.reconstruction, "reconstruct", reconstruct)
    return lambda: len(runs)


def write_frames(folder, seed):
    rng = np.random.default_rng(seed)
    for path in [folder / f"cam{camera}" / f"{k:04d}.png" for camera in range(2) for k in range(3)]:
        images.write_png(path, rng.integers(0, 256, (48, 64, 3), np.uint8))
    return folder


def position(found):
    return found.train[0].camera.center[0]


def test_cameras_of_other_recordings_are_reconstructed_again(tmp_path, counted):
    """A user whose recording is damaged moves a camera, records again and repeats the command."""
    source, out = write_frames(tmp_path / "frames", 0), tmp_path / "data"
    damaged = source / "cam1" / "0001.png"
    damaged.write_bytes(damaged.read_bytes()[:100])
    for _ in range(2):  # equal recordings keep their cameras
        with pytest.raises(errors.DatasetError, match=r"cam1/0001\.png"):
            prepared(source, out)
        assert counted() == 1
    assert position(prepared(write_frames(source, 1), out)) == pytest.approx(counted()) == 2
    assert position(prepared(source, out)) == pytest.approx(counted()) == 2


def test_cameras_of_a_finished_data_set_are_kept_unless_it_is_replaced(tmp_path, counted):
    source, out = write_frames(tmp_path / "frames", 0), tmp_path / "data"
    prepared(source, out)
    kept = (out / unknown_cameras.FILE).read_bytes()
    write_frames(source, 1)
    with pytest.raises(errors.DatasetError, match=r"other input or settings \(recordings\)"):
        prepared(source, out)
    assert (out / unknown_cameras.FILE).read_bytes() == kept and counted() == 1
    assert position(prepared(source, out, overwrite=True)) == pytest.approx(counted()) == 2


def test_cameras_of_older_releases_belong_to_the_recordings_of_the_data_set(tmp_path, counted):
    source, out = write_frames(tmp_path / "frames", 0), tmp_path / "data"
    prepared(source, out)
    r5dgs_json.write(out / unknown_cameras.FILE, r5dgs_json.read(out / unknown_cameras.FILE))
    prepared(source, out)
    assert counted() == 1  # known from the record
    (tmp_path / "new").mkdir()
    shutil.copy(out / unknown_cameras.FILE, tmp_path / "new")
    prepared(source, tmp_path / "new")  # unknown, so not used
    assert counted() == 2


def test_a_folder_with_other_files_is_refused_before_cameras_are_reconstructed(tmp_path, counted):
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "notes.txt").write_text("mine")
    with pytest.raises(errors.DatasetError, match=r"found notes\.txt"):
        prepared(write_frames(tmp_path / "frames", 0), tmp_path / "data")
    assert counted() == 0


@pytest.mark.slow
def test_lenses_of_a_calibration_are_kept(recordings, tmp_path):
    prepared(recordings, tmp_path / "first", unknown={"board": CHARUCO})
    file = tmp_path / "first" / unknown_cameras.FILE
    found = prepared(recordings, tmp_path / "second", unknown={"board": CHARUCO, "lenses": file})
    lenses = {view.camera.name: view.camera.intrinsics for view in dataset.read(tmp_path / "first").train}
    for view in found.train:
        np.testing.assert_allclose(view.camera.intrinsics, lenses[view.camera.name])


@pytest.mark.slow
def test_scale_and_up_replace_those_of_a_calibration(recordings, tmp_path):
    prepared(recordings, tmp_path / "first", unknown={"board": CHARUCO})
    file = tmp_path / "first" / unknown_cameras.FILE
    plain = prepared(recordings, tmp_path / "second", calibration=file)
    turned = prepared(recordings, tmp_path / "third", calibration=file, up="0,0,-1", meters_per_unit=2.5)
    assert (unit(tmp_path / "second"), unit(tmp_path / "third")) == (1.0, 2.5)
    for a, b in zip(plain.train, turned.train, strict=True):
        assert b.camera.center[2] == pytest.approx(-a.camera.center[2])


def test_lenses_of_other_cameras_are_refused(recordings, tmp_path):
    (tmp_path / "calibration.toml").write_text(
        "[x]\nsize = [640, 480]\nmatrix = [[500, 0, 320], [0, 500, 240], [0, 0, 1]]\ndistortions = []\n"
        "rotation = [0, 0, 0]\ntranslation = [0, 0, 0]\n"
    )
    with pytest.raises(errors.DatasetError, match="expected lenses of cam0, cam1, cam2, found those of x"):
        prepared(recordings, tmp_path / "data", unknown={"board": CHARUCO, "lenses": tmp_path / "calibration.toml"})


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["--board", "paper"], "--board paper: expected charuco:COLUMNSxROWS"),
        (["--moving", "drone"], "cameras drone: unknown"),
        (["--distance", "cam0", "cam1", "far"], "--distance: expected metres, more than 0"),
        (["--distance", "cam0", "cam1", "nan"], "--distance: expected metres, more than 0"),
        (["--distance", "cam0", "cam0", "2"], "--distance: expected two cameras, found 'cam0' twice"),
        (["--up", "board"], "--up board: expected a board, found none; name it with --board"),
        (["--up", "plane", "--board", "charuco:5x4:0.1:0.075:4X4_50"], "--up plane: needs points"),
        (["--up", "north"], "--up north: expected cameras, plane, board, or a vector"),
        (["--words", "mug"], "--words mug: applies to --masks sam3, found --masks none"),
        (
            ["--masks", "folder", "--model", "sam"],
            "--model sam: applies to --masks sam2 and sam3, found --masks folder",
        ),
        (["--masks", "sam2"], "--masks sam2: name the folder of the model with --model DIR"),
        (["--masks", "sam2", "--model", "sam"], "--model sam: expected a folder of weights, found none"),
        (["--masks", "sam3", "--model", "."], "--masks sam3: name the objects with --words"),
        (["--offset", "cam0=nan"], "--offset cam0=nan: expected a camera and milliseconds"),
    ],
)
def test_wrong_options_are_refused(recordings, tmp_path, capsys, arguments, message):
    assert main.main(["prepare", str(recordings), "--out", str(tmp_path / "data"), *arguments]) != 0
    assert message in capsys.readouterr().err
    assert not (tmp_path / "data" / "images").exists()
