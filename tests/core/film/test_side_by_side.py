"""Captured images beside pictures."""

import numpy as np
import pytest

from r5dgs_core import errors
from r5dgs_core.data import dataset as datasets
from r5dgs_core.film import camera_path, side_by_side
from r5dgs_core.film.schedule import Shot


@pytest.fixture
def dataset(tiny):
    return datasets.read(tiny.root)


def test_the_image_nearest_in_time_is_shown(dataset):
    view = dataset.train[0]
    found = side_by_side.CapturedImages(dataset, view.camera.name, np.ones(3))
    np.testing.assert_allclose(found.at(Shot(1, view.camera, view.t)), datasets.load_image(view), atol=1e-6)
    assert (found.at(Shot(1, view.camera, dataset.t_max + 50)) == np.float32(side_by_side.EMPTY)).all()


def test_images_are_scaled_as_the_camera_is(dataset):
    view = dataset.train[0]
    camera = camera_path.fitted(view.camera, 3 * view.camera.width, 2 * view.camera.height)
    found = side_by_side.CapturedImages(dataset, view.camera.name, np.ones(3)).at(Shot(1, camera, view.t))
    width = view.camera.width
    assert (found[:, : width // 2 - 1] == np.float32(side_by_side.EMPTY)).all()
    inner = found[:, width // 2 : width // 2 + 2 * width]
    small = inner.reshape(view.camera.height, 2, width, 2, 3).mean((1, 3))
    assert np.abs(small - datasets.load_image(view)).mean() < 0.02


def test_a_camera_without_images_is_named(dataset):
    with pytest.raises(errors.ConfigError, match="no images of camera 'orbit'"):
        side_by_side.CapturedImages(dataset, "orbit", np.ones(3))
