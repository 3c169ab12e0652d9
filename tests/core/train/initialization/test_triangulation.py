"""Positions of objects from the rays of their masks."""

import numpy as np
import pytest
from scipy import ndimage

from r5dgs_core.data import dataset as datasets
from r5dgs_core.scene import cameras
from r5dgs_core.train import normalization, train_views
from r5dgs_core.train.initialization import triangulation
from tests.support import scenes, tiny_datasets

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
    return train_views.of_arrays("v", camera, t, np.zeros((*mask.shape, 3), np.uint8), mask)


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


def test_objects_of_the_tiny_data_set_are_found_from_its_masks(tiny):
    dataset = datasets.read(tiny.root)
    norm = normalization.from_cameras([v.camera for v in dataset.train])
    places = triangulation.locate(train_views.load(dataset, norm, None), tiny_datasets.OBSERVED, 5e-4)
    for row, object_id in enumerate((tiny_datasets.BRICK, tiny_datasets.BALL)):
        truth = np.stack([tiny.center(object_id, t) for t in tiny_datasets.OBSERVED])
        found = norm.points_to_world(places.centers[row])
        distance = 4 * norm.scale
        # The middle of a brick's outline from above is not the outline of its middle, but it moves along.
        assert np.linalg.norm(found - truth, axis=-1).max() < 0.02 * distance
        moved, truly = found - found[-1], truth - truth[-1]
        assert np.linalg.norm(moved - truly, axis=-1).max() < 0.01 * distance


def test_a_partly_hidden_mask_is_outvoted():
    center = np.array([0.2, 0.1, 0.3])
    seen = [disc_view(c, 0.0, [(1, center, 0.4)]) for c in ring(7)]
    hidden = seen[0].mask.copy()
    columns = np.nonzero(hidden)[1]
    hidden[:, : int(np.median(columns))] = 0
    seen[0] = seen[0].with_arrays(mask=hidden)
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


@pytest.mark.parametrize("share, count, shown", [(0.7, 6, True), (0.2, 6, False), (0.7, 1, False)])
def test_an_object_that_the_border_cuts_is_shown_if_two_cameras_see_most_of_it(share, count, shown):
    seen = [disc_view(c, t, [(1, [0, 0, 0.3], 0.3)]) for t in TIMES for c in ring(6)]
    for k, view in enumerate(seen[-6:], start=len(seen) - 6):
        columns = np.nonzero(view.mask)[1]
        mask = np.zeros_like(view.mask)
        if k < len(seen) - 6 + count:
            cut = int(np.quantile(columns, 1 - share))
            mask[:, : mask.shape[1] - cut] = view.mask[:, cut:]
        seen[k] = view.with_arrays(mask=mask)
    places = triangulation.locate(seen, TIMES, 5e-4)
    assert places.measured.tolist() == [[True, True, False]]
    assert places.shown.tolist() == [[True, True, shown]]


def test_an_object_seen_by_one_camera_is_placed_on_its_rays_with_a_warning(caplog):
    camera = ring()[0]
    center = np.array([0.1, 0.2, 0.3])
    seen = [disc_view(camera, t, [(1, center, 0.3)]) for t in TIMES]
    seen += [disc_view(c, t, []) for c in ring()[1:] for t in TIMES]
    places = triangulation.locate(seen, TIMES, 5e-4)
    assert "depth is a guess" in caplog.text
    assert places.object_ids.tolist() == [1] and places.measured.all() and places.radii[0] > 0
    pixel, z = cameras.project(camera, places.centers[0])
    expected, _ = cameras.project(camera, center)
    assert (z > 0).all()
    np.testing.assert_allclose(pixel, np.tile(expected, (3, 1)), atol=0.5)


def test_an_id_that_one_mask_shows_is_left_out_and_named(caplog):
    seen = [disc_view(c, 0.0, [(1, [0, 0, 0.3], 0.3)]) for c in ring()]
    stray = seen[2].mask.copy()
    stray[2:20, 3:20] = 9
    seen[2] = seen[2].with_arrays(mask=stray)
    assert triangulation.locate(seen, TIMES[:1], 5e-4).object_ids.tolist() == [1]
    assert "object 9 is shown by one mask only" in caplog.text
    assert triangulation.locate(seen[2:3], TIMES[:1], 5e-4).object_ids.tolist() == [1, 9]  # there is no other mask


def test_one_warning_names_the_first_of_many_stray_ids(caplog):
    seen = [disc_view(c, 0.0, [(1, [0, 0, 0.3], 0.3)]) for c in ring()]
    stray = seen[2].mask.copy()
    for number in range(10):
        stray[2:6, 3 + 5 * number : 7 + 5 * number] = 20 + number
    seen[2] = seen[2].with_arrays(mask=stray)
    assert triangulation.locate(seen, TIMES[:1], 5e-4).object_ids.tolist() == [1]
    assert len(caplog.records) == 1
    assert "objects 20, 21, 22, 23, 24, 25, 26, 27 and 2 more are each shown by one mask only" in caplog.text


def throw(t):
    """A thrown ball's path. [..., 3]"""
    t = np.asarray(t, np.float64)
    return np.stack([0.9 * t - 0.5, 0.3 - 0.4 * t, 0.3 + 1.6 * t - 1.5 * t**2], -1)


def largest_error(places, truth, where=slice(None)):
    return np.linalg.norm(places.centers[0] - truth, axis=-1)[where].max()


def test_one_camera_per_time_suffices_if_cameras_alternate():
    times = np.linspace(0, 1, 15)
    looking = ring(5)
    seen = [disc_view(looking[2 * s % 5], t, [(1, throw(t), 0.3)]) for s, t in enumerate(times)]
    places = triangulation.locate(seen, times, 5e-4)
    assert places.measured[0, 1:-1].all()
    assert largest_error(places, throw(times)) < 0.05


def test_a_path_continues_smoothly_while_the_object_is_hidden():
    times = np.linspace(0, 1, 12)
    hidden = slice(4, 8)
    seen = [
        disc_view(c, t, [(1, throw(t), 0.3)] if not 4 <= s < 8 else []) for s, t in enumerate(times) for c in ring()
    ]
    places = triangulation.locate(seen, times, 5e-4)
    assert np.flatnonzero(~places.measured[0]).tolist() == [4, 5, 6, 7] and (places.evidence[0, hidden] == 0).all()
    straight = throw(times[3]) + (times[5] - times[3]) / (times[8] - times[3]) * (throw(times[8]) - throw(times[3]))
    error = largest_error(places, throw(times), hidden)
    assert error < 0.02 < 0.5 * np.linalg.norm(straight - throw(times[5]))


def test_before_the_first_mask_and_after_the_last_one_the_velocity_is_kept():
    times = np.linspace(0, 1, 11)
    path = np.array([-0.4, 0.3, 0.3]) + times[:, None] * np.array([0.8, -0.5, 0.0])
    seen = [
        disc_view(c, t, [(1, p, 0.3)] if 3 <= s < 9 else [])
        for s, (t, p) in enumerate(zip(times, path, strict=True))
        for c in ring()
    ]
    places = triangulation.locate(seen, times, 5e-4)
    assert places.measured[0].tolist() == [False] * 3 + [True] * 6 + [False] * 2
    assert largest_error(places, path) < 0.04


def test_an_object_that_enters_the_frame_is_not_placed_at_its_first_visible_sliver():
    times = np.linspace(0, 1, 9)
    looking = [scenes.orbit_camera(a) for a in (0.0, 0.25, -0.25)]
    path = np.array([0.0, -2.2, 0.3]) + times[:, None] * np.array([0.0, 1.9, 0.0])
    seen = [disc_view(c, t, [(1, p, 0.3)]) for t, p in zip(times, path, strict=True) for c in looking]
    whole = [np.all([m.mask[:, [0, -1]].max() == 0 for m in seen[3 * s : 3 * s + 3]]) for s in range(9)]
    assert not whole[0] and whole[-1] and (seen[0].mask > 0).sum() + (seen[3].mask > 0).sum() > 0
    places = triangulation.locate(seen, times, 5e-4)
    assert largest_error(places, path, np.array(whole)) < 0.02
    assert largest_error(places, path) < 0.25


def test_touching_balls_are_separated():
    looking = ring(7)
    path = np.array([[0.0, -0.35, 0.3], [0.0, 0.0, 0.3], [0.0, 0.35, 0.3]])
    other = np.array([0.5, 0.0, 0.3])  # half hides the first one from the side of the first camera
    seen = [disc_view(c, t, [(1, p, 0.3), (2, other, 0.25)]) for t, p in zip(TIMES, path, strict=True) for c in looking]
    places = triangulation.locate(seen, TIMES, 5e-4)
    for row, truth in enumerate((path, np.tile(other, (3, 1)))):
        assert np.linalg.norm(places.centers[row] - truth, axis=-1).max() < 0.02


@pytest.mark.parametrize("pixels", [-2, -1, 1, 2])
def test_masks_with_ragged_borders_leave_the_centre_where_it_is(pixels):
    rng = np.random.default_rng(3)
    times = np.linspace(0, 1, 6)
    seen = []
    for t in times:
        for c in ring():
            view = disc_view(c, t, [(1, throw(t), 0.3)])
            change = ndimage.binary_dilation if pixels > 0 else ndimage.binary_erosion
            mask = change(view.mask == 1, iterations=abs(pixels))
            ragged = ndimage.binary_dilation(mask) & ~ndimage.binary_erosion(mask) & (rng.random(mask.shape) < 0.5)
            seen.append(view.with_arrays(mask=np.where(mask ^ ragged, 1, 0)))
    places = triangulation.locate(seen, times, 5e-4)
    assert places.measured.all() and largest_error(places, throw(times)) < 0.02


def test_equal_cameras_give_no_depth_and_no_error():
    seen = [disc_view(ring()[0], t, [(1, [0, 0, 0.3], 0.3)]) for t in TIMES for _ in range(2)]
    places = triangulation.locate(seen, TIMES, 5e-4)
    assert np.isfinite(places.centers).all() and np.isfinite(places.radii).all()


@pytest.mark.parametrize("mask", [None, np.zeros((72, 96), np.int32), np.full((72, 96), -1, np.int32)])
def test_without_masked_objects_there_are_no_positions(mask):
    seen = [disc_view(c, 0.0, []).with_arrays(mask=mask) for c in ring()]
    places = triangulation.locate(seen, TIMES[:1], 5e-4)
    assert places.centers.shape == (0, 1, 3) and places.visibility.shape == (0, 1) and len(places.radii) == 0


def test_specks_do_not_vote():
    center = np.array([0.0, 0.0, 0.3])
    seen = [disc_view(c, 0.0, [(1, center, 0.4)]) for c in ring(4)]
    speck = np.zeros_like(seen[0].mask)
    speck[2:4, 2:4] = 1
    seen.append(disc_view(ring(7)[1], 0.0, []).with_arrays(mask=speck))
    places = triangulation.locate(seen, TIMES[:1], 5e-4)
    assert np.linalg.norm(places.centers[0, 0] - center) < 0.003 * 4


def test_an_object_that_others_surround_in_all_masks_is_located():
    """Masks of a mug and of the picture on it, for example."""
    center = np.array([0.2, 0.1, 0.3])
    whole, part = ([disc_view(c, 0.0, [(1, center, radius)]) for c in ring()] for radius in (0.4, 0.2))
    seen = [
        one.with_arrays(mask=np.where(other.mask == 1, 2, one.mask).astype(np.int32))
        for one, other in zip(whole, part, strict=True)
    ]
    places = triangulation.locate(seen, TIMES[:1], 5e-4)
    assert places.object_ids.tolist() == [1, 2]
    assert np.linalg.norm(places.centers[:, 0] - center, axis=1).max() < 0.01 * 4
