"""Motion of groups out of the dynamics of their members."""

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


def test_the_fitted_source_is_what_the_scene_holds(scene):
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
def test_faint_members_do_not_vote_and_a_few_bad_ones_do_not_matter(scene, source):
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
def test_spins_that_training_cannot_see_do_not_mislead_fits_to_what_it_sees(scene, source, right):
    """Members that move like the body but do not spin themselves: only v + w x r is seen in training."""
    dynamics = np.asarray(scene.dynamics.rates, np.float64).copy()
    for group in scene.groups:
        rows = np.flatnonzero(scene.gaussians.motion_ids == group.id)
        v, w, a, _ = np.split(dynamics[rows], 4, axis=-1)
        dynamics[rows, 6:9] = a + rotations.cross(w, v)  # what the twist adds to the acceleration
    dynamics[:, 3:6], dynamics[:, 9:] = 0.0, 0.0
    model = only(scene.with_arrays(dynamics=dynamics), 1, source)
    error = np.abs(rates(model)[:2] - TWIST[:2]).max()
    assert error < 0.05 if right else error > 0.5


@pytest.mark.parametrize("source", ["least_squares", "kabsch"])
def test_a_line_of_members_takes_the_spin_about_itself_from_them(scene, source):
    members = np.flatnonzero(scene.gaussians.motion_ids == 1)
    means = scene.gaussians.means.copy()
    means[members] = scene.groups[1].pivot + np.linspace(-0.25, 0.25, len(members))[:, None] * [1.0, 0, 0]
    line = rigid_dynamics(scene.with_arrays(means=means))
    np.testing.assert_allclose(rates(only(line, 1, source)), TWIST, atol=2e-2)


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
    goal = scene_player.frame(rough, t, "standard").means
    body = scene.gaussians.motion_ids == 1
    best = rigid_fit.fit_rigid(scene.gaussians.means[body], goal[body]).residuals.mean()

    def error(source):
        return np.linalg.norm(scene_player.frame(rough, t, f"rigid/{source}").means[body] - goal[body], axis=-1).mean()

    assert error("kabsch") < 1.02 * best
    assert error("kabsch") <= 1.01 * min(error("least_squares"), error("median"), error("representative"))


def test_unknown_sources_and_scenes_without_dynamics_are_refused(scene):
    with pytest.raises(ValueError, match="expected one of fitted"):
        group_dynamics.models_of(scene, "mode")
    with pytest.raises(ValueError, match="no dynamics"):
        group_dynamics.models_of(make_scene(60), "median")
