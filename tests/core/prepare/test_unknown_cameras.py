"""Recordings without a calibration: cameras are reconstructed once and kept."""

import json

import numpy as np
import pytest

from r5dgs_core import errors
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
    command.run_prepare(source, out, sync="none", rate=10.0, lines=120, **fields)
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
        (["--distance", "cam0", "cam1", "far"], "--distance: expected metres"),
        (["--up", "north"], "--up north: expected cameras, plane, board, or a vector"),
        (["--words", "mug"], "--words mug: applies to --masks sam3, found --masks none"),
        (
            ["--masks", "folder", "--model", "sam"],
            "--model sam: applies to --masks sam2 and sam3, found --masks folder",
        ),
    ],
)
def test_wrong_options_are_refused(recordings, tmp_path, capsys, arguments, message):
    assert main.main(["prepare", str(recordings), "--out", str(tmp_path / "data"), *arguments]) != 0
    assert message in capsys.readouterr().err
