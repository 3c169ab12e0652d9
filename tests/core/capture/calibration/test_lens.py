"""Lens models against OpenCV's and COLMAP's own code."""

import math

import cv2
import numpy as np
import pycolmap
import pytest

from r5dgs_core.capture.calibration import distortion
from r5dgs_core.capture.calibration.lens import Lens

SIZE = 1280, 720
K = np.array([[903.5, 0.0, 618.3], [0.0, 907.9, 394.2], [0.0, 0.0, 1.0]])
BROWN = (-0.232, 0.0464, -0.0043, 0.0041, 0.0666, 0.02, -0.01, 0.003, 0.001, -0.002, 0.0015, 0.0007, 0.01, -0.02)
BOUND = 0.01  # px

# COLMAP model, its coefficients, our model and the same coefficients
COLMAP = [
    ("PINHOLE", (), "pinhole", ()),
    ("SIMPLE_RADIAL", (-0.1,), "brown", (-0.1, 0, 0, 0)),
    ("RADIAL", (-0.1, 0.02), "brown", (-0.1, 0.02, 0, 0)),
    ("OPENCV", BROWN[:4], "brown", BROWN[:4]),
    ("FULL_OPENCV", BROWN[:8], "brown", BROWN[:8]),
    ("OPENCV_FISHEYE", (-0.02, 0.01, -0.004, 0.001), "fisheye", (-0.02, 0.01, -0.004, 0.001)),
    ("SIMPLE_RADIAL_FISHEYE", (-0.03,), "fisheye", (-0.03,)),
    ("RADIAL_FISHEYE", (-0.03, 0.01), "fisheye", (-0.03, 0.01)),
    ("FISHEYE", (), "fisheye", ()),
    ("FOV", (0.9,), "field_of_view", (0.9,)),
    *[
        (name, c, "thin_prism_fisheye", c)
        for name, c in [("THIN_PRISM_FISHEYE", (*BROWN[:4], 0.01, -0.002, 3e-3, -2e-3))]
    ],
    *[
        (name, c, "project_aria", c)
        for name, c in [
            (
                "RAD_TAN_THIN_PRISM_FISHEYE",
                (-0.02, 0.01, 2e-3, -1e-3, 5e-4, -1e-4, 2e-3, -3e-3, 1e-3, -5e-4, 2e-3, 7e-4),
            )
        ]
    ],
    ("DIVISION", (-0.2,), "division", (-0.2,)),
    ("DIVISION", (0.1,), "division", (0.1,)),
    ("EUCM", (0.6, 1.1), "extended_unified", (0.6, 1.1)),
]


def pixels() -> np.ndarray:
    x, y = np.meshgrid(np.linspace(0.5, SIZE[0] - 0.5, 33), np.linspace(0.5, SIZE[1] - 0.5, 19))
    return np.stack([x, y], -1).reshape(-1, 2)


@pytest.mark.parametrize("count", [4, 5, 8, 12, 14])
def test_brown_lenses_agree_with_opencv(count):
    lens = Lens.from_opencv(K, BROWN[:count])
    directions = lens.unproject(pixels())
    assert np.isfinite(directions).all()
    expected = cv2.projectPoints(directions * 3.0, np.zeros(3), np.zeros(3), K, np.array(BROWN[:count]))[0][:, 0]
    assert np.abs(lens.project(directions * 3.0) - 0.5 - expected).max() < 1e-6
    assert np.abs(expected + 0.5 - pixels()).max() < BOUND


@pytest.mark.parametrize("coefficients", [(-0.02, 0.01, -0.004, 0.001), (0.1, -0.02, 0.0, 0.0)])
def test_fisheye_lenses_agree_with_opencv(coefficients):
    lens = Lens.from_opencv(K, coefficients, fisheye=True)
    directions = lens.unproject(pixels())
    points = (directions / directions[:, 2:])[:, None]
    expected = cv2.fisheye.projectPoints(points, np.zeros(3), np.zeros(3), K, np.array(coefficients))[0][:, 0]
    assert np.abs(lens.project(directions) - 0.5 - expected).max() < 1e-6
    assert np.abs(expected + 0.5 - pixels()).max() < BOUND


@pytest.mark.parametrize("name, theirs, model, ours", COLMAP, ids=[f"{row[0]}{row[1][:1]}" for row in COLMAP])
def test_lenses_agree_with_colmap(name, theirs, model, ours):
    focal = 700.0, 705.0
    camera = pycolmap.Camera(model=name, width=SIZE[0], height=SIZE[1])
    single = camera.params_info.startswith("f,")
    camera.params = [*focal[: 1 if single else 2], 631.0, 352.0, *theirs]
    lens = Lens(model, focal[0], focal[0] if single else focal[1], 631.0, 352.0, tuple(map(float, ours)))
    directions = lens.unproject(pixels())
    assert np.isfinite(directions).all()
    assert np.abs(np.array(camera.img_from_cam(directions)) - pixels()).max() < BOUND
    assert np.abs(lens.project(2.5 * directions) - pixels()).max() < 1e-6


def test_a_fisheye_lens_sees_behind_the_plane_of_the_camera():
    lens = Lens("fisheye", 300.0, 300.0, 640.0, 360.0, (0.01, 0.0, 0.0, 0.0))
    angle = math.radians(110)
    direction = np.array([[math.sin(angle), 0.0, math.cos(angle)]])
    pixel = lens.project(direction)
    assert pixel[0, 0] == pytest.approx(640 + 300 * (angle + 0.01 * angle**3))
    assert np.allclose(lens.unproject(pixel), direction)


def test_skew_moves_pixels_along_the_row():
    lens = Lens("pinhole", 500.0, 400.0, 320.0, 240.0, skew=20.0)
    points = np.array([[0.2, 0.3, 1.0], [-0.1, 0.4, 2.0]])
    expected = (points / points[:, 2:]) @ np.array([[500, 20, 320], [0, 400, 240], [0, 0, 1.0]]).T
    assert np.allclose(lens.project(points), expected[:, :2])
    assert np.allclose(lens.unproject(expected[:, :2]), points / np.linalg.norm(points, axis=1, keepdims=True))


def test_directions_behind_a_pinhole_have_no_pixel():
    assert np.isnan(
        Lens("pinhole", 500.0, 500.0, 320.0, 240.0).project(np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]))
    ).all()


def test_directions_at_which_the_image_folds_over_have_no_pixel():
    """With k1 = -0.3 alone, r (1 - 0.3 r^2) grows up to r = 1.054 and then shrinks into the image again."""
    lens = Lens("brown", 500.0, 500.0, 320.0, 240.0, (-0.3, 0.0, 0.0, 0.0))
    inside, outside = np.array([[1.0, 0.0, 1.0]]), np.array([[1.2, 0.0, 1.0]])
    assert np.isfinite(lens.project(inside)).all() and np.isnan(lens.project(outside)).all()
    farthest = 320 + 500 * 1.054 * (1 - 0.3 * 1.054**2)
    assert np.isfinite(lens.unproject(np.array([[farthest - 3, 240.0]]))).all()
    assert np.isnan(lens.unproject(np.array([[farthest + 3, 240.0]]))).all()


def test_scaled_lenses_see_the_same_directions():
    lens = Lens("brown", 903.0, 907.0, 618.0, 394.0, BROWN, skew=2.0)
    assert np.allclose(lens.scaled(0.5, 0.25).project(lens.unproject(pixels())), pixels() * [0.5, 0.25])


@pytest.mark.parametrize("model", distortion.MODELS)
def test_the_axis_is_projected_to_the_principal_point(model):
    coefficients = {"field_of_view": (0.9,), "division": (-0.1,), "extended_unified": (0.5, 1.0)}
    count = max(distortion.MODELS[model].counts)
    lens = Lens(model, 500.0, 510.0, 320.0, 240.0, coefficients.get(model, (0.0,) * count))
    assert np.allclose(lens.project(np.array([[0.0, 0.0, 2.0]])), [[320.0, 240.0]])


@pytest.mark.parametrize(
    "arguments, message",
    [
        (("barrel", 1.0, 1.0, 0.0, 0.0), "unknown lens model 'barrel'"),
        (("brown", 1.0, 1.0, 0.0, 0.0, (0.1,)), "expected 4 or 5 or 8 or 12 or 14 coefficients, found 1"),
        (("pinhole", 0.0, 1.0, 0.0, 0.0), "focal lengths above 0"),
        (("pinhole", 1.0, math.nan, 0.0, 0.0), "finite"),
    ],
)
def test_impossible_lenses_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        Lens(*arguments)
