"""The plane sweep finds a textured floor, and nothing in images without texture or parallax."""

import dataclasses

import numpy as np
import pytest
from scipy import ndimage

from r5dgs_core.scene import cameras
from r5dgs_core.train import train_views
from r5dgs_core.train.initialization import background_images, initialize, plane_sweep, triangulation
from tests.support import scenes

NO_PLACES = triangulation.ObjectPositions(
    np.zeros(0, np.int64),
    np.zeros((0, 1, 3)),
    np.zeros((0, 1), bool),
    np.zeros((0, 1)),
    np.zeros(0),
    np.zeros((0, 1)),
    np.zeros((0, 1), bool),
)


def floor_views(count=5, seed=0):
    """Cameras on an arc that see only a textured floor at z = 0, painted by intersecting their rays with it."""
    texture = ndimage.gaussian_filter(np.random.default_rng(seed).normal(size=(160, 160, 3)), (1.8, 1.8, 0))
    texture = np.clip(0.5 + 0.9 * texture / np.abs(texture).max(), 0, 1)
    seen = []
    for k in range(count):
        camera = steep_camera(0.25 * k)
        rays = cameras.pixel_rays(camera)
        hits = camera.center - rays * (camera.center[2] / rays[..., 2:])
        at = (hits[..., :2] + 8) / 16 * 159  # the texture covers 16 x 16 units
        image = np.stack(
            [ndimage.map_coordinates(texture[..., c], np.moveaxis(at, -1, 0), order=1) for c in range(3)], -1
        )
        pixels = np.rint(image * 255).astype(np.uint8)
        seen.append(train_views.of_arrays(f"v{k}", camera, 0.0, pixels))
    return seen


def steep_camera(angle):
    """A camera four units from the origin that looks down at it."""
    position = np.array([2.4 * np.cos(angle), 2.4 * np.sin(angle), 3.2])
    return scenes.looking_camera(position, -position, 0.8, 64, 48)


@pytest.fixture(scope="module")
def floor():
    return floor_views()


def constant_views():
    """Cameras on an arc that see only one colour."""
    image = np.tile(np.array([120, 160, 220], np.uint8), (36, 48, 1))
    return [train_views.of_arrays(f"v{k}", scenes.orbit_camera(0.4 * k, 48, 36), 0.0, image) for k in range(5)]


def depth_step(depths):
    """Distance between the depths that are tried, near the cameras' focus."""
    return 4.0**2 * (1 / plane_sweep.NEAREST - 1 / plane_sweep.FARTHEST) / (depths - 1)


@pytest.mark.parametrize("depths", [96, 288])
def test_points_lie_on_a_textured_floor_as_exactly_as_depths_are_tried(floor, depths):
    points = plane_sweep.Sweep(background_images.compute(floor), 150, depths).distinct_points()
    assert len(points) > 200
    assert np.median(np.abs(points[:, 2])) < 0.5 * depth_step(depths)
    assert np.mean(np.abs(points[:, 2]) < 1.5 * depth_step(depths)) > 0.85


def test_the_supporting_plane_is_the_floor_and_points_are_put_onto_it(floor):
    search = plane_sweep.Sweep(background_images.compute(floor), 150, 288)
    eyes = np.stack([v.camera.center for v in floor])
    plane = initialize.supporting_plane(search.distinct_points(), NO_PLACES, eyes, np.random.default_rng(0))
    assert plane is not None
    normal, height = plane
    assert np.degrees(np.arccos(normal[2])) < 2 and abs(height) < 0.5 * depth_step(288)
    placed = search.place(150, plane, False, np.random.default_rng(0))
    points, colors = placed.points, placed.colors
    assert points.shape == colors.shape == (150, 3)
    assert np.mean(np.abs(points @ normal - height) < 1e-6) > 0.7
    assert colors.min() >= 0 and colors.max() <= 1


def test_the_same_draws_give_the_same_points(floor):
    search = plane_sweep.Sweep(background_images.compute(floor), 150, 48)
    a, b = (search.place(100, None, False, np.random.default_rng(3)).points for _ in range(2))
    np.testing.assert_array_equal(a, b)


def test_a_depth_that_no_other_camera_confirms_places_nothing(floor):
    search = plane_sweep.Sweep(background_images.compute(floor), 150, 288)
    found = search.rays[0]
    search.rays[0] = dataclasses.replace(found, depths=0.6 * found.depths, costs=np.zeros_like(found.costs))
    heights = search.place(10**6, None, False, np.random.default_rng(0)).points[:, 2]
    assert len(heights) > 200
    assert heights.max() < 0.7  # the wrong depths lie 1.3 units above the floor


def test_two_cameras_confirm_each_other(floor):
    search = plane_sweep.Sweep(background_images.compute(floor[:2]), 150, 96)
    points = search.place(10**6, None, False, np.random.default_rng(0)).points
    assert len(points) > 100
    assert np.mean(np.abs(points[:, 2]) < 1.5 * depth_step(96)) > 0.8


def test_a_constant_sky_places_nothing():
    search = plane_sweep.Sweep(background_images.compute(constant_views()), 200, 48)
    for find_sky in (False, True):
        placed = search.place(200, None, find_sky, np.random.default_rng(0))
        assert placed.points.shape == placed.colors.shape == (0, 3)
        assert (placed.sky is not None) == find_sky


def test_without_parallax_or_neighbours_nothing_is_placed(floor):
    for seen in (floor[:1], [floor[0]] * 3):
        placed = plane_sweep.Sweep(background_images.compute(seen), 200, 48).place(
            200, None, True, np.random.default_rng(0)
        )
        assert len(placed.points) == 0


def test_a_background_image_shows_what_lies_behind_the_objects(floor):
    view = floor[0]
    rng = np.random.default_rng(0)
    seen = []
    for k in range(5):
        mask = np.zeros(view.image.shape[:2], np.int32)
        mask[5 : 5 + 20, 10 * k : 10 * k + 12] = 1
        image = np.where(mask[..., None] > 0, rng.integers(0, 255, view.image.shape), view.image).astype(np.uint8)
        seen.append(dataclasses.replace(view, t=0.1 * k).with_arrays(image, mask))
    (background,) = background_images.compute(seen)
    assert background.known.all()
    np.testing.assert_allclose(background.image, view.image / 255, atol=1e-6)


def test_pixels_that_objects_always_cover_or_that_are_transparent_are_unknown(floor):
    view = floor[0]
    mask = np.zeros(view.image.shape[:2], np.int32)
    mask[10:20, 10:20] = 2
    alpha = np.full(mask.shape, 255, np.uint8)
    alpha[30:, :] = 0
    (background,) = background_images.compute([view.with_arrays(mask=mask, alpha=alpha)] * 2)
    assert not background.known[10:20, 10:20].any() and not background.known[30:].any()
    assert background.known[:8].all() and np.isfinite(background.image).all()


def test_no_plane_carries_scattered_points():
    rng = np.random.default_rng(0)
    eyes = np.array([[0.0, 0, 10]])
    scattered = rng.normal(size=(500, 3)) * 3
    assert initialize.supporting_plane(scattered, NO_PLACES, eyes, rng) is None
    assert initialize.supporting_plane(scattered[:10], NO_PLACES, eyes, rng) is None


def test_the_supporting_area_is_outlined_by_its_points():
    rng = np.random.default_rng(1)
    normal = np.array([0.2, -0.3, 1.0]) / np.linalg.norm([0.2, -0.3, 1.0])
    axes = np.linalg.svd(normal[None])[2][1:]
    angles = rng.uniform(0, 2 * np.pi, 2000)
    disc = (2 * np.sqrt(rng.random(2000)) * np.stack([np.cos(angles), np.sin(angles)])).T
    support = plane_sweep._Support(disc @ axes + 0.7 * normal, (normal, 0.7))
    asked = rng.uniform(-4, 4, (50, 60, 2))
    radii = np.linalg.norm(asked, axis=-1)
    inside = support(asked @ axes + 0.7 * normal)
    assert inside[radii < 1.9].all() and not inside[radii > 2].any()
    assert not support(np.full((1, 3), 1e9))[0]


def test_too_few_points_support_nothing():
    support = plane_sweep._Support(np.zeros((5, 3)), (np.array([0.0, 0, 1]), 0.0))
    assert not support(np.zeros((2, 3))).any()


def test_depths_do_not_depend_on_the_number_of_bands(floor, monkeypatch):
    whole = plane_sweep.Sweep(background_images.compute(floor), 150, 48)
    monkeypatch.setattr(plane_sweep, "COST_VALUES", 1)
    cut = plane_sweep.Sweep(background_images.compute(floor), 150, 48)
    for ours, theirs in zip(cut.rays, whole.rays, strict=True):
        np.testing.assert_allclose(ours.costs, theirs.costs, rtol=1e-5)
        assert (ours.depths == theirs.depths).mean() > 0.99


def test_images_of_another_size_have_their_own_background_image(floor):
    view = floor[0]
    cut = dataclasses.replace(view, camera=dataclasses.replace(view.camera, height=20)).with_arrays(view.image[:20])
    found = background_images.compute([view, cut, view])
    assert [b.image.shape[:2] for b in found] == [(48, 64), (20, 64)]
    np.testing.assert_array_equal(found[1].image, found[0].image[:20])
