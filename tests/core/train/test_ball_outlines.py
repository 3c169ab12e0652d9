"""Balls from outlines: their path and radius are found, also behind a screen, and other bodies are no balls."""

import numpy as np
import pytest

from r5dgs_core.scene import cameras
from r5dgs_core.scene.cameras import Camera
from r5dgs_core.train import ball_outlines, train_views

SIZE, RADIUS = 48, 0.5
TIMES = np.linspace(0, 1, 5)


def camera(angle):
    place = 4 * np.array([np.cos(angle), np.sin(angle), 0.5])
    forward = -place / np.linalg.norm(place)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    turn = np.stack([right, np.cross(forward, right), forward])
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = turn, -turn @ place
    return Camera(SIZE, SIZE, np.array([[60.0, 0, SIZE / 2], [0, 60.0, SIZE / 2], [0, 0, 1]]), matrix)


def path(t):
    return np.array([0.6 * t - 0.3, 0.3 * t, 0.2])


def ball_mask(eye, center):
    away = center - eye.center
    rays = cameras.pixel_rays(eye)
    return np.linalg.norm(away - (rays @ away)[..., None] * rays, axis=-1) < RADIUS


def cube_mask(eye, center):
    rays = cameras.pixel_rays(eye)
    ends = [(center + side * 0.8 * RADIUS - eye.center) / rays for side in (-1, 1)]
    return np.minimum(*ends).max(-1) < np.maximum(*ends).min(-1)


def groups(draw, hide=lambda k, s, mask: mask):
    """Views of five cameras at each time."""
    black, found = np.zeros((SIZE, SIZE, 3), np.uint8), []
    for s, t in enumerate(TIMES):
        eyes = [camera(0.6 * k) for k in range(5)]
        masks = [hide(k, s, draw(eye, path(t))).astype(np.uint8) for k, eye in enumerate(eyes)]
        views = [train_views.of_arrays("v", eye, t, black, mask) for eye, mask in zip(eyes, masks, strict=True)]
        found.append(views)
    return found


def half_hidden(k, s, mask):
    """Hide the right half of the picture of some cameras in the middle of the clip."""
    if k in (1, 2) and 1 <= s <= 3:
        columns = np.flatnonzero(mask.any(0))
        mask = mask & (np.arange(SIZE) < columns.mean())
    return mask


def fitted(draw, hide=lambda k, s, mask: mask):
    start = np.stack([path(t) for t in TIMES]) + 0.05 * np.array([[1, -1, 1]])
    return ball_outlines.fit(ball_outlines.gather(groups(draw, hide), [1])[0], start, TIMES)


@pytest.mark.parametrize("hide", [lambda k, s, mask: mask, half_hidden])
def test_outlines_give_path_and_radius_of_a_ball(hide):
    ball = fitted(ball_mask, hide)
    assert ball is not None
    assert ball.radius == pytest.approx(RADIUS, rel=0.03)
    assert np.linalg.norm(ball.centers - [path(t) for t in TIMES], axis=1).max() < 0.05 * RADIUS


@pytest.mark.parametrize("cameras_per_time", [1, 2])
def test_depth_needs_two_cameras_in_different_directions_at_most_times(cameras_per_time):
    def some(k, s, mask):
        return mask & (k == (s if cameras_per_time == 1 else s % 2) or (cameras_per_time == 2 and k == 2))

    assert (fitted(ball_mask, some) is not None) == (cameras_per_time == 2)


def test_times_without_outlines_are_not_measured():
    def gap(k, s, mask):
        return mask & (s != 2)

    ball = fitted(ball_mask, gap)
    assert ball is not None and ball.measured.tolist() == [True, True, False, True, True]


def test_a_step_solves_the_least_squares_problem():
    rng = np.random.default_rng(0)
    knots, weights = rng.integers(0, 5, 200), rng.uniform(0.1, 1, 200)
    ways, misses, rough = rng.normal(size=(200, 3)), rng.normal(size=200), rng.normal(size=(5, 3))
    bend = np.kron(ball_outlines.second_differences(TIMES), np.eye(3))
    normal = bend.T @ bend
    bands = np.zeros((9, 15))
    for k in range(9):
        bands[8 - k, k:] = np.diagonal(normal, k)
    found, growth = ball_outlines._step(knots, weights, ways, misses, bands, rough)
    slopes = np.zeros((200, 16))
    for axis in range(3):
        slopes[np.arange(200), 3 * knots + axis] = ways[:, axis]
    slopes[:, -1] = -1
    dense = slopes.T @ (weights[:, None] * slopes)
    dense[:15, :15] += normal
    dense[15, 15] += 1e-6
    expected = np.linalg.solve(dense, slopes.T @ (weights * misses) + np.append(rough.ravel(), 0))
    np.testing.assert_allclose(np.append(found.ravel(), growth), expected, atol=1e-9)


def test_a_cube_is_no_ball():
    assert fitted(cube_mask) is None


def test_a_body_without_masks_is_no_ball():
    assert fitted(lambda eye, center: np.zeros((SIZE, SIZE), bool)) is None


def test_second_differences_vanish_for_lines_and_count_steps():
    times = np.array([0.0, 0.1, 0.3, 0.4, 0.9])
    matrix = ball_outlines.second_differences(times)
    assert matrix @ (2 * times - 1) == pytest.approx(0, abs=1e-12)
    assert matrix @ times**2 == pytest.approx(2 * np.diff(times).mean() ** 2)
