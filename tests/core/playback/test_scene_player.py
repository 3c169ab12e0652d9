import dataclasses

import numpy as np
import pytest

from r5dgs_core.motion import cubic_curves, models, rotations
from r5dgs_core.playback import group_dynamics, modes, scene_player
from r5dgs_core.scene import cameras, row_runs, validation
from tests.support.scenes import T_MAX, make_scene

AFTER = np.nextafter(T_MAX, 1.0)


@pytest.fixture(scope="module")
def scene():
    return make_scene(objects=5, sh_degree=1)


def test_the_bind_state_plays_at_t_max_to_the_bit(scene):
    frame = scene_player.Player(scene).frame(T_MAX)
    np.testing.assert_array_equal(frame.means, scene.gaussians.means)
    np.testing.assert_array_equal(frame.quats, scene.gaussians.quats)
    assert (frame.shading_factor == 1).all()
    assert (frame.group_quats == rotations.identity(len(scene.groups))).all()
    assert (frame.group_displacements == 0).all()


def test_playback_is_continuous_at_t_max(scene):
    for t in (np.nextafter(T_MAX, 0.0), AFTER, T_MAX + 1e-9, T_MAX - 1e-9):
        frame = scene_player.Player(scene).frame(t)
        np.testing.assert_allclose(frame.means, scene.gaussians.means, atol=1e-6)
        assert rotations.angle_between(frame.group_quats, rotations.identity(1)).max() < 1e-7


def test_knots_are_met_exactly(scene):
    for k, t in enumerate(scene.tracks.times):
        quats, displacements = scene_player.Player(scene).group_poses(t)
        np.testing.assert_allclose(displacements, scene.tracks.poses[:, k, 4:], atol=1e-12)
        assert rotations.angle_between(quats, scene.tracks.poses[:, k, :4]).max() < 1e-7


def test_before_the_first_time_the_first_pose_is_held(scene):
    for first, early in zip(
        scene_player.Player(scene).group_poses(0.0), scene_player.Player(scene).group_poses(-3.0), strict=True
    ):
        np.testing.assert_array_equal(first, early)


def test_between_knots_the_curve_is_smooth_and_near_the_motion(scene):
    times = np.linspace(0.001, T_MAX - 0.001, 400)
    quats, displacements = (
        np.stack(x) for x in zip(*(scene_player.Player(scene).group_poses(t) for t in times), strict=True)
    )
    for group in scene.groups[1:6]:
        true_quats, true, _, _ = models.curve(group.model, times - T_MAX)
        assert np.linalg.norm(displacements[:, group.id] - true, axis=-1).max() < 2e-3
        assert rotations.angle_between(quats[:, group.id], true_quats).max() < 2e-3
    inner = scene.tracks.times[1:-1]
    before, at, after = (
        np.stack([scene_player.Player(scene).group_poses(t + h)[1] for t in inner]) for h in (-1e-7, 0, 1e-7)
    )
    np.testing.assert_allclose((at - before) / 1e-7, (after - at) / 1e-7, atol=1e-4)


def test_keys_at_the_knots_reproduce_playback(scene):
    """Blender's Bezier keys with handles at a third are cubic Hermite curves: `cubic_curves.evaluate` is their
    rule.
    """
    quats, displacements = group_dynamics.knot_poses(scene)
    quat_slopes, slopes = (cubic_curves.slopes(scene.tracks.times, values) for values in (quats, displacements))
    times = np.linspace(0, T_MAX, 131)
    for g in range(len(scene.groups)):
        location = cubic_curves.Keys(scene.tracks.times, displacements[g], slopes[g], slopes[g])
        rotation = cubic_curves.Keys(scene.tracks.times, quats[g], quat_slopes[g], quat_slopes[g])
        keyed = cubic_curves.evaluate(location, times), cubic_curves.evaluate(rotation, times, unit=True)
        played = [scene_player.Player(scene).group_poses(t) for t in times]
        np.testing.assert_allclose(keyed[0], np.stack([p[1][g] for p in played]), atol=1e-12)
        np.testing.assert_allclose(keyed[1], np.stack([p[0][g] for p in played]), atol=1e-12)


def test_slopes_are_exact_for_parabolas_on_uneven_times():
    times = np.array([0.0, 0.1, 0.35, 0.4, 0.9])
    values = np.stack([3 * times**2 - times, 2 + 0 * times], -1)
    expected = np.stack([6 * times - 1, 0 * times], -1)
    np.testing.assert_allclose(cubic_curves.slopes(times, values), expected, atol=1e-12)
    np.testing.assert_allclose(cubic_curves.slopes(times[:2], values[:2])[0, 0], (values[1, 0] - values[0, 0]) / 0.1)
    assert (cubic_curves.slopes(times[:1], values[:1]) == 0).all()


def test_signs_of_quaternions_in_the_file_do_not_matter(scene):
    flipped = scene.tracks.poses.copy()
    flipped[:, ::2, :4] *= -1
    other = scene.with_arrays(track_poses=flipped)
    for t in (0.13, 0.5, 0.74):
        for a, b in zip(
            scene_player.Player(scene).group_poses(t), scene_player.Player(other).group_poses(t), strict=True
        ):
            np.testing.assert_allclose(a, b, atol=1e-14)


@pytest.mark.parametrize("t", [0.0, 0.33, 0.9, 3.0])
def test_every_group_moves_rigidly(scene, t):
    frame = scene_player.Player(scene).frame(t)
    for start, stop, g in row_runs.runs(scene.gaussians.motion_ids):
        before, after = scene.gaussians.means[start:stop].astype(float), frame.means[start:stop].astype(float)
        pairs = [np.linalg.norm(x[:, None] - x[None], axis=-1) for x in (before, after)]
        np.testing.assert_allclose(pairs[1], pairs[0], atol=2e-6)
        pivot, q, d = scene.groups[g].pivot, frame.group_quats[g], frame.group_displacements[g]
        np.testing.assert_allclose(after, pivot + rotations.rotate(q, before - pivot) + d, atol=1e-6)
        own = rotations.multiply(q, scene.gaussians.quats[start:stop].astype(float))
        assert rotations.angle_between(own, frame.quats[start:stop].astype(float)).max() < 1e-6


def test_pinned_gaussians_never_change(scene):
    still = scene.gaussians.motion_ids == 0
    for t in (0.0, 2.0):
        frame = scene_player.Player(scene).frame(t)
        np.testing.assert_array_equal(frame.means[still], scene.gaussians.means[still])
        assert (frame.shading_factor[still] == 1).all()


def test_a_follower_takes_its_leaders_displacement_without_rotating(scene):
    shadow = next(g for g in scene.groups if g.follows is not None)
    quats, displacements = scene_player.Player(scene).group_poses(1.4)
    np.testing.assert_allclose(displacements[shadow.id], shadow.follow_matrix @ displacements[shadow.follows])
    assert np.linalg.norm(displacements[shadow.id]) > 0.1
    assert quats[shadow.id].tolist() == [1, 0, 0, 0]


def test_shading_follows_the_light_in_the_objects_frame(scene):
    frame = scene_player.Player(scene).frame(1.1)
    row = int(np.flatnonzero(scene.gaussians.motion_ids == 1)[0])
    rotmat = rotations.quats_to_rotmats(frame.group_quats[1])
    light = scene.shading.light
    expected = 1 + (rotmat.T @ light - light) @ scene.shading.vectors[row]
    assert frame.shading_factor[row] == pytest.approx(max(expected, 0), rel=1e-5)
    dark = scene.with_arrays(shading=scene.shading.vectors * 1e4)
    assert scene_player.Player(dark).frame(1.1).shading_factor.min() == 0
    assert scene_player.Player(make_scene(shading=False)).frame(1.1).shading_factor is None


@pytest.mark.parametrize("t", [0.2, T_MAX, 1.1])
def test_posing_groups_like_playback_gives_its_frame(scene, t):
    played = scene_player.Player(scene).frame(t)
    posed = scene_player.Player(scene).frame_at_poses(played.group_quats, played.group_displacements, t)
    for one, other in zip(dataclasses.astuple(posed), dataclasses.astuple(played), strict=True):
        np.testing.assert_array_equal(one, other)


def test_sh_rotations_bring_directions_into_the_bind_frame(scene):
    quats, _ = scene_player.Player(scene).group_poses(0.2)
    direction = np.array([0.6, 0.0, 0.8])
    back = scene_player.sh_rotations(quats) @ direction
    np.testing.assert_allclose(rotations.rotate(quats, back), np.broadcast_to(direction, back.shape), atol=1e-12)


def test_scenes_without_gaussians_objects_or_motion_play():
    empty = make_scene(n=0, objects=0, unassigned=0)
    assert len(scene_player.Player(empty).frame(5.0).means) == 0
    still = make_scene(n=30, objects=0)
    np.testing.assert_array_equal(scene_player.Player(still).frame(5.0).means, still.gaussians.means)
    base = make_scene()
    single = base.with_arrays(track_times=base.tracks.times[-1:], track_poses=base.tracks.poses[:, -1:])
    np.testing.assert_array_equal(scene_player.Player(single).frame(0.0).means, base.gaussians.means)


@pytest.mark.parametrize("t", [1e12, 1e15])
def test_the_largest_acceleration_that_a_file_may_hold_plays_to_finite_centres(scene, t):
    model = models.MotionModel(kind="ballistic_spin", acceleration=np.full(3, cameras.FARTHEST))
    groups = tuple(dataclasses.replace(group, model=model) if group.role == "body" else group for group in scene.groups)
    fast = dataclasses.replace(scene, groups=groups, frames_per_unit=1e-12)
    validation.check(fast, "scene")
    frame = scene_player.Player(fast).frame(t)
    assert np.isfinite(frame.means).all() and np.isfinite(frame.group_displacements).all()


@pytest.mark.parametrize("shift", [0.0, 1e4])
@pytest.mark.parametrize("t", [T_MAX / 2, 2.0, 100 * T_MAX])
def test_bodies_keep_their_shape_at_any_distance_and_for_long_times(scene, shift, t):
    """Distances from the body's own place are kept, to single precision of the body's size."""
    away = np.array([1.0, -1.0, 0.5]) * shift
    groups = tuple(dataclasses.replace(group, pivot=group.pivot + away) for group in scene.groups)
    moved = dataclasses.replace(
        scene.with_arrays(means=(scene.gaussians.means + away).astype(np.float32)), groups=groups
    )
    player = scene_player.Player(moved)
    _, displacements = player.group_poses(t)
    for start, stop, g in row_runs.runs(moved.gaussians.motion_ids):
        if moved.groups[g].role == "body":
            frame = player.frame(t, moved.groups[g].pivot + displacements[g])
            before, after = moved.gaussians.means[start:stop].astype(float), frame.means[start:stop].astype(float)
            pairs = [np.linalg.norm(x[:, None] - x[None], axis=-1) for x in (before, after)]
            apart = pairs[0] > 0.1
            assert np.abs(pairs[1] / np.where(apart, pairs[0], 1) - 1)[apart].max() < 1e-6


@pytest.mark.parametrize("t", [0.3, T_MAX, 1.2])
def test_an_origin_only_shifts_the_centres(scene, t):
    player, origin = scene_player.Player(scene), np.array([3.0, -40.0, 7.5])
    plain, shifted = player.frame(t), player.frame(t, origin)
    np.testing.assert_allclose(shifted.means + origin, plain.means, atol=5e-6)
    np.testing.assert_array_equal(shifted.quats, plain.quats)
    np.testing.assert_array_equal(shifted.shading_factor, plain.shading_factor)
    assert (plain.origin == 0).all() and (shifted.origin == origin).all()
    again = player.frame(t)
    np.testing.assert_array_equal(again.means, plain.means)


def test_frames_do_not_depend_on_earlier_frames_of_the_player(scene):
    player = scene_player.Player(scene)
    first = player.frame(1.1)
    kept = first.means.copy()
    for t in (0.2, T_MAX, 1.7, 1.1):
        frame = player.frame(t)
        for one, other in zip(
            dataclasses.astuple(frame), dataclasses.astuple(scene_player.Player(scene).frame(t)), strict=True
        ):
            np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(first.means, kept)


def test_modes_have_one_spelling_and_a_default_variant(scene):
    assert modes.split("rigid") == ("rigid", "fitted") == modes.split("rigid/fitted")
    assert modes.split("rigid_paper") == ("rigid_paper", "pinned")
    assert modes.split("hybrid/kabsch") == ("hybrid", "kabsch")
    assert modes.split("standard") == ("standard", "")
    assert scene_player.modes(scene) == ("rigid",)
    assert len(set(modes.every())) == len(modes.every()) == 5 + 5 + 1 + 2
    for mode in ("wobbly", "rigid/mean", "rigid/", "standard/fitted", "", None):
        with pytest.raises(ValueError, match="mode: expected one of"):
            modes.split(mode)


def test_unknown_modes_and_times_are_refused(scene):
    with pytest.raises(ValueError, match="mode"):
        scene_player.Player(scene, "wobbly").frame(1.0)
    with pytest.raises(ValueError, match="origin"):
        scene_player.Player(scene).frame(1.0, origin=np.array([0.0, np.nan, 0.0]))
    with pytest.raises(ValueError, match="finite"):
        scene_player.Player(scene).frame(float("nan"))


def _with_other_poses(scene, *, turned=(), moved=(), resting=()):
    poses = scene.tracks.poses.copy()
    for g in turned:
        poses[g, :, :4] = rotations.multiply(rotations.rotvecs_to_quats(np.array([0.1, -0.2, 0.3])), poses[g, :, :4])
    for g in moved:
        poses[g, :, 4:] += [0.1, 0.2, -0.3]
    for g in resting:
        poses[g] = [1, 0, 0, 0, 0, 0, 0]
    return scene.with_arrays(track_poses=poses)


@pytest.mark.parametrize("t", [0.2 * T_MAX, T_MAX, 1.3 * T_MAX])
@pytest.mark.parametrize("shading", [True, False])
@pytest.mark.parametrize("origin", [None, np.array([0.3, -2.0, 1.0])])
@pytest.mark.parametrize(
    "changes", [{}, {"turned": (1,), "moved": (3,)}, {"resting": (1, 2)}, {"resting": (0, 1, 2, 3, 4, 5, 6)}]
)
def test_a_frame_after_another_is_the_frame_to_the_bit(t, shading, origin, changes):
    scene = make_scene(objects=5, shading=shading)  # group 6 follows group 1
    if t < T_MAX:
        scene = _with_other_poses(scene, turned=(4,))
    for before, after in [(scene, _with_other_poses(scene, **changes)), (_with_other_poses(scene, **changes), scene)]:
        other = scene_player.Player(before).frame(t, origin)
        kept = {name: None if x is None else np.copy(x) for name, x in vars(other).items()}
        expected, found = (
            scene_player.Player(after).frame(t, origin),
            scene_player.Player(after).frame_after(other),
        )
        for name, value in vars(expected).items():
            np.testing.assert_array_equal(getattr(found, name), value, err_msg=name)
            np.testing.assert_array_equal(getattr(other, name), kept[name], err_msg=name)


def test_a_frame_after_another_has_the_residuals_of_its_scene():
    plain = make_scene(90)
    rng, shape = np.random.default_rng(1), (30, len(plain.tracks.times), 3)
    scene = plain.with_arrays(
        residual_rows=np.arange(0, 90, 3, dtype=np.int32),
        residual_offsets=rng.normal(size=shape).astype(np.float32),
        residual_quats=rotations.rotvecs_to_quats(rng.normal(size=shape)).astype(np.float32),
        residual_log_scales=rng.normal(size=shape).astype(np.float32),
    )
    after = _with_other_poses(scene, turned=(1,))
    found = scene_player.Player(after).frame_after(scene_player.Player(scene).frame(0.3 * T_MAX))
    expected = scene_player.Player(after).frame(0.3 * T_MAX)
    np.testing.assert_array_equal(found.means, expected.means)
    np.testing.assert_array_equal(found.quats, expected.quats)


def test_a_frame_after_another_moves_only_the_groups_that_differ():
    scene = make_scene(objects=5, shadows=False)
    other, after = scene_player.Player(scene).frame(0.2 * T_MAX), _with_other_poses(scene, turned=(2,))
    marked = dataclasses.replace(other, means=np.full_like(other.means, 9), quats=np.full_like(other.quats, 9))
    found = scene_player.Player(after).frame_after(marked)
    same = scene.gaussians.motion_ids != 2
    assert ((found.means == 9).all(1) == same).all() and ((found.quats == 9).all(1) == same).all()
