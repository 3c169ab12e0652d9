"""Scale and up of a reconstructed world."""

from pathlib import Path

import numpy as np
import pytest

from r5dgs_core import errors
from r5dgs_core.capture.calibration.calibration import CalibratedCamera, Calibration
from r5dgs_core.capture.calibration.lens import Lens
from r5dgs_core.capture.reconstruction import gauge
from tests.support.projections import rotation

LENS = Lens("pinhole", 300.0, 300.0, 160.0, 120.0)
TURN = rotation(8, 2.0)  # from a world with z up to the world of the cameras


def calibration(tilt: float = 0.0, points: np.ndarray | None = None) -> Calibration:
    """Two cameras that look along the y axis of a world with z up, tilted down by an angle in rad."""
    cameras = []
    for k in range(2):
        upright = np.array([[1.0, 0, 0], [0, np.sin(-tilt), np.cos(tilt)], [0, -np.cos(tilt), np.sin(-tilt)]])
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = TURN @ upright, TURN @ [2.0 * k, 0.0, 1.0]
        cameras.append(CalibratedCamera("ab"[k], 320, 240, LENS, pose))
    return Calibration(tuple(cameras), None, "features", Path(), points=None if points is None else points @ TURN.T)


def up_error(found: Calibration, tilt: float = 0.0) -> float:
    """Angle between z and the true up, in degrees."""
    turn = found.cameras[0].camera_to_world[:3, :3] @ calibration(tilt).cameras[0].camera_to_world[:3, :3].T
    assert found.world_convention == "blender"
    return float(np.degrees(np.arccos(np.clip((turn @ TURN)[2, 2], -1, 1))))


def test_the_distance_of_two_cameras_gives_the_scale():
    assert gauge.with_distance(calibration(), "a", "b", 0.5).meters_per_unit == pytest.approx(0.25)


@pytest.mark.parametrize("names, meters", [(("a", "c"), 1.0), (("a", "a"), 1.0), (("a", "b"), -1.0)])
def test_impossible_distances_are_refused(names, meters):
    with pytest.raises(errors.DatasetError, match="distance: "):
        gauge.with_distance(calibration(), *names, meters)


def test_level_cameras_give_the_up():
    assert up_error(gauge.upright(calibration(), "cameras")) < 1e-5


def test_a_plane_gives_the_up_where_cameras_are_tilted():
    rng = np.random.default_rng(0)
    floor = np.concatenate([rng.uniform(-2, 2, (200, 2)), rng.normal(0, 1e-3, (200, 1))], 1)
    wall = np.concatenate([rng.uniform(-2, 2, (300, 1)), np.full((300, 1), 3.0), rng.uniform(0, 3, (300, 1))], 1)
    tilted = calibration(0.4, np.concatenate([floor, wall, rng.uniform(-2, 2, (100, 3))]))
    assert up_error(gauge.upright(tilted, "plane"), 0.4) < 0.5
    assert up_error(gauge.upright(tilted, "cameras"), 0.4) > 20


def test_a_resting_board_gives_the_up():
    boards = []
    for k in range(9):  # it lies at five of nine times
        pose = np.eye(4)
        pose[:3, :3] = TURN @ np.diag([1.0, -1.0, -1.0]) if k < 5 else rotation(20 + k, 1.5)
        boards.append(pose)
    assert up_error(gauge.upright(calibration(0.4), "board", boards), 0.4) < 1e-5


@pytest.mark.parametrize("scale", [1.0, 7.0])
def test_a_vector_is_the_up(scale):
    vector = ",".join(str(value) for value in scale * TURN[:, 2])
    assert up_error(gauge.upright(calibration(0.4), vector), 0.4) < 1e-5
    opposite = Calibration(calibration().cameras, None, "features", Path()).moved(TURN.T, np.zeros(3), 1.0)
    flipped = gauge.upright(opposite, "0,0,-1")
    assert np.allclose(flipped.cameras[0].camera_to_world[2, :3], -opposite.cameras[0].camera_to_world[2, :3])


@pytest.mark.parametrize(
    "up, error, message",
    [
        ("sideways", errors.ConfigError, "expected cameras, plane, board, or a vector"),
        ("0,0,0", errors.ConfigError, "expected cameras, plane, board, or a vector"),
        ("plane", errors.DatasetError, "expected points of a reconstruction"),
        ("board", errors.DatasetError, "expected sightings of a board"),
    ],
)
def test_an_up_that_cannot_be_found_is_refused(up, error, message):
    with pytest.raises(error, match=message):
        gauge.upright(calibration(), up)
