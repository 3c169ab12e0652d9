import dataclasses
import math

import numpy as np
import pytest

from r5dgs_core.motion import cubic_curves, key_reduction, models, rotations, se3
from r5dgs_core.motion.models import MotionModel
from tests.support.problems import MOTIONS, RADIUS, SIZE

TOLERANCE = 1e-3 * SIZE
# Scalar keys over [0, 2] at 0.1 % of the size. One cubic holds an arc of radius u for about (384 tol / (2 u))^(1/4)
# rad, so the hinge, which turns by 4 rad and by 7 when it accelerates, needs 6 and 11 intervals in location.
MAX_KEYS = {
    "static": 7,
    "uniform": 10,
    "ballistic": 10,
    "ballistic, spinning": 24,
    "spin": 20,
    "hinge": 34,
    "hinge, accelerating": 70,
    "rolling": 26,
    "rolling, slowing": 36,
    "spin, accelerating": 32,
}
HARD = MotionModel(
    "world_twist",
    velocity=[1, 0, 0.5],
    acceleration=[0, 0.5, 0],
    angular_velocity=[1, 0, 2],
    angular_acceleration=[0, 1.5, 0],
    offset_rotvec=[0.03, 0, 0.02],
    offset_displacement=[0.01, 0.02, 0],
    radius=RADIUS,
)
CASES = {name: model for name, (model, _) in MOTIONS.items()} | {"hard": HARD}


def reduced(model, tolerance=TOLERANCE, t1=2.0, **options):
    return key_reduction.reduce(key_reduction.model_sampler(model, 0.0), 0.0, t1, tolerance, RADIUS, **options)


def largest_error(curves, model, times):
    quats, displacements = models.evaluate(model, times)
    shift = np.linalg.norm(cubic_curves.evaluate(curves.location, times) - displacements, axis=-1)
    angle = rotations.angle_between(cubic_curves.evaluate(curves.rotation, times, unit=True), quats)
    return float((shift + 2 * RADIUS * np.sin(0.5 * angle)).max())


@pytest.mark.parametrize("tolerance", [TOLERANCE, 1e-5 * SIZE])
@pytest.mark.parametrize("name", CASES)
def test_no_point_leaves_the_tolerance_between_keys(name, tolerance):
    curves = reduced(CASES[name], tolerance)
    assert largest_error(curves, CASES[name], np.linspace(0, 2, 1931)) <= 1.001 * tolerance


@pytest.mark.parametrize("name", MAX_KEYS)
def test_few_keys_suffice(name):
    curves = reduced(CASES[name])
    assert 3 * len(curves.location.times) + 4 * len(curves.rotation.times) <= MAX_KEYS[name]


def test_constant_curves_have_one_key():
    curves = reduced(MOTIONS["spin"][0])
    assert len(curves.location.times) == 1
    assert len(curves.rotation.times) > 1
    curves = reduced(MOTIONS["ballistic"][0])
    assert len(curves.location.times) == 2
    assert len(curves.rotation.times) == 1
    assert len(reduced(MotionModel(), kinks=(0.5, 1.0)).location.times) == 1


def test_keys_lie_on_the_motion_and_ends_are_exact():
    curves = reduced(HARD)
    quats, _ = models.evaluate(HARD, curves.rotation.times)
    _, displacements = models.evaluate(HARD, curves.location.times)
    assert rotations.angle_between(curves.rotation.values, quats).max() < 1e-12
    np.testing.assert_array_equal(curves.location.values, displacements)
    assert curves.location.times[[0, -1]].tolist() == [0, 2]
    assert curves.location.values[0].tolist() == [0, 0, 0]
    assert curves.rotation.values[0].tolist() == [1, 0, 0, 0]


def test_fast_spins_never_step_over_120_degrees():
    model = MotionModel("ballistic_spin", angular_velocity=[0, 5, 40.0])
    curves = reduced(model, 0.5 * SIZE)
    values = curves.rotation.values
    assert ((values[1:] * values[:-1]).sum(-1) >= math.cos(math.radians(60)) - 1e-12).all()
    assert largest_error(curves, model, np.linspace(0, 2, 3001)) <= 0.5 * SIZE


FAST = MotionModel("ballistic_spin", angular_velocity=[0, 100, 900.0], center_offset=[0.2, 0, 0], radius=RADIUS)
CALM = MotionModel(  # flies straight once its offsets are blended in
    "translation", velocity=[1, 0, 0], offset_displacement=[3, 2, 1], fade_time=0.02, radius=RADIUS
)


@pytest.mark.default_cases("calm-5.9999999999999995e-12")
@pytest.mark.parametrize("name, tolerance", [("fast", 1e-4 * SIZE), ("calm", 1e-11 * SIZE)])
def test_thousands_of_keys_are_as_good_as_few_and_hardly_more_than_one_after_another(name, tolerance, monkeypatch):
    model = {"fast": FAST, "calm": CALM}[name]
    curves = reduced(model, tolerance)
    assert largest_error(curves, model, np.linspace(0, 2, 40_001)) <= 1.001 * tolerance
    monkeypatch.setattr(key_reduction, "_ONE_BY_ONE", 1 << 30)
    serial = reduced(model, tolerance)
    assert len(serial.location.times) > 500
    for striped, one_by_one in ((curves.location, serial.location), (curves.rotation, serial.rotation)):
        assert (np.diff(striped.times) > 0).all() and striped.times[[0, -1]].tolist() == one_by_one.times[
            [0, -1]
        ].tolist()
        assert len(one_by_one.times) <= len(striped.times) <= 1.1 * len(one_by_one.times)


@pytest.mark.parametrize("t1", [2.0, 0.05, 0.004])
def test_keys_are_never_nearer_than_is_allowed(t1):
    curves = reduced(FAST, 1e-6 * SIZE, t1, nearest=0.01)
    for keys in (curves.location, curves.rotation):
        assert (np.diff(keys.times) >= min(0.01, t1) - 1e-12).all()
        assert len(keys.times) >= min(t1 / 0.02, 2)
    quats, displacements = models.evaluate(FAST, curves.location.times)
    np.testing.assert_array_equal(curves.location.values, displacements)


BOUNCE = MotionModel(
    "bounce",
    velocity=[0.5, 0.1, 0.6],
    acceleration=[0, 0, -9],
    angular_velocity=[1, 2, 0.5],
    bounce_time=0.2,
    restitution=0.7,
    offset_rotvec=[0.03, 0, 0.02],
    offset_displacement=[0.01, 0.02, 0],
    radius=RADIUS,
)


@pytest.mark.parametrize("restitution", [0.0, 0.3, 0.7, 0.95, 1.0])
@pytest.mark.parametrize("tolerance", [TOLERANCE, 1e-5 * SIZE])
def test_bounces_keep_their_velocity_jumps(restitution, tolerance):
    model = dataclasses.replace(BOUNCE, restitution=restitution)
    kinks = models.kinks(model, 2.0)
    frames = key_reduction.FrameTimes(0.0, 1 / 60)
    curves = reduced(model, tolerance, kinks=kinks.tolist(), nearest=0.011 / 60, frames=frames)
    beside = (kinks + np.array([[-1e-4], [-1e-7], [0], [1e-7], [1e-4]])).ravel()
    times = np.concatenate([np.linspace(0, 2, 2311), np.clip(beside, 0, 2)])
    assert curves.followed and largest_error(curves, model, times) <= 1.001 * tolerance
    first = int(np.argmin(np.abs(curves.location.times - 0.2)))
    assert curves.location.times[first] == 0.2
    before, after = curves.location.left_slopes[first, 2], curves.location.right_slopes[first, 2]
    offset = model.offset_displacement[2] * np.exp(-0.2 / model.fade_time) / model.fade_time
    np.testing.assert_allclose([before - offset, after - offset], [-1.2, 1.2 * restitution], atol=1e-4)


def test_kinks_are_where_a_motion_is_not_smooth():
    fall = 2 * 1.2 / 9
    impacts = 0.2 + fall * np.array([0, 0.7, 0.7 + 0.49, 0.7 + 0.49 + 0.343])
    np.testing.assert_allclose(models.kinks(BOUNCE, 0.65), impacts)
    assert models.kinks(BOUNCE, 0.15).tolist() == []
    resting = models.kinks(BOUNCE, 100.0)[-1]
    _, _, _, velocities = models.evaluate_with_rates(BOUNCE, np.array([resting + 1e-6, resting + 1]))
    np.testing.assert_allclose(velocities[:, 2], 0, atol=1e-2)
    assert models.kinks(dataclasses.replace(BOUNCE, acceleration=np.zeros(3)), 9.0).tolist() == []
    assert models.kinks(dataclasses.replace(BOUNCE, velocity=[0, 0, 9.0]), 9.0).tolist() == []  # away from the floor
    assert models.kinks(MotionModel("friction", velocity=[1, 0, 0], stop_time=0.4), 1.0).tolist() == [0.4]
    assert models.kinks(MotionModel("friction", velocity=[1, 0, 0]), 1.0).tolist() == []
    assert models.kinks(HARD, 9.0).tolist() == []


def test_endless_bounces_stay_above_the_floor():
    model = dataclasses.replace(BOUNCE, velocity=[0, 0, 0.009], bounce_time=0.002, restitution=1.0)
    _, d = models.evaluate(model, np.linspace(0.002, 1.9, 5000))
    assert (d[:, 2] > -1e-2).all()


def test_more_kinks_than_can_be_keyed_give_keys_at_frames():
    model = dataclasses.replace(
        BOUNCE, velocity=[0.5, 0, 0], acceleration=[0, 0, -60], bounce_time=0.05, restitution=1.0
    )
    kinks = models.kinks(model, 2.0).tolist()
    frames = key_reduction.FrameTimes(0.0, 1 / 60)
    few = key_reduction.MIN_INTERVALS
    options = {"nearest": 0.011 / 60, "frames": frames, "most": few}
    assert len(kinks) > key_reduction.MIN_KINKS
    curves = reduced(model, 1e-5 * SIZE, kinks=kinks, **options)
    assert not curves.followed
    for kink in kinks[: key_reduction.MIN_KINKS]:
        assert kink in curves.location.times


def test_a_rest_between_two_motions_is_held():
    moving = MotionModel("translation", velocity=[1, 0, 0])
    pieces = [moving, MotionModel("translation"), moving]
    curves, start = None, 0.0
    for k, piece in enumerate(pieces):

        def sample(times, k=k, piece=piece, start=start):
            quats, d, rates, slopes = key_reduction.model_sampler(piece, float(k))(times)
            return quats, d + [start, 0, 0], rates, slopes

        found = key_reduction.reduce(sample, k, k + 1, TOLERANCE, RADIUS)
        curves = found if curves is None else cubic_curves.join(curves, found)
        start += float(piece.velocity[0])
    places = cubic_curves.evaluate(curves.location, np.array([0.5, 1.0, 1.3, 1.7, 2.0, 2.5]))
    np.testing.assert_allclose(places[:, 0], [0.5, 1, 1, 1, 1, 1.5], atol=1e-12)


def test_joined_curves_keep_the_kink_and_both_sides():
    before, after = MotionModel("translation", velocity=[1, 0, 0]), MotionModel("translation", velocity=[0, 2, 0])

    def first(times):
        quats, d, rates, slopes = key_reduction.model_sampler(before, 0.0)(times)
        return quats, d - 1.0 * np.array([1, 0, 0]), rates, slopes

    left = key_reduction.reduce(first, 0.0, 1.0, TOLERANCE, RADIUS)
    right = key_reduction.reduce(key_reduction.model_sampler(after, 1.0), 1.0, 2.0, TOLERANCE, RADIUS)
    joined = cubic_curves.join(left, right)
    assert joined.location.times.tolist() == [0, 1, 2]
    np.testing.assert_allclose(joined.location.left_slopes[1], [1, 0, 0])
    np.testing.assert_allclose(joined.location.right_slopes[1], [0, 2, 0])
    np.testing.assert_allclose(cubic_curves.evaluate(joined.location, np.array([0.5, 1.5])), [[-0.5, 0, 0], [0, 1, 0]])
    assert cubic_curves.evaluate(joined.location, np.array([-1.0, 9.0])).tolist() == [[-1, 0, 0], [0, 2, 0]]


def test_joined_curves_stay_at_rest_until_the_join():
    moving = MotionModel("ballistic_spin", velocity=[1, 0, 0], angular_velocity=[0, 0, 2.0])
    rest = key_reduction.reduce(key_reduction.model_sampler(models.STATIC, 0.0), 0.0, 1.0, TOLERANCE, RADIUS)
    joined = cubic_curves.join(
        rest, key_reduction.reduce(key_reduction.model_sampler(moving, 1.0), 1.0, 2.0, TOLERANCE, RADIUS)
    )
    times = np.linspace(0, 1, 31)
    assert (cubic_curves.evaluate(joined.location, times) == 0).all()
    assert (cubic_curves.evaluate(joined.rotation, times, unit=True) == [1, 0, 0, 0]).all()
    later = cubic_curves.Curves(
        *(dataclasses.replace(k, times=k.times - 1) for k in (joined.location, joined.rotation))
    )
    assert largest_error(later, moving, np.linspace(0, 1, 301)) <= TOLERANCE


def test_rest_joined_to_rest_is_one_key():
    first, second = (
        key_reduction.reduce(key_reduction.model_sampler(models.STATIC, 0.0), t, t + 1, TOLERANCE, RADIUS)
        for t in (0.0, 1.0)
    )
    joined = cubic_curves.join(first, second)
    assert joined.location.times.tolist() == joined.rotation.times.tolist() == [0.0]


def test_joining_keeps_quaternion_signs_continuous():
    model = MotionModel("ballistic_spin", angular_velocity=[0, 0, 3.0])
    left = reduced(model, t1=1.0)

    def later(times):
        quats, d, rates, slopes = key_reduction.model_sampler(model, 0.0)(times)
        return -quats, d, -rates, slopes

    joined = cubic_curves.join(left, key_reduction.reduce(later, 1.0, 2.0, TOLERANCE, RADIUS))
    assert (np.diff(joined.rotation.times) > 0).all()
    assert largest_error(joined, model, np.linspace(0, 2, 901)) <= TOLERANCE


def test_flipping_signs_of_samples_changes_nothing():
    model = MOTIONS["ballistic, spinning"][0]

    def flipped(times):
        quats, d, rates, slopes = key_reduction.model_sampler(model, 0.0)(times)
        signs = np.where(np.arange(len(times)) % 3 == 1, -1.0, 1.0)[:, None]
        return quats * signs, d, rates * signs, slopes

    curves = key_reduction.reduce(flipped, 0.0, 2.0, TOLERANCE, RADIUS)
    assert largest_error(curves, model, np.linspace(0, 2, 901)) <= TOLERANCE


def test_equal_input_gives_equal_keys():
    first, second = reduced(HARD), reduced(HARD)
    np.testing.assert_array_equal(first.rotation.values, second.rotation.values)
    np.testing.assert_array_equal(first.rotation.times, second.rotation.times)


def test_unusable_arguments_are_refused():
    sampler = key_reduction.model_sampler(HARD, 0.0)
    with pytest.raises(ValueError, match="t0"):
        key_reduction.reduce(sampler, 1.0, 1.0, 1e-3, 1.0)
    with pytest.raises(ValueError, match="tolerance"):
        key_reduction.reduce(sampler, 0.0, 1.0, 0.0, 1.0)


FRAME = 1 / 60
WILD = {
    "twist that tilts": MotionModel(
        "world_twist", velocity=[1, 0, 0], angular_velocity=[1e4, 0, 2], angular_acceleration=[0, 1.5, 0], radius=RADIUS
    ),
    "far orbit": MotionModel(
        "world_twist", velocity=[1e25, 0, 0], angular_velocity=[1, 0, 2], angular_acceleration=[0, 9, 0], radius=1e-6
    ),
    "spin of all numbers": MotionModel("ballistic_spin", angular_velocity=[0, 1e300, 0], center_offset=[1, 0, 0]),
    "top": MotionModel("free_top", angular_velocity=[1e5, 3e4, 0], inertia=np.diag([0.4, 0.8, 1.0])),
    "swing": MotionModel("translation", velocity=[1e3, 0, 0], frequency=1e6),
    "jump": MotionModel("translation", offset_displacement=[1, 0, 0], fade_time=1e-300),
}


def work(monkeypatch, model, span, frame, most=key_reduction.MAX_INTERVALS):
    """Keys of a motion over a span, the times that were sampled for them, and the steps of integration."""
    counts = {"times": 0, "steps": 0}
    sampler, exp = key_reduction.model_sampler(model, 0.0, most), se3.exp

    def counted(times):
        counts["times"] += len(times)
        return sampler(times)

    def counted_exp(w, v):
        counts["steps"] += math.prod(w.shape[:-1])
        return exp(w, v)

    monkeypatch.setattr(se3, "exp", counted_exp)
    frames = key_reduction.FrameTimes(0.0, frame)
    curves = key_reduction.reduce(counted, 0.0, span, 1e-6, RADIUS, nearest=0.01 * frame, frames=frames, most=most)
    monkeypatch.setattr(se3, "exp", exp)
    return curves, counts


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("frames", [1, 100, 10_000])
@pytest.mark.parametrize("name", WILD)
def test_the_work_for_keys_is_bounded_by_the_number_of_frames(monkeypatch, name, frames):
    _, counts = work(monkeypatch, WILD[name], frames * FRAME, FRAME, most=1024)
    assert counts["times"] <= 40 * max(64, min(frames, 1024))
    assert counts["steps"] <= 8 * 16 * 1024


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("frame", [1e-6, 1e-3, 1e3, 1e6])
def test_the_work_for_keys_is_bounded_whatever_the_pace_of_frames(monkeypatch, frame):
    for model in WILD.values():
        curves, counts = work(monkeypatch, model, 3.0, frame, most=512)
        assert counts["times"] <= 40 * 512
        assert max(len(curves.location.times), len(curves.rotation.times)) <= 514


def test_motion_too_fast_for_keys_is_exact_at_every_frame_and_marked(monkeypatch):
    for name in ("twist that tilts", "top", "swing"):
        curves, _ = work(monkeypatch, WILD[name], 20.5 * FRAME, FRAME)
        assert not curves.followed
        quats, displacements = models.evaluate(WILD[name], FRAME * np.arange(21))
        at = FRAME * np.arange(21)
        shift = np.abs(cubic_curves.evaluate(curves.location, at) - displacements).max()
        turn = rotations.angle_between(cubic_curves.evaluate(curves.rotation, at, unit=True), quats).max()
        assert shift <= 1e-6 and turn <= 1e-6
        assert max(curves.location.times[-1], curves.rotation.times[-1]) == 20.5 * FRAME


def test_more_frames_than_keys_are_keyed_at_whole_frames_evenly(monkeypatch):
    curves, _ = work(monkeypatch, WILD["swing"], 1000 * FRAME, FRAME, most=300)
    steps = np.diff(curves.location.times)[:-1] / FRAME
    np.testing.assert_allclose(steps, steps.round(), atol=1e-6)
    assert len(curves.location.times) <= 302 and steps.max() == pytest.approx(4)


def test_a_motion_that_keys_follow_does_not_depend_on_the_frames(monkeypatch):
    curves, _ = work(monkeypatch, HARD, 2.0, FRAME)
    assert curves.followed
    assert largest_error(curves, HARD, np.linspace(0, 2, 901)) <= 1.01e-6


def test_shared_steps_give_the_poses_of_separate_ones():
    taus = np.concatenate([np.linspace(0, 1, 40), [0.3, 0.77]])
    fast = dataclasses.replace(HARD, angular_velocity=[300.0, 0, 2], offset_rotvec=[0, 0, 0])
    few = models.evaluate_with_rates(fast, taus, 1 << 14)
    assert models.steps_needed(fast, taus).sum() > 1 << 14
    for shared, own in zip(few, models.evaluate_with_rates(fast, taus), strict=True):
        np.testing.assert_allclose(shared, own, atol=1e-7 * np.abs(own).max())
