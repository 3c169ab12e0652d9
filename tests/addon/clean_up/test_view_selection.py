"""Lasso, brush, visibility and criteria of floaters against direct computations."""

import numpy as np
import pytest

from tests.support import motions


@pytest.fixture
def views(extension):
    return motions.addon("clean_up.view_selection")


@pytest.fixture
def floaters(extension):
    return motions.addon("clean_up.floaters")


def even_odd(point, path):
    inside = False
    for (x0, y0), (x1, y1) in zip(path, np.roll(path, -1, axis=0), strict=True):
        if (y0 > point[1]) != (y1 > point[1]):
            inside ^= point[0] < x0 + (point[1] - y0) * (x1 - x0) / (y1 - y0)
    return inside


@pytest.mark.parametrize("seed", range(3))
def test_a_lasso_holds_the_points_inside_even_if_it_crosses_itself(views, seed):
    random = np.random.default_rng(seed)
    points, path = random.uniform(0, 100, (2000, 2)), random.uniform(10, 90, (25, 2))
    points[::7] = np.nan
    found = views.in_lasso(points, path)
    assert 100 < found.sum() < 1500
    np.testing.assert_array_equal(found, [even_odd(point, path) for point in points])


def test_a_lasso_whose_corners_lie_on_pixels_counts_each_point_once(views):
    grid = np.stack(np.meshgrid(np.arange(12.0), np.arange(12.0)), -1).reshape(-1, 2)
    path = np.array([(2, 2), (8, 2), (8, 5), (5, 8), (2, 8)], float)
    np.testing.assert_array_equal(views.in_lasso(grid, path), [even_odd(point, path) for point in grid])


def test_a_lasso_of_two_corners_holds_nothing(views):
    assert not views.in_lasso(np.ones((3, 2)), np.ones((2, 2))).any()


@pytest.mark.parametrize("corners", [1, 2, 12])
def test_a_brush_covers_the_points_near_its_path(views, corners):
    random = np.random.default_rng(1)
    points, path = random.uniform(0, 100, (400, 2)), random.uniform(20, 80, (corners, 2))
    fine = path if corners == 1 else np.concatenate(
        [a + np.linspace(0, 1, 401)[:, None] * (b - a) for a, b in zip(path[:-1], path[1:], strict=True)]
    )  # fmt: skip
    distances = np.sqrt(np.min([((points - place) ** 2).sum(1) for place in fine], axis=0))
    found = views.under_brush(points, path, 9.0)
    clear = np.abs(distances - 9) > 0.05
    assert found.any()
    np.testing.assert_array_equal(found[clear], (distances < 9)[clear])


def test_gaussians_behind_an_opaque_layer_are_not_in_front(views):
    random = np.random.default_rng(2)
    pixels = np.tile(random.uniform(0, 64, (4000, 2)), (2, 1))
    depths = np.repeat([1.0, 2.0], 4000)
    opaque = views.is_in_front(pixels, depths, np.full(8000, 0.9), np.full(8000, 2.0))
    assert opaque[4000:].mean() < 0.02 and opaque[:4000].any()
    sheer = views.is_in_front(pixels[::10], depths[::10], np.full(800, 0.01), np.full(800, 2.0))
    assert sheer.all()
    pixels[3] = np.nan
    assert not views.is_in_front(pixels, depths, np.full(8000, 0.01), np.full(8000, 2.0))[3]


def test_the_nearest_gaussian_of_a_cell_is_always_in_front(views):
    random = np.random.default_rng(3)
    pixels, depths = random.uniform(0, 400, (3000, 2)), random.uniform(1, 9, 3000)
    front = views.is_in_front(pixels, depths, random.uniform(0, 1, 3000), random.uniform(0.1, 4, 3000))
    assert front[depths.argmin()] and 0.05 < front.mean() < 0.95


def test_isolated_gaussians_have_few_others_in_the_cells_around_them(floaters):
    random = np.random.default_rng(4)
    means = np.concatenate([random.normal(size=(600, 3)), random.uniform(-9, 9, (40, 3))]).astype(np.float32)
    center, radius = floaters.center_and_radius(means)
    cells = np.floor((means - center) / (0.3 * radius))
    near = (np.abs(cells[:, None] - cells[None]) <= 1).all(-1).sum(1) - 1
    found = floaters.is_isolated(means, 0.3, 4)
    assert 10 < found.sum() < 400
    np.testing.assert_array_equal(found, near < 4)


def test_criteria_do_not_depend_on_the_scale_of_the_scene(floaters):
    random = np.random.default_rng(5)
    means, scales = random.normal(size=(500, 3)), random.uniform(0.01, 2, (500, 3))
    far = floaters.is_distant(means, 1.2)
    _, radius = floaters.center_and_radius(means)
    assert 0.45 < radius / np.sqrt(6.25) < 1.2 and 0 < far.sum() < 50
    large = floaters.is_large(means, scales, 0.7)
    np.testing.assert_array_equal(large, scales.max(1) > 0.7 * radius)
    for factor in (1e-6, 1e6):
        np.testing.assert_array_equal(floaters.is_distant(factor * means, 1.2), far)
        np.testing.assert_array_equal(floaters.is_large(factor * means, factor * scales, 0.7), large)


def test_a_point_alone_or_an_object_without_size_has_no_isolated_gaussians(floaters):
    assert not floaters.is_isolated(np.zeros((5, 3)), 0.1, 9).any()
    assert not len(floaters.is_isolated(np.zeros((0, 3)), 0.1, 9))
