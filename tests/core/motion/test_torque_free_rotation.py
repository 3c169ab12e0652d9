"""Bodies that turn without torque."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import special
from scipy.integrate import solve_ivp

from r5dgs_core.motion import rotations, torque_free_rotation

BOX = np.diag([0.4, 0.8, 1.0])
TILTED = rotations.quats_to_rotmats(rotations.rotvecs_to_quats(np.array([0.4, -1.1, 2.0])))
BODIES = {
    "box": BOX,
    "tilted box": TILTED @ BOX @ TILTED.T,
    "disc": np.diag([0.5, 0.5, 1.0]),
    "rod": np.diag([0.05, 1.0, 1.0]),
    "cube": np.eye(3),
    "nearly a disc": np.diag([0.5, 0.5 + 1e-7, 1.0]),
}
SPINS = {
    "any": [3.0, 0.5, -1.2],
    "smallest axis": [4.0, 0, 0],
    "middle axis": [0, 4.0, 0],
    "nearly the middle axis": [1e-3, 4.0, 1e-4],
    "largest axis": [0, 0, -4.0],
    "nearly the largest axis": [1e-9, 0, 4.0],
    "across": [3.0, 0, 2.0],
    "slow": [1e-3, 2e-3, -1e-3],
}


def direct(body, w, tau):
    """The same motion by a general solver."""
    momentum, inverse = body @ w, np.linalg.inv(body)

    def slope(_, quat):
        matrix = rotations.quats_to_rotmats(rotations.normalize(quat))
        return rotations.quat_rates(quat, matrix @ inverse @ matrix.T @ momentum)

    solution = solve_ivp(slope, (0, tau), [1.0, 0, 0, 0], method="DOP853", rtol=1e-12, atol=1e-12)
    return rotations.normalize(solution.y[:, -1])


@pytest.mark.default_cases("tilted box", "disc", "rod")
@pytest.mark.parametrize("name", BODIES)
def test_tumbling_solves_eulers_equations(name):
    body = BODIES[name]
    for spin, rates in SPINS.items():
        w = np.array(rates)
        for tau in (2.5, -1.5):
            quats, _ = torque_free_rotation.rotations_and_spins(body, w, np.array([tau]))
            assert rotations.angle_between(quats[0], direct(body, w, tau)) < 3e-7, (spin, tau)


@pytest.mark.parametrize("name", BODIES)
def test_energy_and_momentum_are_kept_over_ten_turns(name):
    body = BODIES[name]
    for spin, rates in SPINS.items():
        w = np.array(rates)
        tau = np.linspace(0, 20 * np.pi / np.linalg.norm(w), 50)
        quats, spins = torque_free_rotation.rotations_and_spins(body, w, tau)
        matrices = rotations.quats_to_rotmats(quats)
        momenta = (matrices @ body @ np.swapaxes(matrices, -1, -2) @ spins[..., None])[..., 0]
        expected = np.broadcast_to(body @ w, momenta.shape)
        np.testing.assert_allclose(momenta, expected, atol=1e-6 * np.linalg.norm(body @ w), err_msg=spin)
        np.testing.assert_allclose((momenta * spins).sum(-1), w @ body @ w, rtol=1e-6, err_msg=spin)


@pytest.mark.parametrize("ratio", [0.3, 0.9, 1.1, 1.9])
def test_a_symmetric_top_precesses_at_the_analytic_rate(ratio):
    body, w, tau = np.diag([1.0, 1.0, ratio]), np.array([0.6, 0.0, 2.0]), np.linspace(0, 30, 40)
    _, spins = torque_free_rotation.rotations_and_spins(body, w, tau)
    quats, _ = torque_free_rotation.rotations_and_spins(body, w, tau)
    # The axis turns about the angular momentum L at the rate |L| / I1; the spin circles it with the same rate.
    momentum = body @ w
    exact = rotations.rotate(rotations.rotvecs_to_quats(momentum * tau[:, None]), np.broadcast_to([0, 0, 1.0], (40, 3)))
    np.testing.assert_allclose(rotations.rotate(quats, np.broadcast_to([0, 0, 1.0], (40, 3))), exact, atol=1e-6)
    circling = rotations.rotate(rotations.rotvecs_to_quats(momentum * tau[:, None]), np.broadcast_to(w, (40, 3)))
    np.testing.assert_allclose(spins, circling, atol=1e-6)


def test_spins_are_the_derivative_of_the_turns():
    tau, h = np.array([-3.0, 0.0, 0.7, 12.0]), 1e-6
    for body in BODIES.values():
        for w in SPINS.values():
            _, spins = torque_free_rotation.rotations_and_spins(body, np.array(w), tau)
            behind, ahead = (torque_free_rotation.rotations_and_spins(body, np.array(w), tau + s)[0] for s in (-h, h))
            measured = rotations.quats_to_rotvecs(rotations.multiply(ahead, rotations.conjugate(behind))) / (2 * h)
            np.testing.assert_allclose(measured, spins, atol=3e-8 + 1e-7 * np.linalg.norm(w))


def test_zero_time_and_zero_spin_are_the_identity_to_the_bit():
    quats, spins = torque_free_rotation.rotations_and_spins(
        BOX, np.array([[1.0, 2, 3], [0, 0, 0]]), np.array([0.0, 1.0])
    )
    assert quats[0, 0].tolist() == quats[1, 0].tolist() == quats[1, 1].tolist() == [1, 0, 0, 0]
    assert not spins[1].any()
    assert (quats[0, 1] != quats[0, 0]).any()


def test_batches_of_spins_and_times_equal_single_evaluations():
    spins, tau = np.array(list(SPINS.values())), np.linspace(-2, 2, 5)
    together = torque_free_rotation.rotations_and_spins(BODIES["tilted box"], spins, tau)
    for i, w in enumerate(spins):
        for j, t in enumerate(tau):
            alone = torque_free_rotation.rotations_and_spins(BODIES["tilted box"], w, np.array([t]))
            assert rotations.angle_between(together[0][i, j], alone[0][0]) < 1e-12
            np.testing.assert_allclose(together[1][i, j], alone[1][0], atol=1e-12)


def test_far_times_lose_only_the_digits_of_the_angle():
    w = np.array([3.0, 0.5, -1.2])
    there, spins = torque_free_rotation.rotations_and_spins(BOX, w, np.array([1e4]))
    matrix = rotations.quats_to_rotmats(there[0])
    back, _ = torque_free_rotation.rotations_and_spins(matrix @ BOX @ matrix.T, spins[0], np.array([-1e4]))
    assert rotations.angle_between(rotations.multiply(back[0], there[0]), np.array([1.0, 0, 0, 0])) < 1e-7


def test_elliptic_functions_are_those_of_scipy():
    m, u = np.meshgrid([0.0, 1e-9, 0.3, 0.9, 0.9999, 1 - 1e-9], np.linspace(-15, 15, 31))
    for ours, theirs in zip(torque_free_rotation.jacobi_elliptic(u, 1 - m), special.ellipj(u, m)[:3], strict=True):
        np.testing.assert_allclose(ours, theirs, atol=2e-8)
        np.testing.assert_allclose(ours[:, :4], theirs[:, :4], atol=1e-13)
    np.testing.assert_allclose(torque_free_rotation.elliptic_k(1 - m), special.ellipkm1(1 - m), rtol=1e-13)
    np.testing.assert_allclose(
        torque_free_rotation.elliptic_f(u, 1 - m), special.ellipkinc(u, m), rtol=1e-10, atol=1e-12
    )


def test_inertia_is_that_of_the_cloud():
    rng = np.random.default_rng(0)
    sides = np.array([3.0, 2.0, 1.0])
    points = rng.uniform(-0.5, 0.5, size=(200000, 3)) * sides
    expected = np.array([sides[1] ** 2 + sides[2] ** 2, sides[0] ** 2 + sides[2] ** 2, sides[0] ** 2 + sides[1] ** 2])
    found = torque_free_rotation.inertia(points @ TILTED.T + [1e3, 0, 0], np.full(len(points), 0.3))
    np.testing.assert_allclose(found, TILTED @ np.diag(expected / expected.sum()) @ TILTED.T, atol=2e-3)
    assert np.trace(found) == pytest.approx(1)
    assert torque_free_rotation.tumbles(found)
    for none in (np.zeros((0, 3)), np.ones((1, 3)), np.ones((5, 3))):
        np.testing.assert_allclose(torque_free_rotation.inertia(none), np.eye(3) / 3)
    assert not torque_free_rotation.tumbles(np.eye(3) / 3)
    assert not torque_free_rotation.tumbles(np.diag([0.95, 1.0, 1.0]))
    assert not torque_free_rotation.tumbles(torque_free_rotation.inertia(np.outer(np.arange(5.0), [1, 2, 3])))


def test_a_body_without_extent_in_two_directions_is_refused():
    with pytest.raises(ValueError, match="moments"):
        torque_free_rotation.rotations_and_spins(np.diag([0.0, 1.0, 1.0]), np.ones(3), np.zeros(1))
