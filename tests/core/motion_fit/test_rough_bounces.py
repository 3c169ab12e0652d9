import dataclasses

import numpy as np
import pytest

from r5dgs_core.motion import models, rotations
from r5dgs_core.motion.pose_track import PoseTrack
from r5dgs_core.motion_fit import candidates, model_selection, rough_bounces

TAU, UP = np.linspace(-1, 0, 15), (0.0, 0.0, 1.0)
NOISE = candidates.Noise(0.004, 0.004)
BALL = {"r": [0.1, 0, 0.2], "e": [0.0, 0.1, 0], "w": [0.5, 1.0, -0.5], "v": [0.6, 0.2, 6.0]}
BALL |= {"a": [0, 0, -30.0], "bounce": [-0.7], "logit_rho": [1.4]}
CHANGES = {"dw": [1.0, -0.6, 0.3], "dw2": [-0.4, 0.9, 0.7], "dv": [-0.5, 0.4, 0], "dv2": [0.3, 0.3, 0]}


def bounces(change, law="bounces"):
    """Bounces off a rough floor, whose last impact is at -0.3, and their parameters."""
    blocks = (*candidates.BY_NAME[law].blocks, *rough_bounces.CHANGES[change])
    window = PoseTrack(TAU, rotations.identity(15), np.zeros((15, 3)), np.ones(15), UP).window
    own = rough_bounces.RoughBounces(f"{law}, {change}", "bounce", blocks, window, base=law)
    values = {name: np.array(value, float) for name, value in (BALL | CHANGES | {"fall": [30.0]}).items()}
    return own, own.pack(values)


def observed(change, sigma, seed=0):
    own, theta = bounces(change)
    quats, d = own.path(theta, TAU)
    noise = sigma * np.random.default_rng(seed).normal(size=(2, 15, 3))
    return PoseTrack(
        TAU, rotations.multiply(rotations.rotvecs_to_quats(noise[1]), quats), d + noise[0], np.ones(15), UP
    )


@pytest.mark.parametrize("law", rough_bounces.LAWS)
@pytest.mark.parametrize("change", rough_bounces.CHANGES)
def test_after_the_last_impact_the_body_follows_the_law_and_every_impact_keeps_its_pose(change, law):
    own, theta = bounces(change, law)
    parts = own.parts(theta)
    last, before = (float(time[0]) for time in models.KINDS["bounce"].last_impacts(parts, own.window))
    assert -1 < before < last < 0
    tau = np.linspace(last, 0, 20)
    for x, y in zip(own.path(theta, tau), own.law.path(own.law_parameters(theta), tau), strict=True):
        np.testing.assert_allclose(x, y, atol=1e-12)
    for time in (before, last):
        quats, d = own.path(theta, time + np.array([-1e-9, 1e-9]))
        assert rotations.angle_between(*quats) < 1e-7 and np.abs(d[1] - d[0]).max() < 1e-7


def test_the_spin_and_the_velocity_along_the_floor_change_at_the_last_two_impacts_alone():
    own, theta = bounces("rough floor, twice")
    last, before = (float(time[0]) for time in models.KINDS["bounce"].last_impacts(own.parts(theta), own.window))
    h = 1e-5
    spins, speeds = [], []
    for time in (last + 0.05, last - 0.05, before - 0.05):
        quats, d = own.path(theta, np.array([time, time + h]))
        spins.append(rotations.quats_to_rotvecs(rotations.multiply(quats[1], rotations.conjugate(quats[0]))) / h)
        speeds.append((d[1] - d[0])[:2] / h)
    found = np.diff(spins, axis=0), np.diff(speeds, axis=0)
    np.testing.assert_allclose(found[0], [CHANGES["dw"], CHANGES["dw2"]], atol=1e-4)
    np.testing.assert_allclose(found[1], [CHANGES["dv"][:2], CHANGES["dv2"][:2]], atol=1e-4)


@pytest.mark.parametrize("change", ["new spin", "rough floor, twice"])
def test_the_parameters_of_exact_poses_are_found(change):
    track, (own, theta) = observed(change, 0.0), bounces(change)
    smooth = candidates.solve(dataclasses.replace(candidates.BY_NAME["bounces"], window=own.window), track, NOISE)
    assert smooth is not None
    found = {s.candidate.name: s for s in rough_bounces.search(track, NOISE, [smooth])}[own.name]
    exact = candidates.solve(found.candidate, track, NOISE, [found.theta], steps=60, enough=1e-20)
    assert exact is not None and np.abs(exact.residuals).max() < 0.01
    for x, y in zip(own.law.rates(exact.law_theta), own.law.rates(own.law_parameters(theta)), strict=True):
        np.testing.assert_allclose(x, y, atol=1e-3)


@pytest.mark.parametrize(("change", "up"), [("new spin", UP), ("new spins", None), ("rough floor", UP)])
def test_a_ball_on_a_rough_floor_is_predicted_through_its_next_impact(change, up):
    own, theta = bounces(change)
    track, law = observed(change, 0.003), own.law_parameters(theta)
    end = track.quats[-1], track.displacements[-1]
    quats = rotations.multiply(track.quats, rotations.conjugate(end[0]))
    fit = model_selection.fit(TAU + 1, quats, track.displacements - end[1], radius=1.0, up=up and np.array(up))
    assert fit.model.kind == "bounce"
    times = [event.time for event in fit.history.events]
    np.testing.assert_allclose(times, [0.3, 0.7], atol=0.01)
    later = np.linspace(0.05, 0.3, 6)  # the next impact is at 0.02
    turned, moved = models.evaluate(fit.model, later)
    true_quats, true_d = own.law.path(law, later)
    assert np.linalg.norm(end[1] + moved - true_d, axis=1).max() < 0.05
    assert rotations.angle_between(rotations.multiply(turned, end[0]), true_quats).max() < 0.05


def test_a_ball_that_keeps_its_spin_has_no_other_law():
    own, theta = bounces("new spin")
    path = own.law.path(own.law_parameters(theta), TAU)
    noise = 0.003 * np.random.default_rng(3).normal(size=(2, 15, 3))
    quats = rotations.multiply(rotations.rotvecs_to_quats(noise[1]), path[0])
    fit = model_selection.fit(TAU + 1, quats, path[1] + noise[0], radius=1.0)
    best = min(fit.scores, key=lambda score: score.evidence)
    assert fit.chosen == best.name == "bounces"


def test_a_level_floor_has_one_number_for_gravity_and_needs_the_up_axis():
    track = observed("new spin", 0.0)
    level = candidates.BY_NAME["bounces, level"]
    assert level.parameters == candidates.BY_NAME["bounces"].parameters - 2
    assert dataclasses.replace(level, window=track.window).starts(track)
    unknown = dataclasses.replace(track, up=None)
    assert not dataclasses.replace(level, window=unknown.window).starts(unknown)


def test_bounces_off_a_rough_floor_are_tried_if_two_impacts_are_seen_and_no_other_law_explains_the_poses():
    track = observed("new spin", 0.0)
    laws = [dataclasses.replace(candidates.BY_NAME[name], window=track.window) for name in ("static", "bounces")]
    solved = [s for law in laws if (s := candidates.solve(law, track, NOISE)) is not None]
    assert len(rough_bounces.search(track, NOISE, solved)) == len(rough_bounces.CHANGES)
    explained = dataclasses.replace(solved[0], residuals=np.ones((15, 6)))
    assert not rough_bounces.search(track, NOISE, [explained, solved[1]])
    late = track.rows(slice(5, None))  # after the first impact
    late = dataclasses.replace(late, tau=late.tau / -late.tau[0])
    again = candidates.solve(dataclasses.replace(laws[1], window=late.window), late, NOISE)
    assert again is not None and not rough_bounces.search(late, NOISE, [again])
