import math

import mpmath
import numpy as np
import pytest
import torch

from r5dgs_core.motion import rotations, se3

W, V = np.array([1.2, -0.7, 2.6]), np.array([0.5, 0.3, -0.9])
EPS, ACC = np.array([0.9, 1.1, -0.4]), np.array([-0.2, 0.8, 0.5])


def matrix(pose):
    result = np.eye(4)
    result[:3, :3] = rotations.quats_to_rotmats(pose[0])
    result[:3, 3] = pose[1]
    return result


def wedge(w, v):
    x, y, z = w
    return np.array([[0, -z, y, v[0]], [z, 0, -x, v[1]], [-y, x, 0, v[2]], [0, 0, 0, 0]])


def expm(rows):
    """The matrix exponential to more digits than float64 has."""
    with mpmath.workdps(60):
        result = mpmath.expm(mpmath.matrix([[mpmath.mpf(float(x)) for x in row] for row in rows]), method="taylor")
        return np.array(result.tolist(), dtype=float)


def fine(w, v, eps, a, duration):
    return se3.integrate(w, v, eps, a, duration, 2048)


def distance(p, q, radius=1.0):
    turn = rotations.angle_between(p[0], q[0])
    return np.linalg.norm(p[1] - q[1], axis=-1) + 2 * radius * np.sin(0.5 * turn)


@pytest.mark.parametrize("angle", [0.0, 1e-300, 1e-12, 1e-8, 1e-4, 0.5, math.pi, 2 * math.pi, 100.0])
def test_exponential_equals_the_matrix_exponential(angle):
    w = angle * np.array([0.36, -0.48, 0.8])
    np.testing.assert_allclose(matrix(se3.exp(w, V)), expm(wedge(w, V)), atol=1e-13)


def test_the_zero_twist_is_the_identity_to_the_bit():
    q, d = se3.exp(np.zeros(3), np.zeros(3))
    assert q.tolist() == [1, 0, 0, 0]
    assert d.tolist() == [0, 0, 0]


@pytest.mark.parametrize(("order", "expected"), [(2, 2.0), (4, 4.0)])
def test_magnus_steps_converge_with_their_order(order, expected):
    truth = fine(W, V, EPS, ACC, 2.0)
    coarse, finer = (distance(se3.integrate(W, V, EPS, ACC, 2.0, n, order), truth) for n in (16, 64))
    assert 0.5 * math.log2(coarse / finer) == pytest.approx(expected, abs=0.1)


def test_magnus_solves_the_differential_equation():
    from scipy.integrate import solve_ivp

    x0 = np.array([0.4, -0.2, 0.7])
    exact = solve_ivp(
        lambda t, x: V + t * ACC + np.cross(W + t * EPS, x), (0, 1.3), x0, method="DOP853", rtol=1e-12, atol=1e-12
    ).y[:, -1]
    q, d = fine(W, V, EPS, ACC, 1.3)
    np.testing.assert_allclose(rotations.rotate(q, x0) + d, exact, atol=1e-9)


@pytest.mark.parametrize("count", [1, 2, 3, 7, 64, 1000])
def test_products_by_halving_and_doubling_equal_the_loop(count):
    rng = np.random.default_rng(count)
    poses = se3.exp(0.3 * rng.normal(size=(count, 3)), 0.1 * rng.normal(size=(count, 3)))
    loop = (rotations.identity(), np.zeros(3))
    prefixes = []
    for i in range(count):
        loop = se3.compose((poses[0][i], poses[1][i]), loop)
        prefixes.append(loop)
    assert distance(se3.product(*poses), loop) < 1e-12
    quats, displacements = se3.scan(*poses)
    np.testing.assert_allclose(displacements, np.stack([p[1] for p in prefixes]), atol=1e-12)
    np.testing.assert_allclose(quats, np.stack([p[0] for p in prefixes]), atol=1e-12)


def test_the_step_rule_keeps_its_tolerance():
    rng = np.random.default_rng(0)
    ratios = []
    for _ in range(200):
        w = rng.normal(size=3) * 10 ** rng.uniform(-1, 1)
        eps = rng.normal(size=3) * np.linalg.norm(w)
        v, a, duration = rng.normal(size=3), rng.normal(size=3), 10 ** rng.uniform(-1, 0.3)
        tolerance = 10 ** rng.uniform(-6, -2)
        n = int(se3.steps_needed(w, v, eps, a, duration, 0.3, tolerance))
        truth = se3.integrate(w, v, eps, a, duration, 16 * n)
        ratios.append(distance(se3.integrate(w, v, eps, a, duration, n), truth, 0.3) / tolerance)
    assert max(ratios) <= 2
    assert np.median(ratios) > 1e-3  # the rule is not wasteful by a factor of ten in steps


def test_one_step_is_exact_where_twist_and_rate_commute():
    n = se3.steps_needed(W, V, 0.5 * W, 0.5 * V, 3.0, 1.0, 1e-9)
    assert n == 1
    whole = 3.0 + 0.5 * 3.0**2 / 2  # the twist is (1 + t / 2) times the first one
    assert distance(se3.integrate(W, V, 0.5 * W, 0.5 * V, 3.0, 1), se3.exp(whole * W, whole * V)) < 1e-12


def test_a_fixed_axis_rotates_by_the_integral_of_its_spin():
    w, eps = np.array([1.2, -0.4, 2.0]), -1.3 * np.array([1.2, -0.4, 2.0])
    for duration in (0.5, 1.0, 2.0, 30.0):
        q, _ = se3.integrate(w, V, eps, ACC, duration, 4)
        exact = rotations.rotvecs_to_quats(w * duration + 0.5 * eps * duration**2)
        assert rotations.angle_between(q, exact) < 1e-12 * max(1.0, duration**2)


def test_reversal_through_a_stop_is_exact_for_a_fixed_axis():
    w, eps = np.array([0, 0, 2.0]), np.array([0, 0, -2.0])
    q, _ = se3.integrate(w, np.zeros(3), eps, np.zeros(3), 2.0, 1)
    assert rotations.angle_between(q, np.array([1.0, 0, 0, 0])) < 1e-12


@pytest.mark.parametrize("angle", [1e-9, 0.3, math.pi, 2 * math.pi, 40.0])
def test_closed_form_of_constant_spin_solves_its_equation(angle):
    w = angle * np.array([0.6, 0.0, 0.8])
    # The displacement solves d' = w x d + v + a t: a linear system with t and 1 as further unknowns.
    system = np.zeros((5, 5))
    system[:3, :3], system[:3, 3], system[:3, 4], system[3, 4] = wedge(w, V)[:3, :3], ACC, V, 1.0
    quat, displacement = se3.accelerated_spin(w, V, ACC, np.array(1.0))
    np.testing.assert_allclose(displacement, expm(system)[:3, 4], atol=1e-12)
    np.testing.assert_allclose(rotations.quats_to_rotmats(quat), expm(wedge(w, V))[:3, :3], atol=1e-12)
    # Constant v and w: a single exponential is the exact answer.
    assert distance(se3.accelerated_spin(w, V, np.zeros(3), np.array(1.0)), se3.exp(w, V)) < 1e-13


def test_origin_shift_changes_nothing_but_rounding():
    c = np.array([3.0, -4.0, 5.0])
    v, a = se3.recentre(W, V, EPS, ACC, c)
    q, d = se3.integrate(W, V, EPS, ACC, 1.0, 32)
    q2, d2 = se3.integrate(W, v, EPS, a, 1.0, 32)
    np.testing.assert_allclose(q, q2, atol=1e-14)
    # x = c + r: world form gives q c + d, the centred form c + d2 for the centre itself.
    np.testing.assert_allclose(rotations.rotate(q, c) + d, c + d2, atol=1e-12)


def test_a_body_far_from_the_origin_keeps_its_shape_and_position():
    center, rng = np.array([1e4, -1e4, 5e3]), np.random.default_rng(1)
    offsets = rng.normal(size=(20, 3))
    v, a = V - np.cross(W, center), ACC - np.cross(EPS, center)  # about the world's origin; about the centre V and ACC
    v, a = se3.recentre(W, v, EPS, a, center)
    quat, shift = se3.integrate(W, v, EPS, a, 1.0, 32)
    near = se3.integrate(W, V, EPS, ACC, 1.0, 32)
    assert distance((quat, shift), near) < 1e-9
    moved = rotations.rotate(quat, offsets).astype(np.float32)
    pairs, after = (np.linalg.norm(x[:, None] - x[None], axis=-1) for x in (offsets, moved))
    np.testing.assert_allclose(after, pairs, rtol=1e-6, atol=1e-6)


def test_recentred_rates_are_those_of_the_centre():
    center, h = np.array([3.0, -4.0, 5.0]), 1e-4
    v, a = se3.recentre(W, V, EPS, ACC, center)

    def place(t):
        q, d = se3.integrate(W, V, EPS, ACC, t, 4)
        return rotations.rotate(q, center) + d

    ahead, here, behind = place(h), place(0.0), place(-h)
    np.testing.assert_allclose((ahead - behind) / (2 * h), v, atol=1e-5)
    # The rate at a fixed place is a; that of the body point, which moves with v, is a + w x v.
    np.testing.assert_allclose((ahead - 2 * here + behind) / h**2, a + np.cross(W, v), atol=1e-5)


@pytest.mark.parametrize("steps", [1, 3, 64])
@pytest.mark.parametrize("order", [2, 4])
def test_zero_time_gives_the_identity_to_the_bit(steps, order):
    q, d = se3.integrate(W, V, EPS, ACC, np.zeros(2), steps, order)
    assert q.tolist() == [[1, 0, 0, 0]] * 2
    assert d.tolist() == [[0, 0, 0]] * 2


def test_parts_of_a_time_one_after_another_are_the_whole_within_the_tolerance():
    tolerance, parts = 1e-6, np.linspace(0, 2.0, 9)

    def reach(start, duration):
        w, v = W + start * EPS, V + start * ACC
        return se3.integrate(
            w, v, EPS, ACC, duration, int(se3.steps_needed(w, v, EPS, ACC, duration, 1.0, tolerance / 8))
        )

    pose = (rotations.identity(), np.zeros(3))
    for start, stop in zip(parts[:-1], parts[1:], strict=True):
        pose = se3.compose(reach(start, stop - start), pose)
        assert distance(pose, fine(W, V, EPS, ACC, stop)) < 2 * tolerance
    assert distance(pose, reach(0.0, 2.0)) < 2 * tolerance


def test_integrating_backward_inverts_integrating_forward():
    q, d = se3.integrate(W, V, EPS, ACC, 1.5, 5)
    back = se3.integrate(W + 1.5 * EPS, V + 1.5 * ACC, EPS, ACC, -1.5, 5)
    assert distance(se3.compose(back, (q, d)), (rotations.identity(), np.zeros(3))) < 1e-13


def test_motion_composes_over_time():
    first = fine(W, V, EPS, ACC, 0.4)
    second = fine(W + 0.4 * EPS, V + 0.4 * ACC, EPS, ACC, 0.7)
    assert distance(se3.compose(second, first), fine(W, V, EPS, ACC, 1.1)) < 1e-10


def test_many_steps_stay_orthogonal_and_keep_distances():
    q, d = se3.integrate(np.array([2.08, 0, 0.3]), V, np.zeros(3), np.zeros(3), 1e5 / 60, 100000)
    r = rotations.quats_to_rotmats(q)
    assert np.abs(r.T @ r - np.eye(3)).max() < 1e-11
    points = np.random.default_rng(0).normal(size=(20, 3))
    moved = rotations.rotate(q, points) + d
    pairs = np.linalg.norm(points[:, None] - points[None], axis=-1)
    np.testing.assert_allclose(np.linalg.norm(moved[:, None] - moved[None], axis=-1), pairs, atol=1e-12)


def test_an_unknown_order_is_refused():
    with pytest.raises(ValueError, match="order"):
        se3.integrate(W, V, EPS, ACC, 1.0, 4, order=3)


def test_numpy_and_torch_agree_to_rounding():
    rng = np.random.default_rng(3)
    w, v, eps, a = (rng.normal(size=(6, 3)) for _ in range(4))
    quats, moves = se3.exp(w, v)
    spans = rng.uniform(-1, 2, size=6)
    calls = [
        (se3.exp, (w, v)),
        (se3.v_matrix_times, (w, v)),
        (se3.phi_2_times, (w, v)),
        (se3.recentre, (w, v, eps, a, a)),
        (se3.product, (quats, moves)),
        (se3.scan, (quats, moves)),
        (se3.step_twists, (w, v, eps, a, spans, 5)),
        (se3.integrate, (w, v, eps, a, spans, 5)),
        (se3.integrate, (w, v, eps, a, spans, 5, 2)),
        (se3.accelerated_spin, (w, v, a, spans)),
        (lambda *x: se3.compose((x[0], x[1]), (x[2], x[3])), (quats, moves, quats[::-1].copy(), moves[::-1].copy())),
    ]
    for function, arguments in calls:
        ours = function(*arguments)
        theirs = function(*(torch.from_numpy(x) if isinstance(x, np.ndarray) else x for x in arguments))
        for x, y in zip(*((part,) if not isinstance(part, tuple) else part for part in (ours, theirs)), strict=True):
            assert isinstance(y, torch.Tensor)
            np.testing.assert_allclose(y.numpy(), x, atol=1e-13)
    tensors = [torch.from_numpy(x) for x in (w, v, eps, a, spans)]
    assert (se3.steps_needed(*tensors, 1.0, 1e-6) == se3.steps_needed(w, v, eps, a, spans, 1.0, 1e-6)).all()


def test_single_precision_is_integrated_in_double():
    single = [torch.tensor(x, dtype=torch.float32) for x in (W, V, EPS, ACC)]
    quat, shift = se3.integrate(*single, torch.tensor(100.0), 10000)
    assert quat.dtype == shift.dtype == torch.float64
    exact = se3.integrate(*(x.double().numpy() for x in single), 100.0, 10000)
    assert distance((quat.numpy(), shift.numpy()), exact) < 1e-9


def test_gradients_are_finite_and_right_at_zero_spin():
    zero = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    still = torch.zeros(2, 3, dtype=torch.float64, requires_grad=True)
    moving, tiny = (torch.tensor(x, requires_grad=True) for x in (V, 1e-9 * W))
    for w, v in ((zero, moving), (zero, zero), (tiny, moving), (still, moving)):
        assert torch.autograd.gradcheck(lambda w, v: se3.exp(w, v), (w, v))
    rates = [torch.tensor(x, requires_grad=True) for x in (EPS, ACC)]
    span = torch.tensor(0.7, dtype=torch.float64, requires_grad=True)
    for w in (zero, torch.tensor(W, requires_grad=True)):
        assert torch.autograd.gradcheck(lambda *x: se3.integrate(*x, 3), (w, moving, *rates, span))


def test_overflowing_rates_are_reported_by_the_steps():
    for bad in (math.nan, math.inf, 1e200):
        rates = (
            np.array([[bad, 1, 0], [1.0, 2, 0]]),
            np.ones((2, 3)),
            np.array([[0, bad, 1], [0, 0, 0.5]]),
            np.ones((2, 3)),
        )
        with np.errstate(all="ignore"):
            steps = se3.steps_needed(*rates, np.ones(2), 1.0, 1e-6)
        assert steps[0] == se3.MAX_STEPS
        assert 1 <= steps[1] < 100
