"""A stage gives the same pictures as rendering every frame from scratch."""

import dataclasses

import numpy as np
import pytest

from r5dgs_core.motion import rotations
from r5dgs_core.playback import scene_player
from r5dgs_core.raster import RasterSettings, rasterize_splats
from r5dgs_core.raster.cpu import static_layer
from r5dgs_core.render import incremental_renderer, posed_scene, scene_renderer
from r5dgs_core.scene.instance import Instance
from tests.core.render.test_scene_renderer import group_instances, matrix
from tests.support import scenes

CAMERA, OTHER = scenes.orbit_camera(0.7, 80, 72), scenes.orbit_camera(1.1, 80, 72)


@pytest.fixture(scope="module", params=[0, 2])
def scene(request):
    return scenes.make_scene(n=900, sh_degree=request.param, seed=3)


@pytest.fixture
def made(monkeypatch):
    """Count the static layers that are built."""
    count = []
    original = static_layer.StaticLayer.__init__

    def counted(self, *arguments, **options):
        count.append(1)
        original(self, *arguments, **options)

    monkeypatch.setattr(static_layer.StaticLayer, "__init__", counted)
    return count


def assert_shows(theatre, scene, instances, camera, sky=True):
    found = theatre.render(instances, camera, sky=incremental_renderer.Sky() if sky else None)
    posed = posed_scene.pose_instances(scene, instances)
    owners = np.repeat(np.arange(len(instances), dtype=np.int32), [instance.count for instance in instances])
    posed = dataclasses.replace(posed, object_ids=owners)
    expected = scene_renderer.render_frame(scene, posed, camera, background="scene" if sky else None)
    for name in ("color", "alpha", "depth", "ids"):
        assert np.array_equal(getattr(found, name), getattr(expected, name)), name


def test_playback_shows_every_frame_and_draws_static_objects_once(scene, made):
    theatre = incremental_renderer.IncrementalRenderer(scene)
    for t in (0.0, 0.1, 0.2, 0.9, 1.4):
        assert_shows(theatre, scene, group_instances(scene, t), CAMERA)
    assert len(made) == 1


def test_another_camera_sky_or_selection_redraws_everything(scene, made):
    theatre = incremental_renderer.IncrementalRenderer(scene)
    for t in (0.0, 0.3, 0.5):
        assert_shows(theatre, scene, group_instances(scene, t), CAMERA)
    assert_shows(theatre, scene, group_instances(scene, 0.5), OTHER)
    assert_shows(theatre, scene, group_instances(scene, 0.6), OTHER, sky=False)
    assert_shows(theatre, scene, group_instances(scene, 0.7)[:-1], OTHER, sky=False)
    assert len(made) == 1
    assert_shows(theatre, scene, group_instances(scene, 0.8)[:-1], OTHER, sky=False)
    assert len(made) == 2


def test_instances_that_start_to_move_leave_the_static_layer(scene, made):
    theatre, instances = incremental_renderer.IncrementalRenderer(scene), group_instances(scene, 0.4)
    for moving in ((), (1,), (1, 2), (2,), ()):
        shown = []
        for i, instance in enumerate(instances):
            matrix = instance.matrix.copy()
            matrix[0, 3] += 0.1 * (i in moving)
            shown.append(Instance(instance.start, instance.count, matrix))
        assert_shows(theatre, scene, shown, CAMERA)
    assert len(made) == 2


def test_without_static_instances_no_layer_is_cached(scene, made):
    theatre = incremental_renderer.IncrementalRenderer(scene)
    for shift in (0.0, 0.1, 0.2):
        matrix = np.eye(4)
        matrix[0, 3] = shift
        assert_shows(theatre, scene, [Instance(0, len(scene.gaussians.means), matrix)], CAMERA)
    assert not made


def test_bodies_at_equal_depths_keep_their_order_whichever_moves():
    scene = scenes.make_scene(n=900, seed=3)
    flat = scene.with_arrays(means=scene.gaussians.means * np.array([1, 1, 0], np.float32))
    above = scenes.looking_camera((0, 0, 5.0), (0, 0, -1.0), 0.8, 80, 72, up=(0, 1.0, 0))
    instances = group_instances(flat, 1.0)
    instances = [Instance(one.start, one.count, np.eye(4)) for one in instances]
    theatre = incremental_renderer.IncrementalRenderer(flat)
    for shift in (0.0, 0.1, 0.2):
        shown = []
        for i, instance in enumerate(instances):
            matrix = np.eye(4)
            matrix[0, 3] = shift * (i in (1, 2))
            shown.append(Instance(instance.start, instance.count, matrix))
        shown = [shown[1], shown[0], *shown[2:]]
        assert_shows(theatre, flat, shown, above)


def test_a_bad_instance_is_named_by_the_callers_index(scene):
    theatre, instances = incremental_renderer.IncrementalRenderer(scene), group_instances(scene, 0.4)
    theatre.render(instances, CAMERA)
    theatre.render(group_instances(scene, 0.5), CAMERA)
    last = len(instances) - 1
    bad = [*instances[:last], Instance(instances[last].start, instances[last].count, np.zeros((4, 4)))]
    for _ in range(2):
        with pytest.raises(ValueError, match=f"instance {last}: "):
            theatre.render(bad, CAMERA)
    assert_shows(theatre, scene, instances, CAMERA)


@pytest.fixture(scope="module")
def pair():
    """Two scenes of different degrees, one with shading and a light, and the transform of the second one's world."""
    lit = scenes.make_scene(n=500, sh_degree=1, seed=3)
    plain = scenes.make_scene(n=400, sh_degree=0, seed=8, shading=False)
    assert lit.shading is not None and lit.shading is not None
    return lit, plain, matrix((0.9, 0.2, -0.3, 0.1), (0.5, -0.3, 0.2), 0.7)


def together(pair, t, tint=None):
    """Instances of both scenes, each in its own world."""
    lit, plain, world = pair
    first = group_instances(lit, t)
    second = [Instance(one.start, one.count, world @ one.matrix, 1, world, tint) for one in group_instances(plain, t)]
    return [*second[:2], *first, *second[2:]]


def test_two_scenes_are_sorted_by_depth_in_one_picture(pair, made):
    lit, plain, world = pair
    theatre = incremental_renderer.IncrementalRenderer([lit, plain])
    for t in (0.2, 0.5, 0.8):
        shown = together(pair, t)
        found = theatre.render(shown, CAMERA, sky=incremental_renderer.Sky(1, world))
        parts = [
            posed_scene.pose_instances(scene, [dataclasses.replace(one, scene=0) for one in shown if one.scene == k])
            for k, scene in enumerate((lit, plain))
        ]
        gaussians = [scene_renderer.PosedGaussians(posed) for posed in parts]
        inputs = [np.concatenate([getattr(one, name) for one in gaussians]) for name in ("means", "quats", "scales")]
        opacities = np.concatenate([one.opacities for one in gaussians])
        colors = np.concatenate([scene_renderer.colors(posed, CAMERA) for posed in parts])
        eye = dataclasses.replace(CAMERA, T_cam_world=CAMERA.T_cam_world @ world)
        behind = scene_renderer.sky(plain, eye)
        settings = RasterSettings(near_plane=0.7 * lit.near_plane)
        expected = rasterize_splats(*inputs, opacities, colors, CAMERA, behind, settings=settings)
        # Other orders of rows, and of the operations behind a padded degree.
        np.testing.assert_allclose(found.color, expected.image, atol=1e-4)
        np.testing.assert_allclose(found.alpha, expected.alpha, atol=1e-5)


def test_a_light_rotates_with_its_world_and_not_with_moving_objects(pair):
    lit, _, world = pair
    still = posed_scene.pose_instances(lit, group_instances(lit, 0.3))
    turned = [Instance(one.start, one.count, world @ one.matrix, 0, world) for one in group_instances(lit, 0.3)]
    found = posed_scene.pose_instances(lit, turned)
    np.testing.assert_allclose(found.shading_factor, still.shading_factor, atol=1e-6)
    assert np.abs(still.shading_factor - 1).max() > 1e-2


@pytest.mark.parametrize("degree", [0, 2])
def test_a_tint_is_that_of_the_harmonics(degree):
    scene = scenes.make_scene(n=300, sh_degree=degree, seed=5)
    tint, c0 = np.array([0.3, 1.5, 0.0]), 0.28209479177387814
    sh = tint * scene.gaussians.sh.astype(np.float64)
    sh[:, 0] = (tint * (0.5 + c0 * scene.gaussians.sh[:, 0]) - 0.5) / c0
    painted = scene.with_arrays(sh=sh.astype(np.float32))
    n = len(scene.gaussians.means)
    one = incremental_renderer.IncrementalRenderer(scene).render([Instance(0, n, np.eye(4), tint=tuple(tint))], CAMERA)
    other = incremental_renderer.IncrementalRenderer(painted).render([Instance(0, n, np.eye(4))], CAMERA)
    np.testing.assert_allclose(one.color, other.color, atol=1e-5)


def test_owners_are_the_instances_in_front_whichever_of_them_move(pair, made):
    theatre = incremental_renderer.IncrementalRenderer(pair[:2])
    shown = [*together(pair, 0.4), *together(pair, 0.4, (1.0, 0.2, 0.2))[:2]]
    for t in (0.4, 0.5, 0.6):
        moved = together(pair, t)
        shown = [*moved[:3], *shown[3:]]
        found = theatre.render(shown, CAMERA)
        anew = incremental_renderer.IncrementalRenderer(pair[:2]).render(shown, CAMERA)
        assert np.array_equal(found.ids, anew.ids) and np.array_equal(found.color, anew.color)
    assert len(made) >= 1 and found.ids.max() > 2 and found.ids.min() == -1


def test_another_tint_or_near_limit_is_another_picture(pair):
    lit = pair[0]
    whole, red = Instance(0, 500, np.eye(4)), Instance(0, 500, np.eye(4), tint=(1.0, 0.0, 0.0))
    theatre = incremental_renderer.IncrementalRenderer(lit)
    for _ in range(2):
        plain = theatre.render([whole], CAMERA)
    tinted = theatre.render([red], CAMERA, sky=None)
    assert tinted.color[..., 1:].max() == 0 and tinted.color[..., 0].max() > 0.1
    near = theatre.render([whole], CAMERA, near=1e3)
    assert near.alpha.max() == 0 and plain.alpha.max() > 0.5


def test_a_sky_rotates_with_its_world(pair):
    lit, _, world = pair
    sky = np.random.default_rng(0).normal(scale=0.3, size=(9, 3)).astype(np.float32)
    scene = lit.with_arrays(background_sh=sky)
    rigid = matrix((0.9, 0.2, -0.3, 0.1), (0.5, -0.3, 0.2), 1.0)
    eye = dataclasses.replace(CAMERA, T_cam_world=CAMERA.T_cam_world @ rigid)
    found = incremental_renderer.IncrementalRenderer(scene).render([], CAMERA, sky=incremental_renderer.Sky(0, rigid))
    np.testing.assert_allclose(found.color, scene_renderer.sky(scene, eye), atol=1e-5)
    scaled = incremental_renderer.IncrementalRenderer(scene).render([], CAMERA, sky=incremental_renderer.Sky(0, world))
    np.testing.assert_allclose(scaled.color, found.color, atol=1e-5)


def test_without_any_scene_the_picture_is_black():
    found = incremental_renderer.IncrementalRenderer([]).render([], CAMERA, sky=None)
    assert np.abs(found.color).max() == 0 and found.ids.max() == -1


@pytest.mark.parametrize(
    ("instance", "message"),
    [
        (Instance(0, 5, np.eye(4), scene=2), "scene below 2, got 2"),
        (Instance(450, 5, np.eye(4), scene=1), "leave the scene's 400"),
        (Instance(0, 5, np.eye(4), tint=(1.0, -1.0, 1.0)), "tint"),
        (Instance(0, 5, np.eye(4), world=np.zeros((4, 4))), "singular"),
    ],
)
def test_impossible_instances_of_several_scenes_are_refused(pair, instance, message):
    with pytest.raises(ValueError, match=f"instance 0: .*{message}"):
        incremental_renderer.IncrementalRenderer(pair[:2]).render([instance], CAMERA)


def bent_instances(scene, t):
    return [dataclasses.replace(one, t=t) for one in group_instances(scene, t)]


@pytest.fixture(scope="module", params=[0, 2])
def bending(request):
    scene, rng = scenes.make_scene(n=600, sh_degree=request.param, seed=5), np.random.default_rng(1)
    rows = np.arange(0, 600, 3, dtype=np.int32)
    fade = (scenes.T_MAX - scenes.TIMES)[None, :, None]
    offsets, turns, growths = (size * rng.normal(size=(len(rows), 1, 3)) * fade for size in (0.3, 2.0, 0.5))
    return scene.with_arrays(
        residual_rows=rows,
        residual_offsets=offsets.astype(np.float32),
        residual_quats=rotations.rotvecs_to_quats(turns).astype(np.float32),
        residual_log_scales=growths.astype(np.float32),
    )


@pytest.mark.parametrize("t", [-0.1, 0.13, 0.4, scenes.T_MAX, 0.9])
def test_deformed_gaussians_match_playback(bending, t):
    found = incremental_renderer.IncrementalRenderer(bending).render(bent_instances(bending, t), CAMERA)
    expected = scene_renderer.render_frame(bending, scene_player.Player(bending).frame(t), CAMERA)
    np.testing.assert_allclose(found.color, expected.color, atol=5e-3)  # a cut-off may fall differently
    if 0 < t < scenes.T_MAX:
        stiff = incremental_renderer.IncrementalRenderer(bending).render(group_instances(bending, t), CAMERA)
        assert np.abs(stiff.color - expected.color).max() > 0.05


def test_deformed_gaussians_in_a_moved_world_give_the_same_image(bending):
    world = matrix((0.9, 0.2, -0.3, 0.1), (0.5, -0.3, 0.2))
    shown = [
        Instance(one.start, one.count, world @ one.matrix, 0, world, t=0.2) for one in bent_instances(bending, 0.2)
    ]
    eye = dataclasses.replace(CAMERA, T_cam_world=CAMERA.T_cam_world @ np.linalg.inv(world))
    found = incremental_renderer.IncrementalRenderer(bending).render(shown, eye, sky=incremental_renderer.Sky(0, world))
    expected = incremental_renderer.IncrementalRenderer(bending).render(bent_instances(bending, 0.2), CAMERA)
    np.testing.assert_allclose(found.color, expected.color, atol=5e-3)


def test_deforming_gaussians_are_redrawn_and_others_stay_cached(bending, made):
    theatre = incremental_renderer.IncrementalRenderer(bending)
    for t in (0.1, 0.2, 0.3):
        shown = [dataclasses.replace(one, matrix=np.eye(4)) for one in bent_instances(bending, t)]
        found = theatre.render(shown, CAMERA)
        anew = incremental_renderer.IncrementalRenderer(bending).render(shown, CAMERA)
        assert np.array_equal(found.color, anew.color) and np.array_equal(found.ids, anew.ids)


def test_depths_may_count_from_before_a_far_camera(pair):
    lit = pair[0]
    far = 1e4
    eye = dataclasses.replace(CAMERA, intrinsics=CAMERA.intrinsics @ np.diag([far / 4, far / 4, 1.0]))
    eye = dataclasses.replace(eye, T_cam_world=CAMERA.T_cam_world + np.array([0, 0, 0, far]) * np.eye(4)[2][:, None])
    parts = [Instance(0, 400, np.eye(4)), Instance(400, 100, np.eye(4))]
    theatre = incremental_renderer.IncrementalRenderer(lit)
    for shift in (0.0, 0.1, 0.2):
        parts[1].matrix[0, 3] = shift
        found = theatre.render(parts, eye, distance=far)
        plain = incremental_renderer.IncrementalRenderer(lit).render(parts, eye)
        assert np.array_equal(found.color, plain.color) and np.array_equal(found.ids, plain.ids)
        seen = found.alpha > 0
        np.testing.assert_allclose(found.depth[seen], plain.depth[seen] - far, atol=0.02)  # float32 at 1e4
        assert (found.depth[~seen] == 0).all() and seen.any()
        depths = posed_scene.pose_instances(lit, parts).means @ CAMERA.T_cam_world[2, :3] + CAMERA.T_cam_world[2, 3]
        assert depths.min() - 1e-4 < found.depth[seen].min() and found.depth[seen].max() < depths.max() + 1e-4


@pytest.mark.parametrize("t", [None, 0.2])
def test_many_ranges_give_the_picture_of_their_instances(bending, t):
    world = matrix((0.9, 0.2, -0.3, 0.1), (0.5, -0.3, 0.2))
    starts = [*range(0, 300, 7), *range(20, 100, 5)]
    stretches = [Instance(start, 4, world, 0, world, (0.5, 1.0, 1.0), t) for start in starts]
    found = posed_scene.pose_instances(bending, stretches)
    parts = [posed_scene.pose_instances(bending, [one]) for one in stretches]
    for name in ("means", "quats", "log_scales", "shading_factor", "sh", "object_ids"):
        expected = np.concatenate([getattr(part, name) for part in parts])
        np.testing.assert_allclose(getattr(found, name), expected, atol=1e-6, err_msg=name)
    expected = np.concatenate([scene_renderer.colors(part, CAMERA) for part in parts])
    np.testing.assert_allclose(scene_renderer.colors(found, CAMERA), expected, atol=1e-5)
