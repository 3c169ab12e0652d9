"""Objects are where their masks say, as far as masks can say it."""

import dataclasses

import numpy as np
import pytest

from r5dgs_core.data import dataset as datasets
from r5dgs_core.scene import cameras
from r5dgs_core.train import normalization, triangulation, views
from tests import datasets as tiny_datasets
from tests import scenes

TIMES = np.array([0.0, 0.5, 1.0])


def disc_view(camera, t, balls):
    """A view whose mask shows balls (id, centre, radius) exactly, nearer ones in front."""
    rays = cameras.pixel_rays(camera)
    mask = np.zeros(rays.shape[:2], np.int32)
    nearest = np.full(mask.shape, np.inf)
    for object_id, center, radius in balls:
        arm = np.asarray(center) - camera.center
        along = rays @ arm
        inside = (arm @ arm - along**2 < radius**2) & (along < nearest)
        mask[inside], nearest[inside] = object_id, along[inside]
    return views.TrainView("v", camera, t, np.zeros((*mask.shape, 3), np.uint8), mask, None)


def ring(count=5):
    return [scenes.orbit_camera(2 * np.pi * k / count) for k in range(count)]


def test_centres_of_moving_balls_are_found_to_a_fraction_of_a_percent():
    path = np.array([[0.5, 0.1, 0.3], [0.1, 0.2, 0.5], [-0.3, 0.3, 0.3]])
    seen = [disc_view(c, t, [(4, p, 0.3), (7, -p, 0.2)]) for t, p in zip(TIMES, path, strict=True) for c in ring()]
    places = triangulation.locate(seen, TIMES, 5e-4)
    assert places.object_ids.tolist() == [4, 7] and places.measured.all()
    for centers, truth in zip(places.centers, (path, -path), strict=True):
        assert np.linalg.norm(centers - truth, axis=-1).max() < 0.003 * 4
    np.testing.assert_allclose(places.radii, [0.3, 0.2], rtol=0.15)


def test_objects_of_the_tiny_set_are_found_from_drawn_masks(tiny):
    dataset = datasets.read(tiny.root)
    norm = normalization.from_cameras([v.camera for v in dataset.train])
    places = triangulation.locate(views.load(dataset, norm, None), tiny_datasets.OBSERVED, 5e-4)
    for row, object_id in enumerate((tiny_datasets.BRICK, tiny_datasets.BALL)):
        truth = np.stack([tiny.center(object_id, t) for t in tiny_datasets.OBSERVED])
        found = norm.points_to_world(places.centers[row])
        distance = 4 * norm.scale
        # The middle of a brick's outline from above is not the outline of its middle, but it moves along.
        assert np.linalg.norm(found - truth, axis=-1).max() < 0.02 * distance
        moved, truly = found - found[-1], truth - truth[-1]
        assert np.linalg.norm(moved - truly, axis=-1).max() < 0.01 * distance


def test_a_mask_that_something_hides_in_part_is_outvoted():
    center = np.array([0.2, 0.1, 0.3])
    seen = [disc_view(c, 0.0, [(1, center, 0.4)]) for c in ring(7)]
    hidden = seen[0].mask.copy()
    columns = np.nonzero(hidden)[1]
    hidden[:, : int(np.median(columns))] = 0
    seen[0] = dataclasses.replace(seen[0], mask=hidden)
    places = triangulation.locate(seen, TIMES[:1], 5e-4)
    assert np.linalg.norm(places.centers[0, 0] - center) < 0.01 * 4


def test_times_without_a_sighting_are_filled_from_their_neighbours():
    path = {0.0: [0.4, 0, 0.3], 1.0: [-0.4, 0.2, 0.3]}
    seen = [disc_view(c, t, [(1, p, 0.3)]) for t, p in path.items() for c in ring()]
    seen += [disc_view(c, 0.5, []) for c in ring()]
    places = triangulation.locate(seen, TIMES, 5e-4)
    assert places.measured.tolist() == [[True, False, True]]
    np.testing.assert_allclose(places.centers[0, 1], (places.centers[0, 0] + places.centers[0, 2]) / 2)
    assert places.visibility[0, 1] == 0


def test_an_object_that_one_view_sees_lies_on_that_views_ray():
    camera = ring()[0]
    center = np.array([0.1, 0.2, 0.3])
    seen = [disc_view(camera, 0.0, [(1, center, 0.3)])] + [disc_view(c, 0.0, []) for c in ring()[1:]]
    places = triangulation.locate(seen, TIMES[:1], 5e-4)
    assert places.object_ids.tolist() == [1] and np.isfinite(places.centers).all() and places.radii[0] > 0
    pixel, z = cameras.project(camera, places.centers[0, 0])
    expected, _ = cameras.project(camera, center)
    assert z > 0
    np.testing.assert_allclose(pixel, expected, atol=0.5)


def test_equal_cameras_give_no_depth_but_no_failure_either():
    seen = [disc_view(ring()[0], t, [(1, [0, 0, 0.3], 0.3)]) for t in TIMES for _ in range(2)]
    places = triangulation.locate(seen, TIMES, 5e-4)
    assert np.isfinite(places.centers).all() and np.isfinite(places.radii).all()


@pytest.mark.parametrize("mask", [None, np.zeros((72, 96), np.int32), np.full((72, 96), -1, np.int32)])
def test_without_masked_objects_there_are_no_places(mask):
    seen = [dataclasses.replace(disc_view(c, 0.0, []), mask=mask) for c in ring()]
    places = triangulation.locate(seen, TIMES[:1], 5e-4)
    assert places.centers.shape == (0, 1, 3) and places.visibility.shape == (0, 1) and len(places.radii) == 0


def test_specks_do_not_vote():
    center = np.array([0.0, 0.0, 0.3])
    seen = [disc_view(c, 0.0, [(1, center, 0.4)]) for c in ring(4)]
    speck = np.zeros_like(seen[0].mask)
    speck[2:4, 2:4] = 1
    seen.append(dataclasses.replace(disc_view(ring(7)[1], 0.0, []), mask=speck))
    places = triangulation.locate(seen, TIMES[:1], 5e-4)
    assert np.linalg.norm(places.centers[0, 0] - center) < 0.003 * 4
