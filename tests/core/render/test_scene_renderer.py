"""Laws of rendering a posed scene."""

import dataclasses

import numpy as np
import pytest
import torch

import r5dgs_core
from r5dgs_core.data import images
from r5dgs_core.evaluation import evaluate
from r5dgs_core.motion import rotations
from r5dgs_core.playback import scene_player
from r5dgs_core.raster import RasterSettings
from r5dgs_core.render import highlight, posed_scene, scene_renderer
from r5dgs_core.scene import row_runs
from r5dgs_core.scene.instance import Instance
from r5dgs_core.train import background
from tests.support import scenes

CAMERA = scenes.orbit_camera(0.7, 48, 40)
# Two float32 orders of the same operations: a cut-off (alpha < 1/255) may fall differently in a pixel or two.
TOLERANCE = 5e-3


@pytest.fixture(scope="module")
def scene():
    return scenes.make_scene(n=300, sh_degree=2, seed=3)


def matrix(rotation=(1.0, 0, 0, 0), translation=(0.0, 0, 0), scale=1.0):
    result = np.eye(4)
    result[:3, :3] = rotations.quats_to_rotmats(rotations.normalize(np.asarray(rotation, np.float64))) * scale
    result[:3, 3] = translation
    return result


def whole(scene, transform):
    return [Instance(0, len(scene.gaussians.means), transform)]


def image(scene, pose, camera=CAMERA, **options):
    return scene_renderer.render_frame(scene, pose, camera, **options).color


def group_instances(scene, t):
    quats, displacements = scene_player.Player(scene).group_poses(t)
    result = []
    for start, stop, g in row_runs.runs(scene.gaussians.motion_ids):
        pivot = scene.groups[g].pivot
        transform = matrix(quats[g])
        transform[:3, 3] = pivot + displacements[g] - transform[:3, :3] @ pivot
        result.append(Instance(start, stop - start, transform))
    return result


@pytest.mark.parametrize("t", [0.0, 0.31, scenes.T_MAX, 0.93])
def test_instances_at_the_groups_poses_render_like_playback(scene, t):
    played = image(scene, scene_player.Player(scene).frame(t))
    posed = image(scene, posed_scene.pose_instances(scene, group_instances(scene, t)))
    np.testing.assert_allclose(posed, played, atol=TOLERANCE)


def test_identity_instances_are_the_bind_state(scene):
    posed = posed_scene.pose_instances(scene, whole(scene, np.eye(4)))
    np.testing.assert_array_equal(posed.means, scene.gaussians.means)
    np.testing.assert_allclose(posed.quats, scene.gaussians.quats, atol=1e-6)
    np.testing.assert_array_equal(posed.log_scales, scene.gaussians.log_scales)
    np.testing.assert_array_equal(posed.shading_factor, 1)


def test_moving_scene_and_camera_together_changes_nothing(scene):
    unshaded = dataclasses.replace(scene, shading=None)
    transform = matrix((0.8, 0.3, -0.4, 0.2), (0.4, -1.0, 0.3), scale=1.7)
    camera_world = np.linalg.inv(CAMERA.T_cam_world)
    moved_world = transform @ camera_world
    moved_world[:3, :3] /= 1.7
    moved = dataclasses.replace(CAMERA, T_cam_world=np.linalg.inv(moved_world))
    still = image(unshaded, posed_scene.pose_instances(unshaded, whole(unshaded, np.eye(4))))
    np.testing.assert_allclose(
        image(unshaded, posed_scene.pose_instances(unshaded, whole(unshaded, transform)), moved),
        still,
        atol=TOLERANCE,
    )


def test_shapes_follow_any_linear_map(scene):
    rng = np.random.default_rng(0)
    for linear in (rng.normal(size=(3, 3)), np.diag([-1.0, 1, 1]), np.diag([2.0, 1, 0.5])):
        transform = np.eye(4)
        transform[:3, :3] = linear
        posed = posed_scene.pose_instances(scene, whole(scene, transform))
        before, after = (
            covariances(scene.gaussians.quats, scene.gaussians.log_scales),
            covariances(posed.quats, posed.log_scales),
        )
        expected = linear @ before @ linear.T
        np.testing.assert_allclose(after, expected, atol=1e-5 * np.abs(expected).max())
        np.testing.assert_allclose(np.linalg.norm(posed.quats, axis=-1), 1, atol=1e-6)


def covariances(quats, log_scales):
    axes = rotations.quats_to_rotmats(quats.astype(np.float64)) * np.exp(log_scales.astype(np.float64))[:, None, :]
    return axes @ np.swapaxes(axes, -1, -2)


def test_a_mirrored_object_looks_mirrored(scene):
    unshaded = dataclasses.replace(scene, shading=None)
    camera = scenes.orbit_camera(0.0, 40, 40)  # looks along -x: mirroring y mirrors the picture
    mirrored = posed_scene.pose_instances(unshaded, whole(unshaded, np.diag([1.0, -1, 1, 1])))
    still = posed_scene.pose_instances(unshaded, whole(unshaded, np.eye(4)))
    np.testing.assert_allclose(
        image(unshaded, mirrored, camera), image(unshaded, still, camera)[:, ::-1], atol=TOLERANCE
    )


def test_an_empty_selection_leaves_the_sky(scene):
    sky = np.zeros((4, 3), np.float32)
    sky[0], sky[2] = [0.4, 0.2, 0.1], [0.3, 0.3, 0.3]  # brighter upwards
    scene = scene.with_arrays(background_sh=sky)
    output = scene_renderer.render_frame(scene, posed_scene.pose_instances(scene, []), CAMERA)
    np.testing.assert_allclose(output.color, scene_renderer.sky(scene, CAMERA), atol=1e-6)
    assert float(output.alpha.max()) == 0
    assert scene_renderer.sky(scene, CAMERA)[0].mean() > scene_renderer.sky(scene, CAMERA)[-1].mean() + 0.01


def test_an_omitted_range_is_not_drawn_and_a_repeated_range_is_drawn_twice(scene):
    body = scene.object(1)
    here, there = np.eye(4), matrix(translation=(0, 0, 0.5))
    ids = scene_renderer.render_frame(
        scene, posed_scene.pose_instances(scene, [Instance(body.start, body.count, here)]), CAMERA
    ).ids
    assert set(np.unique(ids)) <= {-1, 1}
    twice = posed_scene.pose_instances(scene, [Instance(body.start, body.count, m) for m in (here, there)])
    assert len(twice.means) == 2 * body.count
    moved = twice.means[body.count :] - twice.means[: body.count]
    np.testing.assert_allclose(moved, [[0, 0, 0.5]] * body.count, atol=1e-6)


@pytest.mark.parametrize("cuts", [(0, 300), (0, 120, 300), (300, 0), (0, 100, 50, 300), (0, 0, 299)])
def test_every_array_takes_the_same_rows(scene, cuts):
    """Ranges from each cut to the next larger one: all of the scene, with gaps, overlaps and empty ones."""
    ranges = [(a, b) for a, b in zip(cuts, cuts[1:], strict=False) if a <= b]
    posed = posed_scene.pose_instances(scene, [Instance(a, b - a, np.eye(4)) for a, b in ranges])
    rows = np.concatenate([np.arange(0), *(np.arange(a, b) for a, b in ranges)])
    for name in ("means", "log_scales", "opacity_logits", "sh", "object_ids"):
        np.testing.assert_array_equal(getattr(posed, name), scene.arrays()[name][rows])
    np.testing.assert_allclose(posed.quats, scene.gaussians.quats[rows], atol=1e-6)
    assert len(posed.pose_ids) == len(posed.shading_factor) == len(rows)


def test_black_and_given_backgrounds(scene):
    nothing = posed_scene.pose_instances(scene, [])
    assert np.all(image(scene, nothing, background=None) == 0)
    np.testing.assert_allclose(image(scene, nothing, background=np.array([0.1, 0.2, 0.3]))[5, 5], [0.1, 0.2, 0.3])
    with pytest.raises(ValueError, match="background"):
        image(scene, nothing, background="white")


@pytest.mark.parametrize(
    ("instance", "message"),
    [
        (Instance(0, 10**6, np.eye(4)), "leave the scene"),
        (Instance(-1, 2, np.eye(4)), "leave the scene"),
        (Instance(9, -5, np.eye(4)), "leave the scene"),
        (Instance(0, 10**15, np.eye(4)), "leave the scene"),
        (Instance(0, 2, np.diag([1.0, 1, 0, 1])), "singular"),
        (Instance(0, 2, np.full((4, 4), np.nan)), "finite"),
    ],
)
def test_impossible_instances_are_refused(scene, instance, message):
    with pytest.raises(ValueError, match=message):
        posed_scene.pose_instances(scene, [instance])


@pytest.mark.parametrize("bases", [1, 4, 9])
def test_the_sky_is_the_one_of_training(scene, bases):
    coefficients = np.random.default_rng(bases).normal(scale=0.3, size=(bases, 3)).astype(np.float32)
    coefficients[0] = [-3.0, 3.0, 0.2]  # black, white and between
    shown = scene_renderer.sky(scene.with_arrays(background_sh=coefficients), CAMERA)
    assert (shown == 0).any() and (shown == 1).any()  # both ends are reached
    start = torch.from_numpy(coefficients)
    trained = background.Background(start, learned=bases > 1).image(CAMERA).detach().numpy()
    np.testing.assert_allclose(shown, np.broadcast_to(trained, shown.shape), atol=1e-6)


def test_the_near_plane_is_the_scene_s(scene):
    frame = scene_player.Player(scene).frame(scenes.T_MAX)
    far = dataclasses.replace(scene, near_plane=100.0)
    np.testing.assert_array_equal(image(far, frame), scene_renderer.sky(scene, CAMERA))
    np.testing.assert_array_equal(image(far, frame, settings=RasterSettings()), image(scene, frame))


def test_negative_colours_and_shading_never_add_light(scene):
    """max(0, colour) times max(0, factor): two negatives are black, as in training."""
    rng = np.random.default_rng(0)
    dark = scene.with_arrays(
        sh=rng.normal(scale=3.0, size=(300, 1, 3)).astype(np.float32),
        shading=rng.normal(scale=3.0, size=(300, 3)).astype(np.float32),
    )
    frame = scene_player.Player(dark).frame(0.1)
    rgb = 0.5 + 0.28209479177387814 * dark.gaussians.sh[:, 0].astype(np.float64)
    rotmats = rotations.quats_to_rotmats(frame.group_quats)[frame.motion_ids]
    factor = 1 + ((np.swapaxes(rotmats, 1, 2) @ dark.shading.light - dark.shading.light) * dark.shading.vectors).sum(-1)
    assert ((rgb < 0).any(-1) & (factor < 0)).any()
    expected = np.maximum(rgb, 0) * np.maximum(factor, 0)[:, None]
    np.testing.assert_allclose(scene_renderer.colors(posed_scene.pose_frame(dark, frame), CAMERA), expected, atol=1e-4)


def moved_away(scene, shift):
    """The scene and its camera somewhere else, with centres that float32 holds there to the bit."""
    groups = tuple(dataclasses.replace(group, pivot=group.pivot + shift) for group in scene.groups)
    far = dataclasses.replace(
        scene.with_arrays(means=(scene.gaussians.means + shift).astype(np.float32)), groups=groups
    )
    assert (far.gaussians.means.astype(np.float64) - shift == scene.gaussians.means).all()
    T_cam_world = CAMERA.T_cam_world.copy()
    T_cam_world[:3, 3] -= T_cam_world[:3, :3] @ shift
    return far, dataclasses.replace(CAMERA, T_cam_world=T_cam_world)


@pytest.mark.parametrize("t", [0.31, scenes.T_MAX, 1.2])
def test_a_picture_far_from_the_origin_equals_the_one_near_it(t):
    scene = scenes.make_scene(n=300, sh_degree=2, seed=3)
    scene = scene.with_arrays(means=(np.round(scene.gaussians.means * 64) / 64).astype(np.float32))
    far, camera = moved_away(scene, np.array([1e5, -1e5, 65536.0]))
    near = image(scene, scene_player.Player(scene).frame(t))
    sharp = image(far, scene_player.Player(far).frame(t, origin=camera.center), camera)
    blunt = image(far, scene_player.Player(far).frame(t), camera)

    def psnr(picture):
        return -10 * np.log10(np.mean((picture.clip(0, 1) - near.clip(0, 1)) ** 2) + 1e-30)

    assert psnr(sharp) > 60
    assert psnr(blunt) < 56 or t == scenes.T_MAX, "what the origin is for"


def test_harmonics_follow_gaussians_that_rotate_on_their_own():
    """Bodies whose members all have the twist of their body look alike whichever of them carries the harmonics."""
    scene = scenes.make_scene(n=300, sh_degree=2, seed=3, shadows=False)
    dynamics = np.zeros((len(scene.gaussians.means), 12), np.float32)
    spin = np.array([0.0, 1.0, 2.5])
    for group in scene.groups[1:]:
        rows = np.flatnonzero(scene.gaussians.motion_ids == group.id)
        dynamics[rows, :3] = np.cross(spin, scene.gaussians.means[rows] - group.pivot)
        dynamics[rows, 3:6] = spin
    scene = scene.with_arrays(dynamics=dynamics)
    together = image(scene, scene_player.Player(scene, "rigid/median").frame(1.2))
    apart = image(scene, scene_player.Player(scene, "standard").frame(1.2))
    np.testing.assert_allclose(apart, together, atol=TOLERANCE)


@pytest.mark.parametrize("t", [0.31, 1.2])
def test_all_pictures_of_a_scene_far_from_the_origin_are_the_same(t):
    scene = scenes.make_scene(n=300, sh_degree=2, seed=3)
    scene = scene.with_arrays(means=(np.round(scene.gaussians.means * 64) / 64).astype(np.float32))
    far, camera = moved_away(scene, np.array([1e5, -1e5, 65536.0]))
    expected = images.to_uint8(r5dgs_core.picture(far, t, camera)).astype(np.float32) / np.float32(255)
    np.testing.assert_array_equal(evaluate.render(far, camera, t).color, expected)
    everything = highlight.highlight(far, [item.id for item in far.objects], camera, t)
    alone = highlight.isolate(far, [item.id for item in far.objects], camera, t)
    for found, near in (
        (everything, highlight.highlight(scene, [item.id for item in scene.objects], CAMERA, t)),
        (alone, highlight.isolate(scene, [item.id for item in scene.objects], CAMERA, t)),
    ):
        assert np.mean((found - near) ** 2) < 1e-6


@pytest.mark.parametrize(
    "window", [(slice(0, 40), slice(0, 48)), (slice(3, 17), slice(20, 48)), (slice(39, 40), slice(0, 1))]
)
def test_a_part_of_a_picture_is_a_part_of_the_whole_one(scene, window):
    frame = scene_player.Player(scene).frame(0.3, CAMERA.center)
    expected = scene_renderer.render_frame(scene, frame, CAMERA)
    part = scene_renderer.render_window(scene, frame, CAMERA, *window)
    np.testing.assert_allclose(part.color, expected.color[window], atol=TOLERANCE)
    np.testing.assert_allclose(part.alpha, expected.alpha[window], atol=TOLERANCE)
