"""Motion of single Gaussians in a scene: residuals before t_max, modes after it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from r5dgs_core import errors
from r5dgs_core.motion import cubic_curves, rotations, se3
from r5dgs_core.playback import group_dynamics, modes, residuals, scene_info, scene_player
from r5dgs_core.scene import row_runs, scene_file
from r5dgs_core.scene.scene import Scene
from tests.support.scenes import T_MAX, TIMES, make_scene


@pytest.fixture
def bending() -> Scene:
    """A scene in which every third Gaussian has a residual."""
    scene, rng = make_scene(90), np.random.default_rng(1)
    rows = np.arange(0, 90, 3, dtype=np.int32)
    fade = (T_MAX - TIMES)[None, :, None]
    turns = rotations.rotvecs_to_quats(rng.normal(size=(len(rows), 1, 3)) * fade)
    return scene.with_arrays(
        residual_rows=rows,
        residual_offsets=(rng.normal(size=(len(rows), 1, 3)) * fade).astype(np.float32),
        residual_quats=turns.astype(np.float32),
        residual_log_scales=(rng.normal(size=(len(rows), 1, 3)) * fade).astype(np.float32),
    )


def twisting(scene: Scene) -> Scene:
    """The scene with dynamics in which each body moves by one twist."""
    rng = np.random.default_rng(2)
    dynamics = np.zeros((len(scene.gaussians.means), 12), np.float32)
    for group in scene.groups:
        rows = np.flatnonzero(scene.gaussians.motion_ids == group.id)
        if group.role != "body":
            continue
        v, w, a, e = rng.normal(size=(4, 3))
        v, a = se3.recentre(w, v, e, a, scene.gaussians.means[rows].astype(float))
        tile = np.ones((len(rows), 1))
        dynamics[rows] = np.concatenate([v, tile * w, a, tile * e], -1)
    return scene.with_arrays(dynamics=dynamics, canonical_means=scene.gaussians.means.copy())


@pytest.mark.parametrize("knots", [len(TIMES), 2])
def test_residuals_are_the_curves_of_their_knots(knots):
    rng, rows = np.random.default_rng(3), np.array([5, 9, 40, 41], np.int32)
    times = TIMES[-knots:]
    offsets, growths = rng.normal(size=(2, len(rows), knots, 3)).astype(np.float32)
    quats = rotations.normalize(rng.normal(size=(len(rows), knots, 4))).astype(np.float32)  # large turns, any signs
    base = make_scene(60)
    scene = base.with_arrays(
        track_times=times,
        track_poses=base.tracks.poses[:, -knots:],
        residual_rows=rows,
        residual_offsets=offsets,
        residual_quats=quats,
        residual_log_scales=growths,
    )
    player = residuals.Residuals(scene)
    signed = np.moveaxis(rotations.make_continuous(np.moveaxis(quats.astype(np.float64), 1, 0)), 0, 1)
    for t in (times[0] - 1, *np.linspace(times[0], times[-1], 60)[:-1], np.nextafter(T_MAX, 0.0), *times[:-1]):
        for found, values, unit in zip(player.at(t), (offsets, signed, growths), (False, True, False), strict=True):
            values = values.astype(np.float64)
            slopes = cubic_curves.slopes(times, values)
            wanted = [
                cubic_curves.evaluate(cubic_curves.Keys(times, v, r, r), np.array(t), unit=unit)
                for v, r in zip(values, slopes, strict=True)
            ]
            sign = np.sign((found.T * wanted).sum(-1, keepdims=True)) if unit else 1
            np.testing.assert_allclose(found.T * sign, wanted, atol=1e-9)
    assert player.at(T_MAX) is None


@pytest.mark.parametrize("k", [0, 3, 7])
def test_residuals_change_the_bind_state_before_the_group_moves_it(bending, k):
    frame, i = scene_player.Player(bending).frame(float(TIMES[k])), 11
    row = int(bending.residuals.rows[i])
    group = bending.groups[int(bending.gaussians.motion_ids[row])]
    q, d = frame.group_quats[group.id], frame.group_displacements[group.id]
    bent = bending.gaussians.means[row] + bending.residuals.offsets[i, k]
    np.testing.assert_allclose(frame.means[row], group.pivot + rotations.rotate(q, bent - group.pivot) + d, atol=1e-5)
    turned = rotations.multiply(bending.residuals.quats[i, k].astype(float), bending.gaussians.quats[row].astype(float))
    assert rotations.angle_between(rotations.multiply(q, turned), frame.quats[row].astype(float)) < 1e-4
    np.testing.assert_allclose(
        frame.log_scales[row], bending.gaussians.log_scales[row] + bending.residuals.log_scales[i, k]
    )
    light = bending.shading.light
    change = rotations.rotate(rotations.conjugate(rotations.multiply(q, bending.residuals.quats[i, k])), light) - light
    wanted = max(1 + change @ bending.shading.vectors[row], 0)
    assert frame.shading_factor[row] == pytest.approx(wanted, abs=1e-5)


def test_residuals_are_smooth_between_knots_and_gone_at_t_max(bending):
    times = np.linspace(0.0, T_MAX, 201)
    paths = np.stack([scene_player.Player(bending).frame(t).means for t in times])
    steps = np.linalg.norm(np.diff(paths, axis=0), axis=-1)
    assert steps.max() < 0.2
    np.testing.assert_array_equal(scene_player.Player(bending).frame(T_MAX).means, bending.gaussians.means)
    np.testing.assert_array_equal(
        scene_player.Player(bending).frame(-1.0).means, scene_player.Player(bending).frame(0.0).means
    )


def test_the_sign_of_a_residual_quaternion_does_not_matter(bending):
    flipped = bending.residuals.quats.copy()
    flipped[:, ::2] *= -1
    other = bending.with_arrays(residual_quats=flipped)
    for t in (0.02, 0.13, 0.5):
        a, b = scene_player.Player(bending).frame(t).quats, scene_player.Player(other).frame(t).quats
        assert rotations.angle_between(a.astype(float), b.astype(float)).max() < 1e-3


def test_equal_twists_move_a_body_rigidly_in_mode_standard():
    scene = twisting(make_scene())
    frame = scene_player.Player(scene, "standard").frame(1.0)
    for start, stop, g in row_runs.runs(scene.gaussians.motion_ids):
        before, after = scene.gaussians.means[start:stop].astype(float), frame.means[start:stop].astype(float)
        pairs = [np.linalg.norm(x[:, None] - x[None], axis=-1) for x in (before, after)]
        np.testing.assert_allclose(pairs[1], pairs[0], atol=2e-4)
        assert scene.groups[g].role == "body" or (before == after).all()


def test_the_literal_form_is_rigid_only_if_offsets_are_those_at_t_max():
    scene = twisting(make_scene())
    standard, literal = (scene_player.Player(scene, mode).frame(1.0) for mode in ("standard", "rigid_paper"))
    np.testing.assert_allclose(literal.means, standard.means, atol=2e-3)
    body = scene.gaussians.motion_ids == 1
    turn = rotations.rotvecs_to_quats(np.array([0, 0, 1.0]))
    canonical = scene.dynamics.canonical_means.astype(float)
    canonical[body] = rotations.rotate(turn, canonical[body])
    turned = scene.with_arrays(canonical_means=canonical.astype(np.float32))
    off = scene_player.Player(turned, "rigid_paper").frame(1.0).means.astype(float)
    after, before = off[body], scene.gaussians.means[body].astype(float)
    pairs = [np.linalg.norm(x[:, None] - x[None], axis=-1) for x in (before, after)]
    assert np.abs(pairs[1] - pairs[0]).max() > 0.05


@pytest.fixture(scope="module")
def twisted() -> Scene:
    return twisting(make_scene(300, shadows=False))


@pytest.mark.parametrize("mode", modes.every())
def test_all_modes_meet_at_t_max_and_agree_before_it(twisted, mode):
    scene = twisted
    assert mode in scene_player.modes(scene)
    frame, rigid = scene_player.Player(scene, mode).frame(T_MAX), scene_player.Player(scene).frame(0.2)
    for name in ("means", "quats"):
        np.testing.assert_array_equal(getattr(frame, name), scene.arrays()[name])
        np.testing.assert_array_equal(getattr(scene_player.Player(scene, mode).frame(0.2), name), getattr(rigid, name))
    np.testing.assert_allclose(
        scene_player.Player(scene, mode).frame(T_MAX + 1e-9).means, scene.gaussians.means, atol=1e-6
    )


@pytest.mark.parametrize("source", group_dynamics.SOURCES[1:])
def test_bodies_of_one_twist_move_alike_in_all_modes(twisted, source):
    scene = twisted
    for t in (0.8, 1.1):
        rigid, own = (
            scene_player.Player(scene, f"rigid/{source}").frame(t),
            scene_player.Player(scene, "standard").frame(t),
        )
        np.testing.assert_allclose(rigid.means, own.means, atol=3 * residuals.TOLERANCE * scene.extent)
        assert rotations.angle_between(rigid.quats.astype(float), own.quats.astype(float)).max() < 2e-3
        np.testing.assert_allclose(rigid.shading_factor, own.shading_factor, atol=2e-3)
        since = rigid.group_quats[scene.gaussians.motion_ids[own.turned_rows]]
        assert rotations.angle_between(since, own.turned_quats).max() < 2e-3


@pytest.mark.parametrize("mode", [mode for mode in modes.every() if mode.startswith("rigid/")])
def test_sources_move_every_group_rigidly_for_long(twisted, mode):
    scene = twisted
    player, t = scene_player.Player(scene, mode), T_MAX + 4.0
    _, displacements = player.group_poses(t)
    for start, stop, g in row_runs.runs(scene.gaussians.motion_ids):
        frame = player.frame(t, scene.groups[g].pivot + displacements[g])
        before, after = scene.gaussians.means[start:stop].astype(float), frame.means[start:stop].astype(float)
        pairs = [np.linalg.norm(x[:, None] - x[None], axis=-1) for x in (before, after)]
        np.testing.assert_allclose(pairs[1], pairs[0], atol=5e-7 if scene.groups[g].role == "body" else 2e-6)


def loose(scene: Scene, rows: np.ndarray, size: float) -> Scene:
    """The scene with residuals of a size in the observed time for some rows."""
    offsets = np.zeros((len(rows), len(TIMES), 3), np.float32)
    offsets[:, :-1, 0] = size
    quats = np.tile(np.array([1, 0, 0, 0], np.float32), (len(rows), len(TIMES), 1))
    return scene.with_arrays(
        residual_rows=rows, residual_offsets=offsets, residual_quats=quats, residual_log_scales=0 * offsets
    )


@pytest.mark.parametrize("mode", ["hybrid", "standard", "rigid_paper"])
def test_an_origin_only_shifts_the_centres_past_t_max(twisted, mode):
    player = scene_player.Player(loose(twisted, np.arange(0, 300, 7, dtype=np.int32), 0.5), mode)
    plain, origin = player.frame(1.1), np.array([3.0, -40.0, 7.5])
    np.testing.assert_allclose(player.frame(1.1, origin).means + origin, plain.means, atol=1e-5)


def test_any_residual_of_a_pinned_gaussian_is_unexplained(twisted):
    pinned, body = (np.flatnonzero(twisted.gaussians.motion_ids == g).astype(np.int32)[:3] for g in (0, 1))
    scene = loose(twisted, np.sort(np.concatenate([pinned, body])), 1e-3)
    np.testing.assert_array_equal(residuals.unexplained(scene), pinned)


@pytest.mark.parametrize("variant", ["", "/least_squares"])
def test_hybrid_is_rigid_except_for_gaussians_that_no_group_explains(twisted, variant):
    dynamics = twisted.dynamics.rates + (twisted.dynamics.rates != 0) * np.float32(0.2)
    dynamics[np.flatnonzero(twisted.gaussians.motion_ids == 1)[::6]] = 0.0  # a stray that rests while its group moves
    scene = twisted.with_arrays(dynamics=dynamics)
    rigid, own = (
        scene_player.Player(scene, f"rigid{variant}").frame(1.1),
        scene_player.Player(scene, "standard").frame(1.1),
    )
    everyone = np.arange(len(scene.gaussians.means), dtype=np.int32)
    some = np.flatnonzero(scene.gaussians.motion_ids == 1)[::3].astype(np.int32)
    for rows, size in ((None, 0.0), (everyone, 1e-3), (some[:1], 0.5), (some, 0.5), (everyone, 0.5)):
        changed = scene if rows is None else loose(scene, rows, size)
        frame = scene_player.Player(changed, f"hybrid{variant}").frame(1.1)
        free = np.zeros(len(scene.gaussians.means), bool)
        if rows is not None and size > 0.1:
            free[rows] = True
        elif rows is not None:
            free[scene.gaussians.motion_ids == 0] = True  # what is pinned by rule has no motion that explains anything
        for name in ("means", "quats", "shading_factor"):
            np.testing.assert_array_equal(getattr(frame, name)[free], getattr(own, name)[free])
            np.testing.assert_array_equal(getattr(frame, name)[~free], getattr(rigid, name)[~free])


def test_the_literal_form_is_rigid_if_the_object_only_translated(twisted):
    """If f_def is a translation, offsets in the canonical state are those at t_max."""
    dynamics = twisted.dynamics.rates.copy()
    dynamics[:, 3:6] *= 0.1  # TRACE's midpoint steps are exact enough for slow spins
    dynamics[:, 9:] *= 0.1
    moved = twisted.gaussians.means + np.float32(0.3) * (twisted.gaussians.motion_ids[:, None] == 1)
    scene = twisted.with_arrays(dynamics=dynamics, canonical_means=moved.astype(np.float32))
    literal, rigid = (scene_player.Player(scene, mode).frame(1.0) for mode in ("rigid_paper", "rigid/representative"))
    np.testing.assert_allclose(literal.means, rigid.means, atol=1e-4)
    np.testing.assert_allclose(literal.quats, rigid.quats, atol=1e-4)


def test_an_anchored_background_goes_with_its_representative(twisted):
    still = twisted.gaussians.motion_ids == 0
    dynamics = twisted.dynamics.rates.copy()
    dynamics[still, :3] = [0.3, 0.0, -0.1]
    scene = twisted.with_arrays(dynamics=dynamics)
    pinned, anchored = (scene_player.Player(scene, f"rigid_paper/{kind}").frame(1.0) for kind in ("pinned", "anchored"))
    np.testing.assert_array_equal(pinned.means[still], scene.gaussians.means[still])
    moved = 0.25 * np.array([0.3, 0.0, -0.1])
    np.testing.assert_allclose(anchored.means[still], scene.gaussians.means[still] + moved, atol=1e-6)
    body = scene.gaussians.motion_ids == 1
    np.testing.assert_array_equal(anchored.means[body], pinned.means[body])


def test_the_first_gaussian_of_a_scene_can_represent_a_body_in_the_literal_form(twisted):
    groups = tuple(dataclasses.replace(g, anchor_index=0) if g.id == 1 else g for g in twisted.groups)
    dynamics = twisted.dynamics.rates.copy()
    dynamics[0] = [0.3, 0.0, -0.1] + [0] * 9
    scene = dataclasses.replace(twisted.with_arrays(dynamics=dynamics), groups=groups)
    body = scene.gaussians.motion_ids == 1
    moved = scene_player.Player(scene, "rigid_paper").frame(T_MAX + 0.5).means[body] - scene.gaussians.means[body]
    np.testing.assert_allclose(moved, np.broadcast_to([0.15, 0.0, -0.05], moved.shape), atol=1e-6)


def test_scenes_without_canonical_centres_lack_the_literal_form():
    scene = twisting(make_scene(60)).with_arrays(canonical_means=None)
    assert {modes.split(mode)[0] for mode in scene_player.modes(scene)} == {"rigid", "hybrid", "standard"}


def test_a_mode_without_data_is_refused():
    with pytest.raises(ValueError, match="expected one of rigid for the scene .* got 'standard'"):
        scene_player.Player(make_scene(), "standard").frame(1.0)


def test_residuals_and_dynamics_survive_the_file(bending, tmp_path):
    scene = twisting(bending)
    exact = scene_file.read(scene_file.write(scene, tmp_path / "exact.r5dgs", precision="exact"))
    small = scene_file.read(scene_file.write(scene, tmp_path / "small.r5dgs"))
    for name in ("residual_rows", "residual_offsets", "residual_log_scales", "dynamics", "canonical_means"):
        np.testing.assert_array_equal(exact.arrays()[name], scene.arrays()[name])
        np.testing.assert_allclose(small.arrays()[name], scene.arrays()[name], atol=2e-3)
    assert scene_info.info(small)["modes"] == list(scene_player.modes(scene))
    assert scene_info.info(small)["residuals"] == 30


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"residual_quats": None}, "residual_quats: expected an array beside"),
        ({"residual_rows": np.arange(30, dtype=np.int32)[::-1].copy()}, "increasing rows"),
        ({"residual_offsets": np.ones((30, len(TIMES), 3), np.float32)}, "zero at t_max"),
        ({"canonical_means": np.zeros((90, 3), np.float32)}, "dynamics: expected an array beside"),
    ],
)
def test_inconsistent_residuals_are_not_written(bending, tmp_path, change, named):
    with pytest.raises(errors.SceneFileError, match=named):
        scene_file.write(bending.with_arrays(**change), tmp_path / "bad.r5dgs")
