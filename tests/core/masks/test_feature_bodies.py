"""Rigid bodies among matched points."""

import warnings

import numpy as np
import pytest

from r5dgs_core.masks import feature_bodies as bodies
from r5dgs_core.masks import feature_points
from r5dgs_core.masks.feature_points import Points, matches
from r5dgs_core.motion import rotations
from r5dgs_core.scene.cameras import Camera, project
from tests.support.room import look_at

LENS = np.array([[500.0, 0, 320], [0, 500.0, 240], [0, 0, 1]])
CAMERAS = [
    Camera(640, 480, LENS, np.linalg.inv(look_at((x, 0.3, -4.0), (0.0, 0.0, 0.0))), f"cam{k}")
    for k, x in enumerate((-1.0, 0.0, 1.2))
]


def seen(places, names, rng):
    """Points of one time, with a descriptor per name that hardly changes, and noise of 0.3 pixels."""
    pixels = np.stack([project(camera, places)[0] for camera in CAMERAS], 1)
    descriptors = np.stack([np.random.default_rng(int(name)).normal(size=128) for name in names])
    descriptors = descriptors + rng.normal(scale=0.1, size=descriptors.shape)
    descriptors = (descriptors / np.linalg.norm(descriptors, axis=1, keepdims=True)).astype(np.float32)
    return Points(
        CAMERAS, places, pixels + rng.normal(scale=0.3, size=pixels.shape), np.arange(len(names)), descriptors
    )


def turned(places, k, axis, speed):
    """Points that rotate about an axis and move along it."""
    quat = rotations.rotvecs_to_quats(np.array(axis) * 0.25 * k)
    return rotations.rotate(quat[None], places) + np.array(axis) * speed * k


@pytest.fixture
def moments():
    """Eight times of a static room and two bodies; every fourth point is missing, another set each time."""
    rng = np.random.default_rng(5)
    room, one, other = (rng.uniform(-1, 1, (n, 3)) * size for n, size in ((80, 1.5), (50, 0.4), (30, 0.3)))
    found = []
    for k in range(8):
        places = np.concatenate([room, turned(one, k, (0, 1, 0), 0.08) - [0.5, 0, 0], turned(other, k, (1, 0, 0), 0.1)])
        kept = rng.random(len(places)) > 0.25
        found.append((seen(places[kept], np.flatnonzero(kept), rng), np.flatnonzero(kept)))
    return found


def test_each_body_has_its_points_and_poses(moments):
    times = [points for points, _ in moments]
    found = bodies.find(times, np.random.default_rng(0))
    assert len(found) == 2
    for body, first, count in zip(found, (80, 130), (50, 30), strict=True):
        assert sorted(body.poses) == list(range(8))
        names = set().union(*({int(moments[k][1][row]) for row in rows} for k, rows in body.rows.items()))
        assert names <= set(range(first, first + count)) and len(names) > 0.8 * count
        start = min(body.poses, key=lambda k: np.abs(body.poses[k] - np.eye(3, 4)).max())
        for k, pose in body.poses.items():
            shared = [
                name for name in range(first, first + count) if name in moments[k][1] and name in moments[start][1]
            ]
            before, after = (times[i].places[np.searchsorted(moments[i][1], shared)] for i in (start, k))
            assert np.abs(bodies.applied(pose, before) - after).max() < 0.02
            np.testing.assert_allclose(bodies.undone(pose, bodies.applied(pose, before)), before)


def test_nothing_is_found_in_a_static_room_with_wrong_matches_at_one_time(moments):
    rng = np.random.default_rng(1)
    room = rng.uniform(-1, 1, (60, 3))
    times = [seen(room + (k == 3) * np.array([0.4, 0, 0]), np.arange(60), rng) for k in range(8)]
    assert bodies.find(times, np.random.default_rng(0)) == []


def test_a_body_must_be_registered_at_enough_times(moments):
    times = [points for points, _ in moments]
    rng = np.random.default_rng(2)
    empty = [seen(rng.uniform(-1, 1, (30, 3)), rng.integers(1000, 9999, 30), rng) for _ in range(40)]
    assert bodies.find(times + empty, np.random.default_rng(0)) == []


def test_matches_do_not_depend_on_the_size_of_blocks(moments, monkeypatch):
    one, other = moments[0][0], moments[3][0]
    whole = matches(one, other)
    assert len(whole[0]) > 50
    sizes = []
    mutual = feature_points._mutual
    monkeypatch.setattr(feature_points, "BLOCK", 7)
    monkeypatch.setattr(
        feature_points,
        "_mutual",
        lambda blocks, owners: mutual((sizes.append(block.size) or block for block in blocks), owners),
    )
    for found, expected in zip(matches(one, other), whole, strict=True):
        np.testing.assert_array_equal(found, expected)
    assert max(sizes) == 7 * len(other.descriptors)


def test_an_equal_row_of_a_later_block_does_not_replace_the_first():
    likeness = np.array([[0.9, 0.1], [0.2, 0.8], [0.9, 0.3]], np.float32)
    for blocks in ([likeness], list(likeness[:, None])):
        rows, columns = feature_points._mutual(blocks, np.arange(2))
        assert (rows.tolist(), columns.tolist()) == ([0, 1], [0, 1])


@pytest.mark.parametrize(("count", "other"), [(0, 5), (5, 0), (0, 0)])
def test_times_without_points_have_no_matches(count, other):
    rng = np.random.default_rng(3)
    times = [
        Points(CAMERAS, np.zeros((n, 3)), np.zeros((n, 3, 2)), np.arange(n), rng.random((n, 128), np.float32))
        for n in (count, other)
    ]
    assert [len(rows) for rows in matches(*times)] == [0, 0]


def test_the_search_reports_its_progress(moments):
    shares = []
    bodies.find([points for points, _ in moments], np.random.default_rng(0), shares.append)
    assert shares == sorted(shares) and shares[0] < 0.1 and len(set(shares)) >= 20
    assert 0.8 < shares[-1] <= 1.0


def test_equal_descriptors_do_not_match_and_cause_no_warning():
    same = np.full((4, 128), np.sqrt(np.float32(1 / 127)), np.float32)  # the product is above 1
    points = Points(CAMERAS, np.zeros((4, 3)), np.zeros((4, 3, 2)), np.arange(4), same)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(matches(points, points)[0]) == 0
