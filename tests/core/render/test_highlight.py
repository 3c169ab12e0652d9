"""Pictures of some objects: alone, without the rest of the scene; in place, with the rest in gray."""

import dataclasses

import numpy as np
import pytest

from r5dgs_core.errors import ConfigError
from r5dgs_core.playback import scene_player
from r5dgs_core.render import highlight, scene_renderer, viewpoints
from r5dgs_core.scene import cameras
from tests.support import scenes

BACKEND = "reference"
CAMERA = scenes.orbit_camera(0.5, 48, 36)
LATER = 1.1


def drawn(scene, t, background):
    frame = scene_player.Player(scene).frame(t, origin=CAMERA.center)
    return scene_renderer.render_frame(scene, frame, CAMERA, background=background, backend=BACKEND)


def rows_of(scene, object_id):
    """The scene with only one object's Gaussians."""
    kept = scene.gaussians.object_ids == object_id
    arrays = ("means", "quats", "log_scales", "opacity_logits", "sh", "object_ids", "motion_ids", "shading")
    cut = {name: scene.arrays()[name][kept] for name in arrays}
    return scene.with_arrays(**cut, identities=None)


@pytest.mark.parametrize("t", [0.2, LATER])
def test_an_object_alone_looks_like_a_scene_of_its_own_gaussians(scene, t):
    found = highlight.isolate(scene, [2], CAMERA, t, backend=BACKEND)
    alone = drawn(rows_of(scene, 2), t, None)
    np.testing.assert_allclose(found[..., 3], alone.alpha, atol=1e-6)
    premultiplied = np.clip(alone.color, 0, found[..., 3:])
    np.testing.assert_allclose(found[..., :3] * found[..., 3:], premultiplied, atol=1e-5)
    assert found[..., 3].max() > 0.5 and found[..., 3].min() == 0


def test_all_objects_together_are_the_whole_picture(scene):
    everything = [item.id for item in scene.objects]
    alone = highlight.isolate(scene, everything, CAMERA, 0.4, backend=BACKEND)
    np.testing.assert_allclose(alone[..., 3], drawn(scene, 0.4, None).alpha, atol=1e-6)
    shown = highlight.highlight(scene, everything, CAMERA, 0.4, backend=BACKEND)
    whole = np.clip(drawn(scene, 0.4, "scene").color, 0, 1)
    solid = alone[..., 3] > 0.999
    assert solid.any()
    np.testing.assert_allclose(shown[solid], whole[solid], atol=2e-3)


def test_objects_without_highlight_are_gray_and_dim(scene):
    whole = np.clip(drawn(scene, 0.4, "scene").color, 0, 1)
    nothing = highlight.highlight(scene, [], CAMERA, 0.4, backend=BACKEND)
    assert np.ptp(nothing, axis=-1).max() < 1e-6
    assert (nothing.max(axis=-1) <= highlight.DIMMED * whole.max(axis=-1) + 1e-6).all()
    some = highlight.highlight(scene, [2], CAMERA, 0.4, backend=BACKEND)
    hidden = highlight.isolate(scene, [2], CAMERA, 0.4, backend=BACKEND)[..., 3] == 0
    np.testing.assert_array_equal(some[hidden], nothing[hidden])
    assert np.abs(some - nothing).max() > 0.1


def test_an_object_is_drawn_alone_even_if_others_hide_it(scene):
    toward = scene.gaussians.means[scene.gaussians.object_ids == 1].mean(0) - CAMERA.center
    behind = [item for item in scene.objects if item.id == 1]
    wall = scene.with_arrays(
        means=np.where(
            (scene.gaussians.object_ids == 3)[:, None], CAMERA.center + 0.5 * toward, scene.gaussians.means
        ).astype(np.float32),
        log_scales=np.where((scene.gaussians.object_ids == 3)[:, None], 0.0, scene.gaussians.log_scales).astype(
            np.float32
        ),
    )
    before = highlight.isolate(scene, [behind[0].id], CAMERA, scene.t_max, backend=BACKEND)
    after = highlight.isolate(wall, [behind[0].id], CAMERA, scene.t_max, backend=BACKEND)
    np.testing.assert_array_equal(before, after)


def test_cameras_are_found_by_name_and_by_number(scene):
    assert viewpoints.named(scene, scene.cameras[1].name) is scene.cameras[1]
    assert viewpoints.named(scene, "1") is scene.cameras[1]
    swapped = tuple(dataclasses.replace(c, name=n) for c, n in zip(scene.cameras, "10", strict=True))
    assert viewpoints.named(dataclasses.replace(scene, cameras=swapped), "1").name == "1"
    for wrong in ("2", "-1", "left", ""):
        with pytest.raises(ConfigError, match="expected 0 to 1, or a name of a camera: orbit_0.30"):
            viewpoints.named(scene, wrong)
    with pytest.raises(ConfigError, match="stores no cameras"):
        viewpoints.named(dataclasses.replace(scene, cameras=()), "0")


def test_the_best_viewpoint_shows_the_most_objects(scene):
    away = scenes.looking_camera([9.0, 0, 1], [1.0, 0, 0], 0.9, 48, 36, "away")
    near = scenes.looking_camera(
        scene.gaussians.means[scene.gaussians.object_ids == 2].mean(0) + [0.4, 0, 0], [-1.0, 0, 0], 0.5, 48, 36
    )
    among = [viewpoints.Viewpoint(camera, 0.3) for camera in (away, near, scenes.orbit_camera(0.3))]
    ids = [item.id for item in scene.objects if item.id > 0]
    assert viewpoints.best(scene, among, ids, backend=BACKEND) is among[2]
    assert viewpoints.best(scene, among[:2], [2], backend=BACKEND) is among[1]
    assert viewpoints.best(scene, among[:1], [2], backend=BACKEND) is among[0]


def test_candidates_are_cameras_at_times(scene):
    every = viewpoints.candidates(scene)
    assert {round(s.t, 6) for s in every} == {0.0, round(scene.t_max / 2, 6), scene.t_max}
    assert len(every) == 3 * len(scene.cameras)
    (one,) = viewpoints.candidates(scene, "0", LATER)
    assert one.t == LATER and one.camera is scene.cameras[0]
    many = dataclasses.replace(scene, cameras=scene.cameras * 100)
    assert len(viewpoints.candidates(many, t=0.0)) == viewpoints.MAX_CAMERAS
    with pytest.raises(ConfigError, match="--time nan"):
        viewpoints.candidates(scene, t=float("nan"))


@pytest.mark.parametrize("convention", sorted(cameras.WORLD_TO_BLENDER))
def test_a_scene_without_cameras_is_viewed_obliquely_from_above(convention):
    scene = scenes.make_scene(n=400, objects=3, seed=2, world_convention=convention)
    turn = cameras.WORLD_TO_BLENDER[convention].T
    turned = dataclasses.replace(
        scene.with_arrays(means=(scene.gaussians.means @ turn.T).astype(np.float32)), cameras=()
    )
    camera = viewpoints.overview(turned)
    pixels, depth = cameras.project(camera, turned.gaussians.means[turned.gaussians.object_ids > 0].astype(np.float64))
    inside = (depth > 0) & (pixels >= 0).all(-1) & (pixels < [camera.width, camera.height]).all(-1)
    assert inside.mean() > 0.95
    rotation = camera.T_cam_world[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1)
    up = turn @ [0, 0, 1.0]
    assert rotation[1] @ up < -0.5 and camera.forward @ up < -0.2  # y of the picture points down, and it looks down
    (only,) = {s.camera.name for s in viewpoints.candidates(turned)}
    assert only == "overview"


def test_a_resized_camera_keeps_its_field_of_view():
    camera = cameras.resized(CAMERA, 96)
    assert (camera.width, camera.height) == (96, 72)
    points = np.array([[0.1, 0.2, 0.3], [-0.5, 0.1, 0.0]])
    np.testing.assert_allclose(cameras.project(camera, points)[0], 2 * cameras.project(CAMERA, points)[0])
