"""Undistortion maps against OpenCV's, and the choice of the pinhole camera."""

import cv2
import numpy as np
import pytest

from r5dgs_core.capture.calibration.lens import Lens
from r5dgs_core.capture.calibration.undistort import undistortion

SIZE = 320, 180
BARREL = Lens.from_opencv(
    np.array([[226.0, 0, 154.5], [0, 227.0, 98.5], [0, 0, 1]]), (-0.332, 0.046, -0.004, 0.004, 0.067)
)
PINCUSHION = Lens.from_opencv(
    np.array([[163.0, 0, 162.0], [0, 164.0, 98.0], [0, 0, 1]]), (0.18, -0.256, 0.003, 0.002, 0.124)
)
FISHEYE = Lens("fisheye", 75.0, 75.0, 160.0, 90.0, (0.02, -0.01, 0.0, 0.0))


def opencv_matrix(intrinsics: np.ndarray) -> np.ndarray:
    return intrinsics - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]


@pytest.mark.parametrize("lens", [BARREL, PINCUSHION])
@pytest.mark.parametrize("field", [0.0, 1.0])
def test_maps_agree_with_opencv(lens, field):
    new = undistortion(lens, SIZE, field=field)
    matrices = opencv_matrix(lens.intrinsics), opencv_matrix(new.intrinsics)
    x, y = cv2.initUndistortRectifyMap(matrices[0], np.array(lens.coefficients), None, matrices[1], SIZE, cv2.CV_32FC1)
    assert np.abs(new.map_x - x)[new.known].max() < 1e-3 and np.abs(new.map_y - y)[new.known].max() < 1e-3


@pytest.mark.parametrize("lens", [BARREL, PINCUSHION, FISHEYE])
def test_the_default_view_has_square_pixels_and_no_unknown_ones(lens):
    new = undistortion(lens, SIZE)
    assert new.known.all() and new.intrinsics[0, 0] == new.intrinsics[1, 1]
    tight = np.array([new.map_x.min(), new.map_y.min(), SIZE[0] - 1 - new.map_x.max(), SIZE[1] - 1 - new.map_y.max()])
    assert (tight > -1e-3).all()
    if lens is not FISHEYE:
        assert tight.min() < 0.5  # larger views would leave the source


@pytest.mark.parametrize("lens", [BARREL, PINCUSHION])
def test_the_full_view_holds_all_of_the_source_and_marks_the_rest(lens):
    new = undistortion(lens, SIZE, field=1.0)
    assert 0.5 < new.known.mean() < 1.0
    border = np.array([[x, y] for x in (0.5, 80, 160, 319.5) for y in (0.5, 90, 179.5)])
    seen = Lens("pinhole", *new.intrinsics[[0, 1, 0, 1], [0, 1, 2, 2]]).project(lens.unproject(border))
    assert (seen > 0).all() and (seen < SIZE).all()


def test_a_fisheye_view_ends_at_sixty_degrees():
    new = undistortion(FISHEYE, SIZE)
    assert SIZE[0] / 2 / new.intrinsics[0, 0] <= np.tan(np.radians(60)) * 1.01


def test_pixels_at_which_the_image_folds_over_are_unknown():
    folded = Lens("brown", 130.0, 130.0, 160.0, 90.0, (-0.3, 0.0, 0.0, 0.0))
    new = undistortion(folded, SIZE, field=1.0)
    assert not new.known[0, 0] and not new.known[-1, -1] and new.known[90, 160]
    x, y = np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5)
    focal, cx, cy = new.intrinsics[0, 0], new.intrinsics[0, 2], new.intrinsics[1, 2]
    r = np.hypot((x - cx) / focal, (y - cy) / focal)
    assert r[new.known].max() < 1.06


def test_an_undistorted_pattern_is_straight():
    """An image of smooth waves on the tangent plane, seen through the lens, looks as through the pinhole."""

    def waves(directions: np.ndarray) -> np.ndarray:
        u = directions / directions[..., 2:]
        return (127 + 60 * np.sin(9 * u[..., 0]) + 60 * np.cos(7 * u[..., 1])).astype(np.float32)

    x, y = np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5)
    grid = np.stack([x, y], -1).reshape(-1, 2)
    source = waves(BARREL.unproject(grid)).reshape(SIZE[::-1])
    new = undistortion(BARREL, SIZE)
    pinhole = Lens("pinhole", *new.intrinsics[[0, 1, 0, 1], [0, 1, 2, 2]])
    expected = waves(pinhole.unproject(grid)).reshape(SIZE[::-1])
    inner = np.s_[5:-5, 5:-5]
    assert np.abs(new.apply(source) - expected)[inner].max() < 0.5
    assert np.abs(new.apply(source, nearest=True) - expected)[inner].max() < 5
    assert new.apply(np.zeros((*SIZE[::-1], 3), np.uint8)).shape == (*SIZE[::-1], 3)


def test_a_lens_without_distortion_keeps_the_image():
    lens = Lens("pinhole", 200.0, 210.0, 161.0, 88.0)
    new = undistortion(lens, SIZE)
    picture = np.random.default_rng(0).integers(0, 255, (*SIZE[::-1], 3), np.uint8)
    assert new.identity and new.known.all() and np.array_equal(new.intrinsics, lens.intrinsics)
    assert new.apply(picture) is picture
