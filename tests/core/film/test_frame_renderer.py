"""Pictures and layers of frames."""

import numpy as np
import pytest

from r5dgs_core.film import frame_renderer
from r5dgs_core.playback import scene_player
from r5dgs_core.render import highlight, scene_renderer

T = 1.1


@pytest.fixture
def camera(scene):
    return scene.cameras[0]


def test_a_picture_is_that_of_the_shared_renderer(scene, camera):
    found = frame_renderer.FrameRenderer(scene).picture(camera, T)
    expected = scene_renderer.render(scene_player.Player(scene), camera, T).color
    np.testing.assert_array_equal(found[..., :3], expected)
    assert (found[..., 3] == 1).all()


def test_a_transparent_picture_over_the_sky_is_the_opaque_one(scene, camera):
    found = frame_renderer.FrameRenderer(scene, transparent=True).picture(camera, T)
    alpha = found[..., 3:]
    sky = scene_renderer.sky(scene, camera)
    opaque = frame_renderer.FrameRenderer(scene).picture(camera, T)[..., :3]
    np.testing.assert_allclose(found[..., :3] * alpha + sky * (1 - alpha), opaque, atol=2e-6)
    assert (found[..., :3][alpha[..., 0] < 1e-7] == 0).all()


def test_supersampling_averages_a_larger_picture(scene, camera):
    found = frame_renderer.FrameRenderer(scene, samples=3).picture(camera, T)
    once = frame_renderer.FrameRenderer(scene).picture(camera, T)
    assert found.shape == once.shape and 1e-4 < np.abs(found - once).mean() < 0.05
    assert found.mean() == pytest.approx(once.mean(), abs=0.01)


def test_only_the_chosen_objects_are_drawn(scene, camera):
    rows = frame_renderer.rows_of(scene, shown={2, 3})
    found = frame_renderer.FrameRenderer(scene, rows=rows, transparent=True).picture(camera, T)
    expected = highlight.isolate(scene, {2, 3}, camera, T)
    np.testing.assert_allclose(np.clip(found, 0, 1), expected, atol=1e-6)


def test_hidden_objects_take_their_shadow_along(scene):
    rows = frame_renderer.rows_of(scene, hidden={1})
    (shadow,) = (group for group in scene.groups if group.role == "shadow")
    gone = np.setdiff1d(np.arange(len(scene.gaussians.means)), rows)
    expected = (scene.gaussians.object_ids == 1) | (scene.gaussians.motion_ids == shadow.id)
    assert shadow.object_id == 1
    np.testing.assert_array_equal(gone, np.flatnonzero(expected))
    assert frame_renderer.rows_of(scene) is None
    np.testing.assert_array_equal(
        frame_renderer.rows_of(scene, {1, 2}, {1}), np.flatnonzero(scene.gaussians.object_ids == 2)
    )


def test_layers_agree_with_each_other(scene, camera):
    layers = frame_renderer.FrameRenderer(scene).layers(camera, T)
    solid = layers.alpha >= frame_renderer.SOLID
    assert solid.any() and not solid.all()
    assert (layers.depth[~solid] == frame_renderer.NOTHING).all() and (layers.depth[solid] < 10).all()
    assert (layers.index[~solid] == 0).all() and set(np.unique(layers.index)) <= {0, 1, 2, 3}
    np.testing.assert_allclose(layers.shares.sum(-1), layers.alpha, atol=1e-4)
    clear = solid & (layers.shares[..., 0] > 0.9)
    np.testing.assert_array_equal(layers.objects[..., 0][clear], layers.index[clear])
