"""Tracks: knots are met exactly, the pinned group stays, shadows slide along, steady motion is smooth."""

import hypothesis
import numpy as np
import pytest
import torch
from hypothesis import strategies as st

from r5dgs_core.model.tracks import Tracks
from r5dgs_core.motion import cubic_curves, rotations

TIMES = np.array([0.0, 0.1, 0.25, 0.3, 0.7])


def random_tracks(seed=0, bodies=3, times=TIMES, casters=(1, 2)):
    draws = torch.Generator().manual_seed(seed)
    quats = rotations.normalize(torch.randn(bodies, len(times), 4, generator=draws))
    quats[0] = torch.tensor([1.0, 0, 0, 0])
    normal = torch.nn.functional.normalize(torch.randn(3, generator=draws), dim=0)
    tracks = Tracks(
        times,
        torch.randn(bodies, 3, generator=draws),
        torch.randn(bodies, len(times), 3, generator=draws),
        quats,
        torch.tensor(casters, dtype=torch.int64),
        normal,
    )
    with torch.no_grad():
        tracks.params["rotvecs"][1:] = 0.3 * torch.randn(bodies - 1, len(times), 3, generator=draws)
        tracks.params["slope"].copy_(torch.randn(3, generator=draws))
    return tracks


def steady_tracks(times, accelerate=0.0):
    """One body in uniform translation and rotation."""
    t = torch.from_numpy(np.asarray(times)).float()
    shifts = torch.zeros(2, len(times), 3)
    shifts[1] = torch.outer(t + accelerate * t**2, torch.tensor([0.5, -0.2, 0.1]))
    quats = torch.zeros(2, len(times), 4)
    quats[0, :, 0] = 1
    quats[1] = rotations.rotvecs_to_quats(torch.outer(t, torch.tensor([0.0, 0.4, 1.1])))
    return Tracks(times, torch.zeros(2, 3), shifts, quats)


@pytest.mark.parametrize("s", range(len(TIMES)))
def test_poses_at_a_knot_are_the_knots(s):
    tracks = random_tracks()
    poses = tracks.poses(TIMES[s])
    torch.testing.assert_close(poses.displacements[1:3], tracks.params["translations"][1:, s], rtol=0, atol=0)
    torch.testing.assert_close(poses.quats[1:3], tracks.knot_quats()[1:, s], rtol=0, atol=0)


def test_before_and_after_the_knots_the_pose_is_held():
    tracks = random_tracks()
    for outside, knot in ((-1.0, 0.0), (5.0, 0.7)):
        for name in ("quats", "displacements"):
            torch.testing.assert_close(getattr(tracks.poses(outside), name), getattr(tracks.poses(knot), name))


@hypothesis.given(st.floats(-0.5, 1.5), st.integers(0, 20))
def test_rotations_are_proper_and_the_pinned_group_never_moves(t, seed):
    poses = random_tracks(seed).poses(t)
    torch.testing.assert_close(poses.quats.norm(dim=-1), torch.ones(5), atol=1e-5, rtol=0)
    eye = torch.eye(3).expand(5, 3, 3)
    torch.testing.assert_close(poses.rotmats @ poses.rotmats.transpose(1, 2), eye, atol=1e-5, rtol=0)
    assert (poses.displacements[0] == 0).all()


def test_parameters_of_the_pinned_group_have_no_effect_and_no_gradient():
    tracks = steady_tracks(TIMES)
    with torch.no_grad():
        tracks.params["rotvecs"][0] = 1.0
        tracks.params["translations"][0] = 2.0
    for t in (0.0, 0.18, 0.7):
        poses = tracks.poses(t)
        torch.testing.assert_close(poses.rotmats[0], torch.eye(3))
        assert (poses.displacements[0] == 0).all()
        (poses.rotmats.sum() + poses.displacements.sum()).backward()
    for name in ("rotvecs", "translations"):
        gradient = tracks.params[name].grad
        assert gradient is not None and (gradient[0] == 0).all() and (gradient[1] != 0).any()


def test_rebase_keeps_all_poses_and_starts_rotation_vectors_at_zero():
    tracks = random_tracks()
    before = [tracks.poses(t).rotmats.detach() for t in (*TIMES, 0.2, 0.5)]
    tracks.rebase()
    assert (tracks.params["rotvecs"] == 0).all() and tracks.params["rotvecs"].requires_grad
    for t, rotmats in zip((*TIMES, 0.2, 0.5), before, strict=True):
        torch.testing.assert_close(tracks.poses(t).rotmats, rotmats, atol=2e-6, rtol=0)


def test_the_sign_of_a_knots_quaternion_does_not_matter():
    tracks, other = random_tracks(), random_tracks()
    other.base_quats[1, 2] *= -1
    for t in (0.1, 0.17, 0.25, 0.28, 0.3):
        torch.testing.assert_close(tracks.poses(t).rotmats, other.poses(t).rotmats, atol=1e-6, rtol=0)


@pytest.mark.parametrize("t", [0.03, 0.1001, 0.17, 0.26, 0.5, 0.69])
def test_between_knots_tracks_follow_the_curve_of_playback(t):
    tracks = random_tracks()
    values = np.concatenate(
        [
            rotations.make_continuous(tracks.knot_quats()[1].detach().numpy().astype(np.float64)),
            tracks.params["translations"][1].detach().numpy().astype(np.float64),
        ],
        axis=1,
    )
    k = int(np.searchsorted(TIMES, t)) - 1
    rates, h = cubic_curves.slopes(TIMES, values), TIMES[k + 1] - TIMES[k]
    expected = cubic_curves.hermite(values[k], values[k + 1], rates[k], rates[k + 1], h, (t - TIMES[k]) / h)
    poses = tracks.poses(t)
    np.testing.assert_allclose(poses.displacements[1].detach().numpy(), expected[4:], atol=1e-5)
    rotmat = rotations.quats_to_rotmats(rotations.normalize(expected[:4]))
    np.testing.assert_allclose(poses.rotmats[1].detach().numpy(), rotmat, atol=1e-5)


def test_a_shadow_follows_its_caster_linearly_and_does_not_turn():
    tracks = random_tracks()
    follow, normal = tracks.follow_matrix(), tracks.plane_normal
    for t in (0.0, 0.2, 0.7):
        poses = tracks.poses(t)
        torch.testing.assert_close(poses.displacements[3:], poses.displacements[1:3] @ follow.T)
        torch.testing.assert_close(poses.rotmats[3:], torch.eye(3).expand(2, 3, 3))
        torch.testing.assert_close(poses.displacements[3:] @ normal, torch.zeros(2), atol=1e-5, rtol=0)
    along = torch.nn.functional.normalize(torch.linalg.cross(normal, torch.tensor([0.3, 0.5, -0.2])), dim=0)
    torch.testing.assert_close(follow @ along, along, atol=1e-6, rtol=0)  # sliding on the plane: same way
    slope = tracks.params["slope"]
    torch.testing.assert_close(follow @ normal, slope - (slope @ normal) * normal)  # rising: along the slope
    torch.testing.assert_close(tracks.group_centers()[3:], tracks.centers[1:])


@pytest.mark.parametrize("times", [np.linspace(0, 1, 6), TIMES])
def test_steady_motion_has_no_roughness_and_accelerated_motion_has(times):
    assert float(steady_tracks(times).roughness().detach()) == pytest.approx(0, abs=1e-11)
    assert float(steady_tracks(times, accelerate=0.5).roughness().detach()) > 1e-6


def test_at_even_spacing_roughness_is_the_mean_squared_second_difference():
    tracks = steady_tracks(np.linspace(0, 1, 5), accelerate=0.7)
    second = torch.diff(tracks.params["translations"][1:], n=2, dim=1)
    assert float(tracks.roughness().detach()) == pytest.approx(float((second**2).mean().detach()), rel=1e-3)


def test_gradients_are_finite_at_rest():
    tracks = Tracks(TIMES, torch.zeros(2, 3), torch.zeros(2, 5, 3), torch.tensor([1.0, 0, 0, 0]).expand(2, 5, 4))
    poses = tracks.poses(0.2)
    (poses.rotmats[1] @ torch.tensor([1.0, 2, 3]) + poses.displacements[1]).sum().backward()
    tracks.roughness().backward()
    for name in ("rotvecs", "translations"):
        assert torch.isfinite(tracks.params[name].grad).all()


def test_a_single_time_or_a_scene_without_bodies_is_still_a_track():
    one = random_tracks(times=np.array([0.4]), casters=())
    torch.testing.assert_close(one.poses(0.9).displacements[1:], one.params["translations"][1:, 0])
    assert float(one.roughness().detach()) == 0
    none = random_tracks(bodies=1, casters=())
    assert none.groups == 1 and float(none.roughness().detach()) == 0
    torch.testing.assert_close(none.poses(0.2).displacements, torch.zeros(1, 3))


def rough(tracks, **weights):
    return float(tracks.roughness(**weights).detach())


def test_roughness_counts_entered_knots_only():
    tracks, bent = steady_tracks(np.linspace(0, 1, 8)), steady_tracks(np.linspace(0, 1, 8))
    with torch.no_grad():
        bent.params["translations"][1, 6:] += 1.0
        bent.params["rotvecs"][1, 6:] += 0.5
    assert rough(bent) > 0.01
    assert rough(bent, entered=(0, 5)) == rough(tracks, entered=(0, 5)) == pytest.approx(0, abs=1e-11)
    assert rough(bent, entered=(3, 6)) > 0.005
    assert rough(bent, entered=(5, 6)) == 0  # two knots are always steady


def test_unit_stiffness_changes_nothing_and_stiffness_scales_where_it_is():
    tracks = random_tracks()
    ones, eyes = torch.ones(2, 5), torch.eye(3).expand(2, 5, 3, 3)
    assert rough(tracks, shift_stiffness=ones, turn_stiffness=eyes) == pytest.approx(rough(tracks), rel=1e-5)
    assert rough(tracks, shift_stiffness=3 * ones, turn_stiffness=3 * eyes) == pytest.approx(
        3 * rough(tracks), rel=1e-5
    )
    steady = steady_tracks(np.linspace(0, 1, 7))
    with torch.no_grad():
        steady.params["translations"][1, 5] += 0.1
    elsewhere, here = torch.ones(1, 7), torch.ones(1, 7)
    elsewhere[0, 1], here[0, 5] = 50.0, 50.0
    assert rough(steady, shift_stiffness=elsewhere) == pytest.approx(rough(steady), rel=1e-5)
    assert rough(steady, shift_stiffness=here) > 5 * rough(steady)


def test_a_turn_is_held_steady_about_its_stiff_axis_and_free_about_the_others():
    wobble = []
    for axis in range(3):
        tracks = steady_tracks(np.linspace(0, 1, 7))
        with torch.no_grad():
            tracks.base_quats[1] = torch.tensor([1.0, 0, 0, 0])
            tracks.params["translations"].zero_()
            tracks.params["rotvecs"][1, 3, axis] = 0.1
        stiff = torch.eye(3).expand(1, 7, 3, 3).clone()
        stiff[..., 2, 2] = 40.0
        wobble.append(rough(tracks, turn_stiffness=stiff) / rough(tracks))
    assert wobble == pytest.approx([1.0, 1.0, 40.0], rel=1e-4)
