"""Back-to-front order of Gaussians."""

import importlib

import numpy as np
import pytest

SPACING = 1e-3  # relative difference of depth that two Gaussians need to be sorted


@pytest.fixture(scope="module")
def module(extension):
    return importlib.import_module("r5dgs.r5dgs_addon.splats.depth_order")


def depths_of(positions, starts, planes):
    """Depth of every Gaussian of the visible groups, by row."""
    found = {}
    for group, plane in planes.items():
        for row in range(starts[group], starts[group + 1]):
            found[row] = positions[row].astype(np.float64) @ plane[:3] + plane[3]
    return found


def assert_sorted(rows, depths, parallel, near=0.01):
    assert sorted(rows) == sorted(depths)
    ordered = np.array([depths[row] for row in rows])
    span = np.ptp(ordered) * SPACING if parallel else SPACING * np.maximum(ordered[1:], near)
    visible = np.ones(len(ordered) - 1, bool) if parallel else ordered[:-1] > near
    assert (np.diff(ordered)[visible] <= np.broadcast_to(span, len(ordered) - 1)[visible]).all()


@pytest.mark.parametrize("parallel", [False, True])
@pytest.mark.parametrize("scale", [1.0, 1e3])
def test_gaussians_are_sorted_in_every_view_and_while_groups_move(module, parallel, scale):
    draw = np.random.default_rng(0)
    starts = [0, 500, 600, 600, 900]
    positions = draw.normal(size=(900, 3)).astype(np.float32) * scale
    order = module.DepthOrder(positions, starts)
    camera = np.array([0.3, -0.2, 0.9, 5 * scale])
    for step in range(12):
        if step in (4, 8):  # the camera moves
            camera = np.append(draw.normal(size=3), 4 * scale)
        planes = {group: camera.copy() for group in (0, 1, 2, 3)}
        planes[1] += np.array([0.1, 0, 0, 0.2 * scale]) * step  # one group moves all the time
        if step % 5 == 3:
            del planes[3]  # and one is hidden at times
        rows = order.update(planes, 0.01, parallel)
        assert_sorted(rows, depths_of(positions, starts, planes), parallel)


def test_a_view_that_stands_still_keeps_its_order(module):
    positions = np.random.default_rng(1).normal(size=(300, 3)).astype(np.float32)
    order, planes = module.DepthOrder(positions, [0, 300]), {0: np.array([0, 0, 1.0, 5.0])}
    assert order.update(planes, 0.01, False) is order.update(dict(planes), 0.01, False)


def test_groups_whose_positions_change_are_sorted_again(module):
    draw = np.random.default_rng(2)
    positions, starts = draw.normal(size=(400, 3)).astype(np.float32), [0, 100, 400]
    order, planes = module.DepthOrder(positions, starts), dict.fromkeys((0, 1), np.array([0, 0, 1.0, 5.0]))
    for version in range(4):
        positions[:100] = draw.normal(size=(100, 3))
        rows = order.update(planes, 0.01, False, {0: version, 1: 0})
        assert_sorted(rows, depths_of(positions, starts, planes), False)


def test_far_outliers_do_not_coarsen_the_order(module):
    depths = np.append(np.linspace(1, 2, 500), 1e6).astype(np.float32)
    positions = np.stack([0 * depths, 0 * depths, depths], 1)
    rows = module.DepthOrder(positions, [0, 501]).update({0: np.array([0, 0, 1.0, 0])}, 0.01, False)
    assert rows.tolist() == list(range(500, -1, -1))


def test_what_leaves_the_range_of_depths_is_sorted_too(module):
    positions = np.random.default_rng(2).normal(size=(200, 3)).astype(np.float32)
    order, starts = module.DepthOrder(positions, [0, 150, 200]), [0, 150, 200]
    for distance in (5.0, 6.0, 7.0, 1e4, 8.0):
        planes = {0: np.array([0, 0, 1.0, 5.0]), 1: np.array([0, 0, 1.0, distance])}
        rows = order.update(planes, 0.01, False)
        assert_sorted(rows, depths_of(positions, starts, planes), False)


def test_what_comes_near_is_sorted_among_itself(module):
    positions = np.random.default_rng(3).normal(size=(200, 3)).astype(np.float32)
    order, starts = module.DepthOrder(positions, [0, 150, 200]), [0, 150, 200]
    for distance in (40.0, 30.0, 5.0, 4.0):
        planes = {0: np.array([0, 0, 1.0, 40.0]), 1: np.array([0, 0, 1.0, distance])}
        assert_sorted(order.update(planes, 0.01, False), depths_of(positions, starts, planes), False)


@pytest.mark.parametrize("views", [((0.01, False), (0.01, True)), ((3.0, False), (0.01, False))])
def test_another_projection_or_clip_range_is_sorted_again(module, views):
    positions = np.random.default_rng(4).normal(size=(300, 3)).astype(np.float32) * 2
    order, planes = module.DepthOrder(positions, [0, 300]), {0: np.array([0, 0, 1.0, 1.0])}
    for near, parallel in views:
        rows = order.update(planes, near, parallel)
        assert_sorted(rows, depths_of(positions, [0, 300], planes), parallel, near)


def test_nothing_visible_is_no_error(module):
    order = module.DepthOrder(np.zeros((3, 3), np.float32), [0, 3])
    assert len(order.update({}, 0.01, False)) == 0
