"""Each metric against a second, direct implementation of its formula."""

import importlib.util
import math
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import signal
from scipy.spatial.transform import Rotation

from r5dgs_core.evaluation import metrics


def picture(seed: int, height: int = 23, width: int = 31) -> np.ndarray:
    return np.random.default_rng(seed).random((height, width, 3)).astype(np.float32)


def ssim(image, truth):
    return float(metrics.ssim_map(image, truth).mean())


@given(st.floats(1e-4, 0.5))
def test_psnr_of_a_constant_offset_is_its_logarithm(offset):
    truth = np.full((8, 8, 3), 0.25)
    assert metrics.psnr(truth + offset, truth) == pytest.approx(-20 * math.log10(offset), abs=1e-6)


def test_psnr_of_equal_images_is_finite():
    assert metrics.psnr(picture(0), picture(0)) == 100.0


def test_psnr_counts_only_the_selected_pixels():
    truth, image = np.zeros((4, 4, 3)), np.zeros((4, 4, 3))
    image[:2] = 0.1
    where = np.zeros((4, 4), bool)
    where[0, :2] = True
    assert metrics.psnr(image, truth, where) == pytest.approx(20.0)
    assert metrics.psnr(image, truth) == pytest.approx(20.0 + 10 * math.log10(2))
    assert math.isnan(metrics.psnr(image, truth, np.zeros((4, 4), bool)))


@given(st.lists(st.floats(1e-6, 1.0), min_size=1, max_size=20))
def test_pooled_psnr_is_at_most_the_mean(mses):
    pooled = metrics.psnr_pooled(mses)
    assert pooled <= np.mean([metrics.psnr_of_mse(value) for value in mses]) + 1e-9
    assert pooled == pytest.approx(-10 * math.log10(sum(mses) / len(mses)))


def direct_ssim(x: np.ndarray, y: np.ndarray) -> float:
    """Two-dimensional window, zero padding, one channel after the other."""
    axis = np.arange(11) - 5
    window = np.exp(-(axis[:, None] ** 2 + axis[None, :] ** 2) / (2 * 1.5**2))
    window /= window.sum()
    total = []
    for channel in range(3):
        a, b = x[..., channel].astype(np.float64), y[..., channel].astype(np.float64)
        blurred = [signal.convolve2d(m, window, mode="same") for m in (a, b, a * a, b * b, a * b)]
        ma, mb, aa, bb, ab = blurred
        top = (2 * ma * mb + 0.01**2) * (2 * (ab - ma * mb) + 0.03**2)
        total.append(top / ((ma**2 + mb**2 + 0.01**2) * (aa - ma**2 + bb - mb**2 + 0.03**2)))
    return float(np.mean(total))


@pytest.mark.parametrize(("height", "width"), [(23, 31), (11, 11), (5, 40), (1, 1)])
def test_ssim_is_the_zero_padded_gaussian_one(height, width):
    x, y = picture(1, height, width), picture(2, height, width)
    assert ssim(x, y) == pytest.approx(direct_ssim(x, y), abs=1e-9)


def test_ssim_is_symmetric_and_one_for_equal_images():
    x, y = picture(3), picture(4)
    assert ssim(x, x) == pytest.approx(1.0)
    assert ssim(x, y) == pytest.approx(ssim(y, x))
    assert ssim(x, y) < ssim(x, 0.5 * (x + y))


def test_flip_grows_with_the_difference_where_it_is_installed():
    x, y = picture(5, 32, 32), picture(6, 32, 32)
    if importlib.util.find_spec("flip_evaluator") is None:
        assert metrics.flip(x, y) is None
    else:
        assert metrics.flip(x, x) == pytest.approx(0.0, abs=1e-6)
        assert 0 < metrics.flip(0.9 * x + 0.1 * y, x) < metrics.flip(y, x) <= 1


def test_without_its_package_flip_is_null(monkeypatch):
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    assert metrics.flip(picture(7), picture(8)) is None


def test_images_of_two_sizes_are_refused():
    with pytest.raises(ValueError, match="one size"):
        ssim(picture(0), picture(0, 10, 10))


TRUTH = np.array([[0, 0, 1, 1], [0, 0, 1, 1], [5, 5, 0, 0]])


def test_confusion_counts_every_pixel_once():
    predicted = np.array([[0, -1, 1, 5], [9, 0, 1, 1], [5, 1, 0, 0]])
    counts = metrics.confusion(predicted, TRUTH, [5, 1])
    assert counts.sum() == TRUTH.size
    np.testing.assert_array_equal(counts, [[1, 1, 0], [1, 3, 0], [0, 0, 6]])


def test_a_perfect_id_map_has_miou_one():
    counts = metrics.confusion(TRUTH, TRUTH, [1, 5])
    assert metrics.miou(counts) == metrics.miou_matched(counts) == 1.0


def test_miou_is_the_mean_over_the_true_ids():
    predicted = np.array([[0, 0, 1, 0], [0, 0, 1, 1], [0, 0, 0, 0]])
    assert metrics.miou(metrics.confusion(predicted, TRUTH, [1, 5])) == pytest.approx(0.5 * (3 / 4 + 0))
    assert metrics.miou(metrics.confusion(predicted, TRUTH, [1, 2, 5])) == pytest.approx(0.5 * (3 / 4 + 0))


@given(st.permutations([1, 2, 3, 4]))
def test_renaming_ids_hurts_the_same_id_score_but_not_the_matched_one(names):
    truth = np.repeat(np.arange(5), 6).reshape(5, 6)
    renamed = np.array([0, *names])[truth]
    counts = metrics.confusion(renamed, truth, [1, 2, 3, 4])
    assert metrics.miou_matched(counts) == 1.0
    assert metrics.miou(counts) == np.mean([name == i + 1 for i, name in enumerate(names)])


def test_an_image_without_objects_has_no_miou():
    counts = metrics.confusion(np.zeros((3, 3), int), np.zeros((3, 3), int), [1])
    assert math.isnan(metrics.miou(counts)) and math.isnan(metrics.miou_matched(counts))
    assert metrics.confusion(TRUTH, TRUTH, []).tolist() == [[12]]


@given(st.integers(0, 10_000), st.floats(0, math.pi))
def test_the_angle_between_rotations_is_accurate_everywhere(seed, angle):
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    base = Rotation.random(rng=rng)
    turned = base * Rotation.from_rotvec(angle * axis)
    got = metrics.rotation_angle_deg(base.as_matrix(), turned.as_matrix())
    assert got == pytest.approx(math.degrees(angle), abs=1e-6)


def rigid(rotation: Rotation, translation) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation.as_matrix(), translation
    return matrix


def motion(times: np.ndarray) -> np.ndarray:
    return np.stack([rigid(Rotation.from_rotvec([0, 0.4 * t, 2 * t]), [t, -t * t, 0.5]) for t in times])


def last_error(predicted, truth, observed, center):
    """Distance and angle at the last time."""
    distances, angles = metrics.pose_errors(
        predicted[-1:], metrics.true_motion(predicted, truth, observed, center)[-1:], center
    )
    return distances[0], angles[0]


@given(st.integers(0, 10_000), st.floats(0.1, 5.0), st.floats(0, 100))
def test_a_constant_offset_of_the_object_frame_is_no_pose_error(seed, scale, far):
    rng = np.random.default_rng(seed)
    times = np.linspace(0, 1, 9)
    offset = rigid(Rotation.random(rng=rng), far * rng.normal(size=3))
    truth = motion(times) @ offset @ np.diag([scale, scale, scale, 1.0])
    position, angle = last_error(motion(times), truth, times <= 0.7, rng.normal(size=3))
    assert position == pytest.approx(0, abs=1e-9 * (1 + far))
    assert angle == pytest.approx(0, abs=1e-6)


@given(st.integers(0, 10_000), st.floats(0, 3.0), st.floats(0, 50.0))
def test_an_error_of_the_last_pose_is_measured_as_it_is(seed, degrees, far):
    rng = np.random.default_rng(seed)
    times = np.linspace(0, 1, 9)
    truth = motion(times)
    center = rng.normal(size=3) + far
    predicted = truth.copy()
    axis = np.array([0.0, 0.0, math.radians(degrees)])
    shift = np.array([0.03, 0.0, -0.04])
    moved = (truth[-1] @ np.append(center, 1.0))[:3]
    about = rigid(Rotation.from_rotvec(axis), moved + shift) @ rigid(Rotation.identity(), -moved)
    predicted[-1] = about @ truth[-1]
    position, angle = last_error(predicted, truth, times <= 0.7, center)
    assert position == pytest.approx(0.05, abs=1e-9 * (1 + far))
    assert angle == pytest.approx(degrees, abs=1e-6)


def test_without_an_observed_time_no_offset_can_be_found():
    times = np.linspace(0, 1, 3)
    with pytest.raises(ValueError, match="at least one time"):
        metrics.true_motion(motion(times), motion(times), times > 2, np.zeros(3))
