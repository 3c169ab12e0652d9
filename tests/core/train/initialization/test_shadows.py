"""The light's direction is estimated from the darkening of the supporting plane."""

import numpy as np

from r5dgs_core.scene import cameras
from r5dgs_core.train import train_views
from r5dgs_core.train.initialization import background_images, shadows, triangulation
from tests.support import scenes

PLANE = (np.array([0.0, 0, 1]), 0.0)
TIMES = np.linspace(0, 1, 7)


def shadowed_views(light, darkness=0.4, radius=0.25):
    """A plain floor with the shadow of a body that moves above it, and the positions of the body."""
    path = np.stack([np.linspace(-0.8, 0.8, 7), 0.3 * np.sin(4 * TIMES), 0.5 + 0.4 * np.cos(3 * TIMES)], -1)
    seen = []
    for k in range(4):
        camera = scenes.orbit_camera(0.5 * k, 64, 48)
        rays = cameras.pixel_rays(camera)
        with np.errstate(divide="ignore"):
            depth = -camera.center[2] / rays[..., 2:]
        hits = camera.center + rays * np.where(depth > 0, depth, np.nan)
        for s, t in enumerate(TIMES):
            fallen = shadows.cast(path[s], light, PLANE)
            inside = np.linalg.norm(np.nan_to_num(hits - fallen, nan=99.0), axis=-1) < radius
            image = np.where(inside[..., None], 180 * (1 - darkness), 180) * np.ones(3)
            mask = np.zeros(image.shape[:2], np.uint16)
            seen.append(train_views.of_arrays(f"v{k}_{s}", camera, float(t), image.astype(np.uint8), mask))
    ones = np.ones((1, 7))
    places = triangulation.ObjectPositions(
        np.array([1]), path[None], ones > 0, ones, np.array([radius]), ones, ones > 0
    )
    return seen, places


def find(seen, places):
    return shadows.find_light(seen, background_images.compute(seen), places, TIMES, PLANE, np.random.default_rng(0))


def test_the_direction_of_the_light_is_found():
    for direction in ([0.4, 0.2, -1.0], [-0.6, 0.5, -0.8], [0.0, 0.0, -1.0]):
        light = np.array(direction) / np.linalg.norm(direction)
        found = find(*shadowed_views(light))
        assert np.degrees(np.arccos(np.clip(found.direction @ light, -1, 1))) < 8
        assert found.darkening > 0.1


def test_without_shadows_the_light_is_assumed_vertical():
    found = find(*shadowed_views(np.array([0.0, 0.6, -0.8]), darkness=0.0))
    assert found.darkening == 0 and np.array_equal(found.direction, [0, 0, -1])


def test_shadows_lie_on_the_plane_and_shift_by_the_slope():
    rng = np.random.default_rng(3)
    normal = rng.normal(size=3)
    normal /= np.linalg.norm(normal)
    light = -normal + 0.5 * rng.normal(size=3)
    light /= np.linalg.norm(light)
    points = rng.normal(size=(20, 3))
    fallen = shadows.cast(points, light, (normal, 0.3))
    np.testing.assert_allclose(fallen @ normal, 0.3, atol=1e-12)
    raised = shadows.cast(points + 0.7 * normal, light, (normal, 0.3))
    np.testing.assert_allclose(raised - fallen, 0.7 * np.tile(shadows.slope(light, normal), (20, 1)), atol=1e-12)
    assert abs(shadows.slope(light, normal) @ normal) < 1e-12
