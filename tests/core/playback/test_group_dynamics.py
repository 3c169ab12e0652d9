"""Motion of groups from the dynamics of their members."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from r5dgs_core.motion import models, rigid_fit, rotations, se3
from r5dgs_core.playback import group_dynamics, scene_player
from r5dgs_core.scene.scene import Scene
from tests.support.scenes import T_MAX, make_scene

MEMBERS = ("representative", "median", "least_squares", "kabsch")
VOTES = ("median", "least_squares", "kabsch")
TWIST = np.array([[0.3, -0.2, 0.5], [0.6, 1.1, -0.8], [0.1, -0.4, 0.2], [0.3, -0.5, 0.7]])  # v, w, a, e about the pivot


def rigid_dynamics(scene: Scene, twist: np.ndarray = TWIST) -> Scene:
    """The scene with members that all have the twist of their body about its pivot."""
    dynamics = np.zeros((len(scene.gaussians.means), 12))
    for group in scene.groups:
        rows = np.flatnonzero(scene.gaussians.motion_ids == group.id)
        if group.role == "body":
            v, w, a, e = twist
            own_v, own_a = se3.recentre(w, v, e, a, scene.gaussians.means[rows] - group.pivot)
            dynamics[rows] = np.concatenate([own_v, w + 0 * own_v, own_a, e + 0 * own_v], -1)
    return scene.with_arrays(dynamics=dynamics, canonical_means=scene.gaussians.means.copy())


def only(scene: Scene, group: int, source: str) -> models.MotionModel:
    return group_dynamics.models_of(scene, source)[group]


def rates(model: models.MotionModel) -> np.ndarray:
    return np.stack([model.velocity, model.angular_velocity, model.acceleration, model.angular_acceleration])


@pytest.fixture(scope="module")
def scene() -> Scene:
    return rigid_dynamics(make_scene(300))


@pytest.mark.parametrize("source", MEMBERS)
def test_members_of_one_twist_give_that_twist(scene, source):
    for group in scene.groups:
        model = only(scene, group.id, source)
        if group.role == "body":
            assert model.kind == "world_twist"
            np.testing.assert_allclose(rates(model), TWIST, atol=2e-5 if source == "kabsch" else 1e-6)
        else:
            assert model.is_static


def test_the_fitted_source_is_the_model_of_the_scene(scene):
    assert group_dynamics.models_of(scene, "fitted") == tuple(group.model for group in scene.groups)


@pytest.mark.parametrize("source", MEMBERS)
def test_group_models_do_not_depend_on_the_world_origin(source):
    base = make_scene(300)
    means = np.round(base.gaussians.means * 512) / 512  # float32 holds these far from the origin, too
    near = rigid_dynamics(base.with_arrays(means=means.astype(np.float32)))
    noise = np.random.default_rng(0).normal(scale=0.05, size=near.dynamics.rates.shape)
    near = near.with_arrays(dynamics=near.dynamics.rates + noise * (near.dynamics.rates != 0))
    shift = np.array([8192.0, -8192.0, 4096.0])
    groups = tuple(dataclasses.replace(g, pivot=g.pivot + shift) for g in near.groups)
    far = dataclasses.replace(near.with_arrays(means=(means + shift).astype(np.float32)), groups=groups)
    np.testing.assert_allclose(rates(only(far, 1, source)), rates(only(near, 1, source)), rtol=0, atol=1e-9)


def test_the_representative_defines_the_motion_of_its_group(scene):
    row = scene.groups[1].anchor_index
    dynamics = scene.dynamics.rates.copy()
    dynamics[row] = 0.0
    changed = scene.with_arrays(dynamics=dynamics)
    assert only(changed, 1, "representative").is_static
    np.testing.assert_allclose(rates(only(changed, 1, "median")), TWIST, atol=1e-6)


@pytest.mark.parametrize("source", VOTES)
def test_faint_members_and_a_few_outliers_have_no_effect(scene, source):
    members, rng = np.flatnonzero(scene.gaussians.motion_ids == 1), np.random.default_rng(3)
    faint, bad = members[: len(members) // 2], members[-len(members) // 10 :]
    dynamics, logits = scene.dynamics.rates.copy(), np.full(len(scene.gaussians.means), 3.0, np.float32)
    dynamics[faint] += rng.normal(scale=5.0, size=(len(faint), 12))
    logits[faint] = -3.0
    wrong = scene.with_arrays(dynamics=dynamics, opacity_logits=logits)
    np.testing.assert_allclose(rates(only(wrong, 1, source)), TWIST, atol=2e-5 if source == "kabsch" else 1e-6)
    dynamics[bad] += rng.normal(scale=5.0, size=(len(bad), 12))
    wrong = wrong.with_arrays(dynamics=dynamics)
    np.testing.assert_allclose(rates(only(wrong, 1, source)), TWIST, atol=2e-2)


def test_all_members_vote_if_all_are_faint(scene):
    faint = scene.with_arrays(opacity_logits=np.full(len(scene.gaussians.means), -4.0, np.float32))
    np.testing.assert_allclose(rates(only(faint, 1, "median")), TWIST, atol=1e-6)


@pytest.mark.parametrize(("source", "right"), [("median", False), ("least_squares", True), ("kabsch", True)])
def test_unobservable_spins_do_not_mislead_the_fits(scene, source, right):
    """Members that move like the body but do not spin themselves: training observes only v + w x r."""
    dynamics = np.asarray(scene.dynamics.rates, np.float64).copy()
    for group in scene.groups:
        rows = np.flatnonzero(scene.gaussians.motion_ids == group.id)
        v, w, a, _ = np.split(dynamics[rows], 4, axis=-1)
        dynamics[rows, 6:9] = a + rotations.cross(w, v)  # what the twist adds to the acceleration
    dynamics[:, 3:6], dynamics[:, 9:] = 0.0, 0.0
    error = np.abs(rates(only(scene.with_arrays(dynamics=dynamics), 1, source)) - TWIST).max(1)
    if source == "least_squares":
        np.testing.assert_allclose(error, 0, atol=1e-5)
    else:
        assert (error[:2] < 0.05).all() if right else error[:2].max() > 0.5


@pytest.mark.parametrize(("width", "noise"), [(0.0, 0.0), (1e-4, 0.05)])
@pytest.mark.parametrize("source", ["least_squares", "kabsch"])
def test_a_line_of_members_takes_the_spin_about_itself_from_them(scene, source, width, noise):
    members, rng = np.flatnonzero(scene.gaussians.motion_ids == 1), np.random.default_rng(5)
    means = scene.gaussians.means.copy()
    means[members] = scene.groups[1].pivot + np.linspace(-0.25, 0.25, len(members))[:, None] * [1.0, 0, 0]
    means[members] += width * rng.normal(size=(len(members), 3))
    line = rigid_dynamics(scene.with_arrays(means=means))
    dynamics = line.dynamics.rates + noise * rng.normal(size=line.dynamics.rates.shape)
    model = only(line.with_arrays(dynamics=dynamics), 1, source)
    np.testing.assert_allclose(rates(model), TWIST, atol=0.3 if noise else 2e-2)


def in_units(scene: Scene, length: float, time: float) -> Scene:
    """The scene in other units."""
    groups = tuple(dataclasses.replace(g, pivot=g.pivot * length) for g in scene.groups)
    changed = scene.with_arrays(
        means=scene.gaussians.means * np.float32(length),
        dynamics=scene.dynamics.rates * np.repeat([length / time, 1 / time, length / time**2, 1 / time**2], 3),
        track_times=scene.tracks.times * time,
    )
    return dataclasses.replace(changed, groups=groups, t_max=scene.t_max * time)


@pytest.mark.parametrize("noise", [0.0, 0.02])
@pytest.mark.parametrize("width", [0.01, 1.0])  # of the body across its first axis: a narrow one spins undetermined
@pytest.mark.parametrize("source", MEMBERS)
def test_group_models_do_not_depend_on_the_units_of_length_and_time(source, width, noise):
    base, rng = make_scene(150, objects=1), np.random.default_rng(3)
    members, means = np.flatnonzero(base.gaussians.motion_ids == 1), base.gaussians.means.copy()
    means[members] = base.groups[1].pivot + (means[members] - base.groups[1].pivot) * [1, width, width]
    scene = rigid_dynamics(base.with_arrays(means=means))
    dynamics = scene.dynamics.rates + noise * rng.normal(size=scene.dynamics.rates.shape)
    dynamics[members[:5]] += rng.normal(scale=5.0, size=(5, 12))
    scene = scene.with_arrays(dynamics=dynamics)
    model = only(scene, 1, source)
    for length, time in ((2.0**12, 2.0**-10), (2.0**-12, 2.0**10)):
        other = only(in_units(scene, length, time), 1, source)
        units = np.array([length / time, 1 / time, length / time**2, 1 / time**2])[:, None]
        np.testing.assert_allclose(rates(other) / units, rates(model), rtol=1e-9)
        assert other.radius == pytest.approx(model.radius * length)


def test_least_squares_solves_the_weighted_normal_equations_if_no_member_is_an_outlier(scene):
    members, rng = np.flatnonzero(scene.gaussians.motion_ids == 1), np.random.default_rng(4)
    dynamics = np.asarray(scene.dynamics.rates, np.float64).copy()
    errors = rng.normal(size=(2, len(members), 3))
    dynamics[members[:, None], [0, 1, 2]] += 0.05 * errors[0] / np.linalg.norm(errors[0], axis=-1, keepdims=True)
    dynamics[members[:, None], [6, 7, 8]] += 0.05 * errors[1] / np.linalg.norm(errors[1], axis=-1, keepdims=True)
    logits = rng.uniform(0, 3, len(scene.gaussians.means)).astype(np.float32)
    model = only(scene.with_arrays(dynamics=dynamics, opacity_logits=logits), 1, "least_squares")

    arms = scene.gaussians.means[members].astype(np.float64) - scene.groups[1].pivot
    turning = np.swapaxes(np.cross(np.eye(3), arms[:, None]), 1, 2)  # matrix of w -> w x r for each member
    design = np.concatenate([np.tile(np.eye(3), (len(arms), 1, 1)), turning], -1)
    root = np.sqrt(1 / (1 + np.exp(-logits[members].astype(np.float64))))[:, None]

    def solve(field):
        return np.linalg.lstsq((design * root[..., None]).reshape(-1, 6), (field * root).ravel(), rcond=None)[0]

    own_v, own_w, own_a, _ = np.split(dynamics[members], 4, axis=-1)
    v, w = np.split(solve(own_v), 2)
    a, e = np.split(solve(own_a + np.cross(own_w, own_v) - np.cross(w, v + np.cross(w, arms))), 2)
    np.testing.assert_allclose(rates(model), [v, w, a, e], atol=1e-9)


@pytest.mark.parametrize("source", VOTES)
def test_group_models_depend_on_the_first_and_last_observed_time_only(source):
    rough = rigid_dynamics(make_scene(150, objects=1))
    noise = np.random.default_rng(0).normal(scale=0.2, size=rough.dynamics.rates.shape)
    rough = rough.with_arrays(dynamics=rough.dynamics.rates + noise)
    short = rough.with_arrays(track_times=rough.tracks.times[[0, -1]], track_poses=rough.tracks.poses[:, [0, -1]])
    np.testing.assert_array_equal(rates(only(short, 1, source)), rates(only(rough, 1, source)))


@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.parametrize("source", MEMBERS)
def test_groups_of_one_and_two_members_have_a_motion(scene, source, count):
    members = np.flatnonzero(scene.gaussians.motion_ids == 1)
    ids = scene.gaussians.motion_ids.copy()
    ids[members[count:]] = 0
    groups = tuple(dataclasses.replace(g, anchor_index=int(members[0])) if g.id == 1 else g for g in scene.groups)
    model = only(dataclasses.replace(scene.with_arrays(motion_ids=ids), groups=groups), 1, source)
    assert np.isfinite(rates(model)).all()
    quats, displacement = models.evaluate(model, 0.2)
    pivot = scene.groups[1].pivot
    moved = pivot + rotations.rotate(quats, scene.gaussians.means[members[0]] - pivot) + displacement
    exact, shift = models.evaluate(models.MotionModel("world_twist", *TWIST[[0, 2, 1, 3]]), 0.2)
    expected = pivot + rotations.rotate(exact, scene.gaussians.means[members[0]] - pivot) + shift
    np.testing.assert_allclose(moved, expected, atol=5e-3)


def test_kabsch_carries_members_where_their_own_dynamics_bring_them(scene):
    rng = np.random.default_rng(5)
    noise = rng.normal(scale=[0.1] * 3 + [0.8] * 3 + [0.1] * 3 + [0.8] * 3, size=(len(scene.gaussians.means), 12))
    rough = scene.with_arrays(dynamics=scene.dynamics.rates + noise * (scene.dynamics.rates != 0))
    t = T_MAX * (1 + group_dynamics.HORIZON)
    goal = scene_player.Player(rough, "standard").frame(t).means
    body = scene.gaussians.motion_ids == 1
    best = rigid_fit.fit_rigid(scene.gaussians.means[body], goal[body]).residuals.mean()

    def error(source):
        return np.linalg.norm(
            scene_player.Player(rough, f"rigid/{source}").frame(t).means[body] - goal[body], axis=-1
        ).mean()

    assert error("kabsch") < 1.02 * best
    assert error("kabsch") <= 1.01 * min(error("least_squares"), error("median"), error("representative"))


def test_kabsch_is_the_best_parabola_through_the_horizon_for_members_on_a_circle():
    scene, speed, spin = make_scene(150, objects=1), 0.02, 8.0
    dynamics = np.zeros((150, 12))
    dynamics[scene.gaussians.motion_ids == 1] = [
        speed,
        0,
        0,
        0,
        0,
        spin,
        0,
        0,
        0,
        0,
        0,
        0,
    ]  # equal circles: no rotation
    model = only(scene.with_arrays(dynamics=dynamics, canonical_means=scene.gaussians.means), 1, "kabsch")
    taus = T_MAX * group_dynamics.HORIZON * np.arange(1, 7) / 6
    circle = speed / spin * np.stack([np.sin(spin * taus), 1 - np.cos(spin * taus), 0 * taus], -1)
    velocity, acceleration = np.linalg.lstsq(np.stack([taus, taus**2 / 2], -1), circle, rcond=None)[0]
    np.testing.assert_allclose(model.velocity, velocity, atol=1e-5)
    np.testing.assert_allclose(model.acceleration, acceleration, atol=1e-5)
    np.testing.assert_allclose([model.angular_velocity, model.angular_acceleration], 0, atol=1e-4)


def test_unknown_sources_and_scenes_without_dynamics_are_refused(scene):
    with pytest.raises(ValueError, match="expected one of fitted"):
        group_dynamics.models_of(scene, "mode")
    with pytest.raises(ValueError, match="no dynamics"):
        group_dynamics.models_of(make_scene(60), "median")
