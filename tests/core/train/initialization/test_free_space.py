"""Background that would hide objects which the masks show."""

import dataclasses

import numpy as np
import pytest
import torch

from r5dgs_core.config.config import Config
from r5dgs_core.scene import cameras
from r5dgs_core.train.initialization import free_space, place_gaussians, triangulation
from tests.core.train.initialization.test_triangulation import TIMES, disc_view, ring

PATH = np.array([[0.5, 0.1, 0.3], [0.1, 0.2, 0.5], [-0.3, 0.3, 0.3]])


@pytest.fixture(scope="module")
def seen():
    """Views of a ball of radius 0.3 on PATH, and its positions."""
    views = [disc_view(c, t, [(4, p, 0.3)]) for t, p in zip(TIMES, PATH, strict=True) for c in ring()]
    return views, triangulation.locate(views, TIMES, 5e-4)


def on_ray(camera, point, distance):
    """Point on the line from a camera to another point, at a distance beyond it."""
    arm = point - camera.center
    return point + distance * arm / np.linalg.norm(arm)


def test_points_between_a_camera_and_an_object_are_in_the_free_space(seen):
    for number, camera in enumerate(ring()):
        space = free_space.FreeSpace(seen[0][number :: len(ring())], TIMES, seen[1])
        assert space.contains(np.stack([on_ray(camera, p, -1.0) for p in PATH])).all()
        assert not space.contains(np.stack([on_ray(camera, p, 1.0) for p in PATH])).any()


def test_points_beside_objects_and_behind_cameras_are_not(seen):
    space = free_space.FreeSpace(seen[0], TIMES, seen[1])
    center, forward = ring()[0].center, ring()[0].forward
    assert not space.contains(np.array([[0.0, 0.0, -2.0], [0.0, 0.0, 3.0], center - forward])).any()


def test_hidden_parts_of_an_object_free_nothing(seen):
    camera = ring()[0]
    hider = on_ray(camera, PATH[0], -1.0)
    views = [disc_view(camera, 0.0, [(4, PATH[0], 0.3)])]
    mask = np.array(views[0].mask)
    pixel = cameras.project(camera, hider[None])[0][0].astype(int)
    mask[pixel[1] - 4 : pixel[1] + 5, pixel[0] - 4 : pixel[0] + 5] = 0
    space = free_space.FreeSpace([views[0].with_arrays(mask=mask)], TIMES, seen[1])
    assert not space.contains(hider[None]).any()


def test_the_space_is_kept_free_only_if_background_is_in_it(seen):
    behind = np.tile([0.0, 0.0, -2.0], (200, 1))
    before = on_ray(ring()[0], PATH[0], -1.0)[None]
    views, places = seen
    assert free_space.find(views, TIMES, places, np.concatenate([behind, before])) is None
    assert free_space.find(views, TIMES, places, np.concatenate([behind, np.repeat(before, 4, 0)])) is not None
    assert free_space.find(views, TIMES, places, np.zeros((0, 3))) is None


def test_without_masks_no_space_is_known_to_be_free(seen):
    views = [dataclasses.replace(view, load_mask=None) for view in seen[0]]
    before = on_ray(ring()[0], PATH[0], -1.0)[None]
    assert not free_space.FreeSpace(views, TIMES, seen[1]).contains(before).any()


def test_background_gaussians_in_it_become_invisible_and_those_of_objects_do_not(seen):
    space = free_space.FreeSpace(seen[0], TIMES, seen[1])
    before = on_ray(ring()[0], PATH[0], -1.0)
    clouds = [(np.stack([before, [0.0, 0.0, -2.0]]), np.full((2, 3), 0.5), 0), (before[None], np.full((1, 3), 0.5), 1)]
    gaussians = place_gaussians.gaussians_of([place_gaussians.solid(clouds, 0.25)], 0)
    free_space.clear(space, gaussians)
    opacities = torch.sigmoid(gaussians.params["opacity_logits"].detach())
    assert opacities[0] < min(1 / 255, Config().densify.prune_opacity)
    np.testing.assert_allclose(opacities[1:], 0.25, rtol=1e-5)
