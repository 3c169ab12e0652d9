"""Coverage of pixels by groups."""

import numpy as np
import pytest

from r5dgs_core.playback import scene_player
from r5dgs_core.raster import RasterSettings
from r5dgs_core.render import coverage, posed_scene, scene_renderer
from tests.support import scenes


@pytest.fixture(scope="module")
def posed():
    scene = scenes.make_scene(n=500, objects=4, seed=3)
    return scene, posed_scene.pose_frame(scene, scene_player.Player(scene).frame(0.4))


def shares(posed, groups, ranks):
    scene, pose = posed
    return coverage.shares(pose, groups, scene.cameras[0], ranks=ranks, settings=RasterSettings(near_plane=0.01))


def picture(posed):
    scene, pose = posed
    return scene_renderer.render_frame(scene, pose, scene.cameras[0], settings=RasterSettings(near_plane=0.01))


def test_the_shares_of_all_groups_are_alpha_in_falling_order(posed):
    groups = posed[0].gaussians.object_ids + 1
    found, parts = shares(posed, groups, 6)
    np.testing.assert_allclose(parts.sum(-1), picture(posed).alpha, atol=1e-5)
    assert (np.diff(parts, axis=-1) <= 0).all() and (found[parts == 0] == -1).all()
    assert set(np.unique(found)) - {-1} <= set(groups.tolist())


def test_fewer_ranks_keep_the_largest(posed):
    groups = posed[0].gaussians.object_ids + 1
    all_found, all_parts = shares(posed, groups, 6)
    found, parts = shares(posed, groups, 2)
    np.testing.assert_array_equal(parts, all_parts[..., :2])
    np.testing.assert_array_equal(found[parts > 0], all_found[..., :2][parts > 0])


def test_more_groups_than_one_pass_holds_are_as_exact(posed):
    scene, _ = posed
    many = np.arange(len(scene.gaussians.means)) % (2 * coverage.CHANNELS + 3)
    found, parts = shares(posed, many, len(np.unique(many)))
    np.testing.assert_allclose(parts.sum(-1), picture(posed).alpha, atol=1e-5)
    alone = np.where(many == 17, 17, -1)
    _, part = shares(posed, alone, 1)
    np.testing.assert_allclose(np.where(found == 17, parts, 0).sum(-1), part[..., 0], atol=1e-6)


def test_gaussians_without_group_still_occlude(posed):
    groups = np.where(posed[0].gaussians.object_ids == 1, 0, -1)
    _, parts = shares(posed, groups, 2)
    _, all_parts = shares(posed, np.zeros_like(groups), 2)
    assert (parts[..., 1] == 0).all() and (parts[..., 0] <= all_parts[..., 0] + 1e-6).all()
    assert 0 < parts[..., 0].sum() < 0.9 * all_parts[..., 0].sum()
