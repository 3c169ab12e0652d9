"""Registration of one body at one knot."""

import numpy as np
from scipy import ndimage

from r5dgs_core.motion import rotations
from r5dgs_core.train import registration
from r5dgs_core.train.registration import BodyRegistration
from tests.support import tiny_datasets

SIZE, CELL = 96, 6  # px
REGION = np.zeros((SIZE, SIZE), bool)
REGION[18:78, 18:78] = True


class Board(BodyRegistration):
    """A board of light and dark cells before a dark wall, which moves in the plane of the image, px."""

    def __init__(self):
        self.radius, self._free = 30.0, np.eye(3)
        cells = np.indices((SIZE, SIZE)) // CELL
        self._image = np.where(REGION, 0.4 + 0.6 * (cells.sum(0) % 2), 0.0)
        self._image[36:42, 48:54] = 0.7  # the only mark that tells the cells apart, except for the outline

    def _residuals(self, pose, blur=0.0):
        moved = ndimage.shift(self._image, pose[1][:2], order=1)
        apart = np.where(ndimage.binary_dilation(REGION, iterations=6), moved - self._image, 0)[..., None]
        return registration.blurred(apart, REGION, blur).ravel()


def test_a_pattern_that_repeats_is_found_from_afar():
    board, start = Board(), (rotations.identity(1)[0], np.array([2.0 * CELL, -1.5, 0.0]))
    close, left = board.refined(start, 8)
    assert np.linalg.norm(close[1][:2]) > CELL and left > 0.01  # another cell of the pattern
    found, left = board.refined_from_afar(start, 20)
    assert np.linalg.norm(found[1][:2]) < 0.2 and left < 1e-3


def test_pictures_in_other_light_become_equal_inside_a_region():
    image = np.random.default_rng(0).random((20, 20, 3))
    region = np.zeros((20, 20), bool)
    region[5:15, 5:15] = True
    truth = np.array([0.5, 2.0, 1.0]) * image + np.array([0.1, -0.2, 0.0])
    np.testing.assert_allclose(registration.lit_alike(image, truth, region)[region], truth[region], atol=1e-9)
    opposite = registration.lit_alike(image, 1 - image, region)[region]
    np.testing.assert_allclose(opposite, np.broadcast_to((1 - image[region]).mean(0), opposite.shape))


def test_blur_keeps_the_sum_inside_a_region_and_ignores_the_rest():
    image = np.random.default_rng(0).random((40, 40, 2))
    region = np.zeros((40, 40), bool)
    region[15:25, 15:25] = True
    found = registration.blurred(image, region, 0.2)
    np.testing.assert_allclose(found.sum((0, 1)), image[region].sum(0), rtol=1e-3)
    assert found.std() < image.std()
    assert registration.blurred(image, region, 0.0) is image


def test_a_single_view_keeps_the_distance_of_a_body(trainer):
    one, two = (BodyRegistration(trainer, trainer.motion, tiny_datasets.BRICK, 3, most) for most in (1, 2))
    assert (len(one), len(two)) == (1, 2)
    view = registration.views_at(trainer, 3)[0]
    away = one.pose[1] + trainer.motion.tracks.centers[tiny_datasets.BRICK].numpy() - view.camera.center
    away /= np.linalg.norm(away)
    start = one.pose[0], one.pose[1] + trainer.places.radii[0] * np.array([0.2, -0.1, 0.15])
    changes = [look.refined(start, 4)[0][1] - start[1] for look in (one, two)]
    assert abs(changes[0] @ away) < 1e-3 * np.linalg.norm(changes[0])
    assert abs(changes[1] @ away) > 1e-2 * np.linalg.norm(changes[1])
