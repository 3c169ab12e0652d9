import mpmath
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from r5dgs_core.motion import rotations as rot

ANGLES = [0.0, 1e-300, 1e-160, 1e-12, 1e-8, 1e-4, 0.01, 0.5, 0.999, 1.001, np.pi - 1e-4, np.pi, 2 * np.pi, 100.0]


def quats(count=()):
    raw = hnp.arrays(np.float64, (*count, 4), elements=st.floats(-1, 1))
    awkward = st.sampled_from([[1.0, 0, 0, 0], [-1.0, 0, 0, 0], [0, 1.0, 0, 0], [1.0, 1e-9, 0, 0], [1e-9, 0, 0, 1.0]])
    return st.one_of(raw.filter(lambda q: np.linalg.norm(q) > 1e-3), awkward.map(np.array)).map(rot.normalize)


def vectors():
    return hnp.arrays(np.float64, 3, elements=st.floats(-10, 10))


def random_quats(n, seed=0):
    return rot.normalize(np.random.default_rng(seed).normal(size=(n, 4)))


@given(quats(), quats(), vectors())
def test_multiply_composes_rotations(p, q, v):
    np.testing.assert_allclose(rot.rotate(rot.multiply(p, q), v), rot.rotate(p, rot.rotate(q, v)), atol=1e-13)


@given(hnp.arrays(np.float64, (2, 3, 3), elements=st.floats(-10, 10)), quats())
def test_the_nearest_rotation_is_optimal(matrices, other):
    nearest = rot.nearest_rotmats(matrices)
    np.testing.assert_allclose(
        nearest @ np.swapaxes(nearest, -1, -2), np.broadcast_to(np.eye(3), (2, 3, 3)), atol=1e-12
    )
    np.testing.assert_allclose(np.linalg.det(nearest), 1, atol=1e-12)
    distances = [np.linalg.norm(matrices - rotmats, axis=(1, 2)) for rotmats in (nearest, rot.quats_to_rotmats(other))]
    assert (distances[0] <= distances[1] + 1e-9).all()
    torch.testing.assert_close(
        torch.linalg.norm(rot.nearest_rotmats(torch.from_numpy(matrices)) - torch.from_numpy(matrices), dim=(1, 2)),
        torch.from_numpy(distances[0]),
    )


@given(quats())
def test_a_rotation_is_its_own_nearest_even_if_scaled(q):
    rotmat = rot.quats_to_rotmats(q)
    for scale in (1e-6, 1.0, 1e6):
        np.testing.assert_allclose(rot.nearest_rotmats(scale * rotmat), rotmat, atol=1e-12)


@given(quats(), vectors())
def test_rotate_equals_the_matrix_and_keeps_lengths(q, v):
    turned = rot.rotate(q, v)
    np.testing.assert_allclose(turned, rot.quats_to_rotmats(q) @ v, atol=1e-13)
    assert np.linalg.norm(turned) == pytest.approx(np.linalg.norm(v), abs=1e-13)


@given(quats(), vectors())
def test_the_conjugate_is_the_inverse(q, v):
    np.testing.assert_allclose(rot.rotate(rot.conjugate(q), rot.rotate(q, v)), v, atol=1e-13)


@given(quats())
def test_matrices_and_quaternions_convert_back(q):
    back = rot.rotmats_to_quats(rot.quats_to_rotmats(q))
    assert back[0] >= 0
    assert rot.angle_between(q, back) < 1e-14


@pytest.mark.parametrize("gap", [0.0, 1e-6, 1e-4, 0.1])
@pytest.mark.parametrize(("dtype", "tolerance"), [(np.float64, 1e-15), (np.float32, 3e-7)])
def test_half_turns_keep_their_digits_as_matrices(gap, dtype, tolerance):
    axes = np.random.default_rng(1).normal(size=(500, 3))
    axes = np.concatenate([axes / np.linalg.norm(axes, axis=-1, keepdims=True), np.eye(3)])
    q = rot.rotvecs_to_quats((np.pi - gap) * axes).astype(dtype)
    back = rot.rotmats_to_quats(rot.quats_to_rotmats(q))
    assert np.isfinite(back).all()
    assert rot.angle_between(q.astype(np.float64), back.astype(np.float64)).max() < tolerance


@pytest.mark.parametrize("angle", ANGLES)
def test_exponential_and_logarithm_agree_up_to_whole_turns(angle):
    axis = np.array([0.36, -0.48, 0.8])
    vector = rot.quats_to_rotvecs(rot.rotvecs_to_quats(angle * axis))
    expected = float(mpmath.fmod(mpmath.mpf(angle) + mpmath.pi, 2 * mpmath.pi) - mpmath.pi)
    distance = min(np.linalg.norm(vector - expected * axis), np.linalg.norm(vector - (expected + 2 * np.pi) * axis))
    assert distance <= 1e-13
    if 0 < angle < 1:
        assert np.linalg.norm(vector) == pytest.approx(angle, rel=1e-14)


@pytest.mark.parametrize("angle", [a for a in ANGLES if a > 1e-150])
def test_series_keep_their_digits(angle):
    mpmath.mp.dps = 700
    x = mpmath.mpf(angle)
    angle2 = np.float64(angle) ** 2
    exact = {
        rot.cosine: mpmath.cos(x),
        rot.sine_ratio: mpmath.sin(x) / x,
        rot.versine_ratio: (1 - mpmath.cos(x)) / x**2,
        rot.remainder_ratio: (x - mpmath.sin(x)) / x**3,
    }
    for function, truth in exact.items():
        for make in (np.array, torch.tensor):
            argument = make(angle2, dtype=np.float64 if make is np.array else torch.float64)
            error = abs(float(function(argument)) - truth)
            # Near a zero of the function only the absolute error can be small: the argument itself is rounded.
            scale = abs(float(truth)) if angle <= 1.01 else 1 / max(1.0, angle2 ** (function is not rot.cosine))
            assert error <= 2e-15 * scale * max(1.0, angle)


@pytest.mark.parametrize("make", [np.array, torch.tensor])
@pytest.mark.parametrize("angle", [1e-12, 1e-8, 1e-4, 0.01, 0.3, 0.99, 1.01, 2.0, 3.0])
def test_series_keep_the_digits_of_single_precision(angle, make):
    mpmath.mp.dps = 50
    single = np.float32 if make is np.array else torch.float32
    angle2 = make(np.float32(angle) ** 2, dtype=single)
    x = mpmath.sqrt(mpmath.mpf(float(angle2)))
    exact = {
        rot.sine_ratio: (mpmath.sin(x) / x, 2e-7),
        rot.versine_ratio: ((1 - mpmath.cos(x)) / x**2, 2e-7),
        rot.remainder_ratio: ((x - mpmath.sin(x)) / x**3, 3e-7),
    }
    for function, (truth, tolerance) in exact.items():
        value = function(angle2)
        assert value.dtype == single
        assert abs(float(value) - truth) <= tolerance * abs(truth)


def test_zero_vector_gives_the_identity_to_the_bit():
    assert rot.rotvecs_to_quats(np.zeros(3)).tolist() == [1.0, 0.0, 0.0, 0.0]
    assert rot.quats_to_rotvecs(np.array([1.0, 0, 0, 0])).tolist() == [0.0, 0.0, 0.0]


def test_gradients_are_finite_and_right_at_zero():
    zero = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(rot.rotvecs_to_quats, (zero,))
    one = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64, requires_grad=True)
    rot.quats_to_rotvecs(one).sum().backward()
    assert torch.isfinite(one.grad).all()
    generic = torch.tensor([0.3, -1.2, 0.4], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(rot.rotvecs_to_quats, (generic,))
    assert torch.autograd.gradcheck(lambda v: rot.quats_to_rotvecs(rot.rotvecs_to_quats(v)), (generic,))
    assert torch.autograd.gradcheck(
        lambda v: rot.rotmats_to_quats(rot.quats_to_rotmats(rot.rotvecs_to_quats(v))), (generic,)
    )


def test_numpy_and_torch_agree_to_rounding():
    rng = np.random.default_rng(2)
    p, q, v = random_quats(50, 3), random_quats(50, 4), rng.normal(size=(50, 3))
    mats = rot.quats_to_rotmats(p)
    calls = [
        (rot.normalize, (3 * p,)),
        (rot.multiply, (p, q)),
        (rot.conjugate, (p,)),
        (rot.rotate, (p, v)),
        (rot.rotvecs_to_quats, (v,)),
        (rot.quats_to_rotvecs, (p,)),
        (rot.quats_to_rotmats, (p,)),
        (rot.rotmats_to_quats, (mats,)),
        (rot.make_continuous, (p,)),
        (rot.angle_between, (p, q)),
        (rot.quat_rates, (p, v)),
        (rot.cross, (v, v[::-1].copy())),
    ]
    for function, arguments in calls:
        ours = function(*arguments)
        theirs = function(*(torch.from_numpy(a) for a in arguments))
        assert isinstance(theirs, torch.Tensor), function.__name__
        np.testing.assert_allclose(ours, theirs.numpy(), atol=1e-14, err_msg=function.__name__)


def test_signs_are_continuous_over_ten_turns():
    angles = np.linspace(0, 20 * np.pi, 181)
    raw = rot.rotmats_to_quats(rot.quats_to_rotmats(rot.rotvecs_to_quats(angles[:, None] * [0.0, 0.6, 0.8])))
    assert ((raw[1:] * raw[:-1]).sum(-1) < 0).any()
    steps = np.abs(np.linalg.norm(np.diff(rot.make_continuous(raw), axis=0), axis=-1))
    assert steps.max() <= 2 * np.sin(np.radians(20) / 4) + 1e-12


@settings(max_examples=30)
@given(st.floats(0, np.pi))
def test_angles_are_exact_near_zero_and_pi(angle):
    q = rot.rotvecs_to_quats(np.array([0.0, angle, 0.0]))
    assert rot.angle_between(np.array([1.0, 0, 0, 0]), q) == pytest.approx(angle, rel=1e-14, abs=1e-150)


def test_rates_are_the_derivative():
    w, q, h = np.array([0.3, -2.0, 1.1]), random_quats(1)[0], 1e-6
    ahead, behind = (rot.multiply(rot.rotvecs_to_quats(s * h * w), q) for s in (1, -1))
    np.testing.assert_allclose((ahead - behind) / (2 * h), rot.quat_rates(q, w), atol=1e-9)


def test_the_zero_quaternion_becomes_the_identity():
    assert rot.normalize(np.zeros(4)).tolist() == [1.0, 0.0, 0.0, 0.0]
