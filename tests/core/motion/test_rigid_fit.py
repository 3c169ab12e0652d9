import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from r5dgs_core.motion import rigid_fit, rotations

QUAT = rotations.rotvecs_to_quats(np.array([0.4, -1.1, 2.0]))
SHIFT = np.array([0.3, 5.0, -2.0])


def cloud(n=60, seed=0, flatten=(1.0, 1.0, 1.0)):
    return np.random.default_rng(seed).normal(size=(n, 3)) * flatten + [10.0, -3.0, 1.0]


def moved(points):
    return rotations.rotate(QUAT, points) + SHIFT


@given(st.integers(0, 1000))
def test_an_exact_motion_is_recovered(seed):
    rng = np.random.default_rng(seed)
    quat = rotations.normalize(rng.normal(size=4))
    source = rng.normal(size=(5, 3))
    fit = rigid_fit.fit_rigid(source, rotations.rotate(quat, source) + SHIFT)
    assert rotations.angle_between(fit.quat, quat) < 1e-7
    np.testing.assert_allclose(
        fit.displacement_at(np.ones(3)), rotations.rotate(quat, np.ones(3)) + SHIFT - 1, atol=1e-7
    )
    assert fit.residuals.max() < 1e-7


def test_a_plane_is_never_mirrored():
    rng = np.random.default_rng(1)
    source = cloud(flatten=(1, 1, 0))
    errors = []
    for _ in range(30):
        fit = rigid_fit.fit_rigid(source, moved(source) + 0.005 * rng.normal(size=source.shape))
        assert np.linalg.det(rotations.quats_to_rotmats(fit.quat)) == pytest.approx(1)
        assert len(fit.undetermined_axes) == 0
        errors.append(rotations.angle_between(fit.quat, QUAT))
    assert max(errors) < 0.01


def test_a_line_takes_the_rotation_about_itself_from_the_hint():
    source = cloud(flatten=(1, 0, 0))
    target = moved(source)
    fit = rigid_fit.fit_rigid(source, target)
    assert len(fit.undetermined_axes) == 1
    assert abs(fit.undetermined_axes[0] @ [1, 0, 0]) == pytest.approx(1)
    assert fit.residuals.max() < 1e-9
    # Without a hint the turn is the smallest that lays the line right: its axis is normal to the line.
    assert rotations.quats_to_rotvecs(fit.quat) @ [1, 0, 0] == pytest.approx(0, abs=1e-9)
    near = rotations.multiply(QUAT, rotations.rotvecs_to_quats(np.array([0.0, 0.02, 0.0])))
    hinted = rigid_fit.fit_rigid(source, target, hint=near)
    assert rotations.angle_between(hinted.quat, QUAT) < 1e-3


def test_one_point_is_a_translation_with_the_hinted_rotation():
    source = np.array([[1.0, 2, 3]])
    fit = rigid_fit.fit_rigid(source, source + SHIFT)
    np.testing.assert_allclose(fit.displacement, SHIFT)
    assert fit.quat.tolist() == [1, 0, 0, 0]
    assert len(fit.undetermined_axes) == 3
    assert rotations.angle_between(rigid_fit.fit_rigid(source, source + SHIFT, hint=QUAT).quat, QUAT) < 1e-12


def test_a_thin_rod_in_noise_counts_as_a_line():
    rng = np.random.default_rng(2)
    rod = cloud(flatten=(1, 1e-3, 1e-3))
    fit = rigid_fit.fit_rigid(rod, moved(rod) + 0.01 * rng.normal(size=rod.shape))
    assert len(fit.undetermined_axes) == 1
    thick = cloud(flatten=(1, 0.3, 0.3))
    fit = rigid_fit.fit_rigid(thick, moved(thick) + 0.01 * rng.normal(size=rod.shape))
    assert len(fit.undetermined_axes) == 0


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("count", [1, 2, 3, 4, 60])
@pytest.mark.parametrize("flatten", [(1, 1, 1), (1, 1, 0), (1, 0.1, 0.1), (1, 0.01, 0.01), (1, 0, 0), (0, 0, 0)])
def test_no_fit_mirrors_a_cloud_or_is_meaningless(count, flatten):
    rng = np.random.default_rng(count)
    for _ in range(10):
        source = cloud(count, int(rng.integers(1 << 30)), flatten)
        fit = rigid_fit.fit_rigid(source, moved(source) + 0.005 * rng.normal(size=source.shape), hint=QUAT)
        assert np.linalg.det(rotations.quats_to_rotmats(fit.quat)) == pytest.approx(1, abs=1e-12)
        assert np.isfinite(fit.rotation_covariance).all() and np.isfinite(fit.residuals).all()
        np.testing.assert_allclose(fit.displacement_at(fit.center), fit.displacement, atol=1e-12)
        if count == 1 or not any(flatten):
            assert len(fit.undetermined_axes) == 3
            assert rotations.angle_between(fit.quat, QUAT) < 1e-12


def test_two_points_do_not_determine_the_rotation_about_their_line():
    source = np.array([[0.0, 0, 0], [1.0, 0, 0]])
    fit = rigid_fit.fit_rigid(source, moved(source))
    assert len(fit.undetermined_axes) == 1
    assert abs(fit.undetermined_axes[0] @ [1, 0, 0]) == pytest.approx(1)
    ends = rotations.rotate(fit.quat, source - fit.center) + fit.center + fit.displacement
    np.testing.assert_allclose(ends, moved(source), atol=1e-12)


def test_three_points_of_a_triangle_fix_the_rotation():
    source = np.array([[0.0, 0, 0], [1.0, 0, 0], [0.3, 0.8, 0]])
    fit = rigid_fit.fit_rigid(source, moved(source))
    assert len(fit.undetermined_axes) == 0
    assert rotations.angle_between(fit.quat, QUAT) < 1e-12


@pytest.mark.parametrize("thickness", [0.0, 0.1])
def test_covariance_of_planes_and_rods_predicts_the_spread(thickness):
    rng = np.random.default_rng(6)
    source = cloud(100, flatten=(1, 1, 0) if thickness == 0 else (1, thickness, thickness))
    source = 0.3 * (source - source.mean(0))
    errors, predicted = [], []
    for _ in range(300):
        fit = rigid_fit.fit_rigid(source, moved(source) + 0.005 * rng.normal(size=source.shape), rounds=0)
        assert len(fit.undetermined_axes) == 0
        errors.append(rotations.quats_to_rotvecs(rotations.multiply(rotations.conjugate(QUAT), fit.quat)))
        predicted.append(fit.rotation_covariance)
    measured = np.sqrt(np.diag(np.cov(np.array(errors).T)))
    np.testing.assert_allclose(np.sqrt(np.diag(np.mean(predicted, axis=0))), measured, rtol=0.2)


@pytest.mark.parametrize(("degrees", "told"), [(20, False), (119, False), (121, True), (160, True), (200, True)])
def test_ambiguous_rotation_steps_are_reported(degrees, told):
    times = np.array([0.0, 0.1, 0.3, 0.4])
    angles = np.radians([0.0, 5.0, 5.0 + degrees, 9.0 + degrees])
    quats = rotations.rotvecs_to_quats(angles[:, None] * [0.0, 0.6, 0.8]) * [[1], [-1], [1], [1]]
    found = rigid_fit.aliased_step(times, quats)
    assert (found is not None) == told
    if found is not None:
        assert found == pytest.approx((np.radians(min(degrees, 360 - degrees)), 0.1, 0.3))
    assert rigid_fit.aliased_step(times[:1], quats[:1]) is None


def test_opposite_points_give_a_half_turn_about_a_normal():
    quat = rotations.between_vectors(np.array([0, 0, 1.0]), np.array([0, 0, -1.0]))
    np.testing.assert_allclose(rotations.rotate(quat, np.array([0, 0, 1.0])), [0, 0, -1], atol=1e-12)


def test_a_third_of_outliers_does_not_move_the_fit():
    rng = np.random.default_rng(3)
    source = cloud(90)
    target = moved(source) + 0.002 * rng.normal(size=source.shape)
    target[:30] += rng.normal(size=(30, 3))
    plain = rigid_fit.fit_rigid(source, target, rounds=0)
    robust = rigid_fit.fit_rigid(source, target)
    assert rotations.angle_between(robust.quat, QUAT) < 2e-3
    assert rotations.angle_between(plain.quat, QUAT) > 5 * rotations.angle_between(robust.quat, QUAT)
    assert np.linalg.norm(robust.displacement_at(robust.center) - robust.displacement) < 1e-12


def test_points_with_zero_weight_are_ignored():
    source = cloud(10)
    target = moved(source)
    target[0] += 100
    fit = rigid_fit.fit_rigid(source, target, weights=np.r_[0.0, np.ones(9)], rounds=0)
    assert rotations.angle_between(fit.quat, QUAT) < 1e-7


def test_rotation_covariance_predicts_the_spread():
    rng = np.random.default_rng(4)
    source = cloud(40, flatten=(1, 0.5, 0.2))
    errors, covariances = [], []
    for _ in range(400):
        fit = rigid_fit.fit_rigid(source, moved(source) + 0.01 * rng.normal(size=source.shape), rounds=0)
        errors.append(rotations.quats_to_rotvecs(rotations.multiply(rotations.conjugate(QUAT), fit.quat)))
        covariances.append(fit.rotation_covariance)
    measured = np.sqrt(np.diag(np.cov(np.array(errors).T)))
    np.testing.assert_allclose(np.sqrt(np.diag(np.mean(covariances, axis=0))), measured, rtol=0.2)


@pytest.mark.parametrize(
    ("source", "target", "weights"),
    [
        (np.zeros((0, 3)), np.zeros((0, 3)), None),
        (np.zeros((2, 3)), np.zeros((3, 3)), None),
        (np.zeros((2, 3)), np.full((2, 3), np.nan), None),
        (np.zeros((2, 3)), np.zeros((2, 3)), np.zeros(2)),
        (np.zeros((2, 3)), np.zeros((2, 3)), np.array([-1.0, 2.0])),
    ],
)
def test_unusable_points_are_refused(source, target, weights):
    with pytest.raises(ValueError, match="expected"):
        rigid_fit.fit_rigid(source, target, weights)
