"""COLMAP's reconstructions, written and projected by pycolmap."""

import numpy as np
import pycolmap
import pytest

from r5dgs_core import errors
from r5dgs_core.capture.calibration import reading
from tests.support.projections import BOUND, POINTS, pixels, rotation

SIZE = 640, 480
PARAMETERS = {
    "SIMPLE_PINHOLE": [500.0, 321.0, 238.0],
    "PINHOLE": [500.0, 502.0, 321.0, 238.0],
    "SIMPLE_RADIAL": [500.0, 321.0, 238.0, -0.1],
    "RADIAL": [500.0, 321.0, 238.0, -0.1, 0.02],
    "OPENCV": [500.0, 502.0, 321.0, 238.0, -0.2, 0.05, 1e-3, -2e-3],
    "OPENCV_FISHEYE": [400.0, 402.0, 321.0, 238.0, -0.02, 0.01, -4e-3, 1e-3],
    "FULL_OPENCV": [500.0, 502.0, 321.0, 238.0, -0.2, 0.05, 1e-3, -2e-3, 0.01, 0.02, -0.01, 3e-3],
    "FOV": [400.0, 402.0, 321.0, 238.0, 0.8],
    "SIMPLE_RADIAL_FISHEYE": [400.0, 321.0, 238.0, -0.03],
    "RADIAL_FISHEYE": [400.0, 321.0, 238.0, -0.03, 0.01],
    "THIN_PRISM_FISHEYE": [400.0, 402.0, 321.0, 238.0, -0.02, 0.01, 1e-3, -2e-3, 0.01, -2e-3, 3e-3, -1e-3],
    "RAD_TAN_THIN_PRISM_FISHEYE": [
        *[400.0, 402.0, 321.0, 238.0, -0.02, 0.01, 2e-3, -1e-3, 5e-4, -1e-4],
        *[2e-3, -3e-3, 1e-3, -5e-4, 2e-3, 7e-4],
    ],
    "SIMPLE_DIVISION": [500.0, 321.0, 238.0, -0.2],
    "DIVISION": [500.0, 502.0, 321.0, 238.0, -0.2],
    "SIMPLE_FISHEYE": [400.0, 321.0, 238.0],
    "FISHEYE": [400.0, 402.0, 321.0, 238.0],
    "EUCM": [400.0, 402.0, 321.0, 238.0, 0.6, 1.1],
}


def write(folder, camera: pycolmap.Camera, names, *, text=False) -> list[pycolmap.Image]:
    """Write a reconstruction of one lens with one pose per image, by pycolmap."""
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(camera)
    for k, name in enumerate(names, 1):
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation(k)), np.array([0.05 * k, -0.1, 2.0]))
        image = pycolmap.Image(name=name, camera_id=camera.camera_id, image_id=k)
        model.add_image_with_trivial_frame(image, pose)
        model.register_frame(model.images[k].frame_id)
    model.add_point3D(np.array([0.1, 0.2, 0.3]), pycolmap.Track(), np.array([255, 0, 51], np.uint8))
    folder.mkdir(parents=True)
    (model.write_text if text else model.write_binary)(str(folder))
    return [model.images[k] for k in range(1, len(names) + 1)]


@pytest.mark.parametrize("text", [False, True], ids=["binary", "text"])
@pytest.mark.parametrize("model", PARAMETERS)
def test_every_camera_model_projects_as_in_colmap(tmp_path, model, text):
    camera = pycolmap.Camera(model=model, width=SIZE[0], height=SIZE[1], params=PARAMETERS[model], camera_id=3)
    images = write(tmp_path / "sparse" / "0", camera, ["cam0/0000.png", "cam1/0000.png"], text=text)
    calibration = reading.read_calibration(tmp_path)
    assert (calibration.format, calibration.names) == ("colmap", ("cam0", "cam1"))
    for found, image in zip(calibration.cameras, images, strict=True):
        pose = image.cam_from_world()
        expected = np.array(camera.img_from_cam(POINTS @ pose.rotation.matrix().T + pose.translation))
        assert np.abs(pixels(found.lens, found.camera_to_world) - expected).max() < BOUND
        assert (found.width, found.height) == SIZE
    assert np.allclose(calibration.points, [[0.1, 0.2, 0.3]]) and np.allclose(calibration.colors, [[1, 0, 0.2]])


def test_the_models_are_all_that_colmap_defines():
    known = set(pycolmap.CameraModelId.__members__) - {"INVALID"}
    assert known == {*PARAMETERS, "EQUIRECTANGULAR"}


@pytest.mark.parametrize("text", [False, True])
def test_panoramas_are_refused_by_name(tmp_path, text):
    camera = pycolmap.Camera(model="EQUIRECTANGULAR", width=640, height=320, params=[640.0, 320.0], camera_id=1)
    write(tmp_path / "sparse" / "0", camera, ["a.png"], text=text)
    with pytest.raises(errors.DatasetError, match="the lens EQUIRECTANGULAR is a panorama; render perspective views"):
        reading.read_calibration(tmp_path)


def test_images_of_one_folder_are_a_moving_camera(tmp_path):
    camera = pycolmap.Camera(model="PINHOLE", width=SIZE[0], height=SIZE[1], params=PARAMETERS["PINHOLE"], camera_id=1)
    write(tmp_path / "sparse" / "0", camera, ["left.png", "right.png", "top.png"])
    (tmp_path / "images").mkdir()
    moving = reading.read_calibration(tmp_path)
    assert moving.names == ("images",) and moving.cameras[0].moves
    assert [frame.path for frame in moving.cameras[0].frames][0] == tmp_path / "images" / "left.png"


def test_times_json_gives_the_times_of_the_images(tmp_path):
    camera = pycolmap.Camera(model="PINHOLE", width=SIZE[0], height=SIZE[1], params=PARAMETERS["PINHOLE"], camera_id=1)
    write(tmp_path / "sparse", camera, ["a.png", "b.png"])
    (tmp_path / "images").mkdir()
    (tmp_path / "times.json").write_text('{"a.png": 0.25, "b.png": 0.5}')
    (only,) = reading.read_calibration(tmp_path).cameras
    assert [frame.time for frame in only.frames] == [0.25, 0.5]


def test_a_folder_of_the_reconstruction_itself_is_read(tmp_path):
    camera = pycolmap.Camera(model="PINHOLE", width=SIZE[0], height=SIZE[1], params=PARAMETERS["PINHOLE"], camera_id=1)
    write(tmp_path / "model", camera, ["a.png"], text=True)
    assert reading.read_calibration(tmp_path / "model").format == "colmap"
    assert reading.read_calibration(tmp_path / "model" / "cameras.txt").format == "colmap"
