import dataclasses

import numpy as np
import pytest

from r5dgs_core.motion import models, rotations
from r5dgs_core.motion.pose_track import PoseTrack
from r5dgs_core.motion_fit import breaks, candidates, model_scores, model_selection
from tests.support import problems
from tests.support.problems import MOTIONS, RADIUS, SIZE, T_MAX

pytestmark = pytest.mark.heavy

TIMES = np.linspace(0, T_MAX, 15)
UNEVEN = np.sort(np.r_[0.0, T_MAX, np.random.default_rng(9).uniform(0, T_MAX, 13)])
UP = np.array([0.0, 0.0, 1.0])
HORIZON = np.array([0.25, 1.25])  # t = 1 and t = 2
FITTED = [name for name, (model, _) in MOTIONS.items() if models.KINDS[model.kind].fits_by_default]


def fitted(name, rng, sigma_t=0.0, sigma_r=0.0, times=TIMES, **options):
    truth, _ = MOTIONS[name]
    quats, displacements, last_quat, last = problems.observe(truth, times, rng, sigma_t, sigma_r)
    fit = model_selection.fit(times, quats, displacements, radius=RADIUS, **options)
    return fit, problems.error_percent(fit.model, truth, HORIZON, last_quat, last)


TYPICAL = (
    "static",
    "ballistic, spinning",
    "hinge, accelerating",
    "rolling",
    "screw",
    "pendulum",
    "damped spring",
    "fall with drag",
    "rolling friction",
    "precession",
    "two oscillations",
)
FIRST_OF_KIND = {model.kind: name for name, (model, _) in reversed(MOTIONS.items())}
OF_OTHER_KINDS = [name for kind, name in FIRST_OF_KIND.items() if kind not in {MOTIONS[n][0].kind for n in TYPICAL}]


@pytest.mark.default_cases(*TYPICAL, *OF_OTHER_KINDS)
@pytest.mark.parametrize("name", MOTIONS)
def test_each_motion_is_recovered_without_noise(name):
    _, names = MOTIONS[name]
    family = None if name in FITTED else [*(law.name for law in candidates.FAMILY), *names]
    fit, error = fitted(name, np.random.default_rng(0), 1e-7 * SIZE, 1e-7, candidates=family)
    assert fit.chosen in names
    assert error.max() < 0.1
    assert not fit.rested


@pytest.mark.parametrize("name", candidates.BY_NAME)
@pytest.mark.parametrize("motion", ["pendulum", "two oscillations"])
def test_the_first_guesses_of_each_candidate_have_values_of_all_its_blocks(name, motion):
    quats, d, _, _ = problems.observe(MOTIONS[motion][0], TIMES, np.random.default_rng(6))
    track = PoseTrack(TIMES - T_MAX, quats, d, np.ones(len(TIMES)))
    law = dataclasses.replace(candidates.BY_NAME[name], window=track.window)
    for theta in law.starts(track):
        assert theta.shape == (law.parameters,)


def test_a_block_without_a_first_guess_is_named():
    with pytest.raises(ValueError, match="candidate 'spin': .*no value for the block 'w'"):
        candidates.BY_NAME["spin"].pack({"r": np.zeros(3), "e": np.zeros(3)})


@pytest.mark.default_cases("hinge")
@pytest.mark.parametrize("name", ["uniform", "hinge", "ballistic, spinning"])
def test_uneven_times_and_gaps_are_supported(name):
    times = np.concatenate([UNEVEN[UNEVEN < 0.3], UNEVEN[UNEVEN > 0.45]])
    fit, error = fitted(name, np.random.default_rng(1), 1e-6 * SIZE, 1e-6, times)
    assert fit.chosen in MOTIONS[name][1]
    assert error.max() < 0.1


@pytest.mark.slow
def test_the_right_family_is_chosen_in_noise_and_beats_the_largest():
    rng = np.random.default_rng(2)
    right, ours, full = 0, [], []
    chosen = [MOTIONS[name] for name in FITTED[::3]]
    for truth, names in chosen:
        quats, d, last_quat, last = problems.observe(truth, TIMES, rng, 0.005 * SIZE, np.radians(1) / 3**0.5)
        fit = model_selection.fit(TIMES, quats, d, radius=RADIUS)
        largest = model_selection.fit(TIMES, quats, d, radius=RADIUS, candidates=["full, free centre"])
        right += fit.chosen in names
        ours.append(problems.error_percent(fit.model, truth, HORIZON[:1], last_quat, last)[0])
        full.append(problems.error_percent(largest.model, truth, HORIZON[:1], last_quat, last)[0])
    assert right >= 0.85 * len(chosen)
    assert np.median(ours) < 0.6 * np.median(full)


@pytest.mark.slow
def test_at_low_noise_the_choice_is_never_clearly_worse_than_the_largest():
    rng = np.random.default_rng(3)
    for name in ("static", "rolling, slowing", "hinge, accelerating", "free axis", "screw"):
        errors = []
        for _ in range(2):
            truth = MOTIONS[name][0]
            quats, d, last_quat, last = problems.observe(truth, TIMES, rng, 1e-3 * SIZE, np.radians(0.1))
            errors.append(
                [
                    problems.error_percent(
                        model_selection.fit(TIMES, quats, d, radius=RADIUS, candidates=names).model,
                        truth,
                        HORIZON[:1],
                        last_quat,
                        last,
                    )[0]
                    for names in (None, ["full, free centre"])
                ]
            )
        ours, full = np.median(errors, axis=0)
        assert ours <= max(1.3 * full, 0.3), name


def observe_tumbling(rng, sigma_t, sigma_r):
    """Poses of a tumbling box, its last true pose, and its inertia in the bind state, computed from its surface."""
    truth = problems.TUMBLING
    quats, d, last_quat, last = problems.observe(truth, TIMES, rng, sigma_t, sigma_r)
    back = rotations.quats_to_rotmats(rotations.conjugate(last_quat))
    return quats, d, last_quat, last, back.T @ truth.inertia @ back


def test_a_tumbling_box_is_predicted_by_its_inertia():
    quats, d, last_quat, last, inertia = observe_tumbling(
        np.random.default_rng(20), 0.005 * SIZE, np.radians(1) / 3**0.5
    )
    errors = []
    for body in (inertia, None):
        fit = model_selection.fit(TIMES, quats, d, radius=RADIUS, inertia=body)
        assert (fit.chosen == "free top") == (body is not None)
        errors.append(problems.error_percent(fit.model, problems.TUMBLING, HORIZON, last_quat, last)[1])
    assert errors[0] < 0.5 * errors[1]


def test_a_tumbling_box_is_recovered_without_noise():
    quats, d, last_quat, last, inertia = observe_tumbling(np.random.default_rng(21), 1e-7 * SIZE, 1e-7)
    fit = model_selection.fit(TIMES, quats, d, radius=RADIUS, inertia=inertia)
    assert fit.chosen == "free top"
    assert problems.error_percent(fit.model, problems.TUMBLING, HORIZON, last_quat, last).max() < 0.1
    assert np.isfinite(fit.history.band.half_width).all()


@pytest.mark.slow
def test_the_inertia_changes_nothing_for_bodies_that_do_not_tumble():
    box = np.diag([0.4, 0.8, 1.0])
    rng = np.random.default_rng(22)
    for name in ("static", "spin", "rolling, slowing"):
        quats, d, _, _ = problems.observe(MOTIONS[name][0], TIMES, rng, 0.003 * SIZE, 0.01)
        plain = model_selection.fit(TIMES, quats, d, radius=RADIUS)
        assert model_selection.fit(TIMES, quats, d, radius=RADIUS, inertia=box).model == plain.model
    quats, d, _, _, _ = observe_tumbling(rng, 0.003 * SIZE, 0.01)
    cube = model_selection.fit(TIMES, quats, d, radius=RADIUS, inertia=np.eye(3))
    assert cube.chosen != "free top"


def test_one_gross_outlier_has_little_effect():
    rng = np.random.default_rng(4)
    truth = MOTIONS["ballistic, spinning"][0]
    quats, d, last_quat, last = problems.observe(truth, TIMES, rng, 0.005 * SIZE, np.radians(0.5))
    spoiled_quats, spoiled = quats.copy(), d.copy()
    spoiled[6] += [0.5, -0.4, 0.3]
    spoiled_quats[6] = rotations.multiply(rotations.rotvecs_to_quats(np.array([0, 1.5, 0])), quats[6])
    clean, dirty = (
        problems.error_percent(
            model_selection.fit(TIMES, q, x, radius=RADIUS).model, truth, HORIZON[:1], last_quat, last
        )[0]
        for q, x in ((quats, d), (spoiled_quats, spoiled))
    )
    assert dirty <= max(1.3 * clean, 2.5)


def test_weight_zero_leaves_a_pose_out():
    rng = np.random.default_rng(5)
    truth = MOTIONS["uniform"][0]
    quats, d, last_quat, last = problems.observe(truth, TIMES, rng, 1e-6, 1e-6)
    d[:4] += 3.0
    weights = np.r_[np.zeros(4), np.ones(len(TIMES) - 4)]
    fit = model_selection.fit(TIMES, quats, d, radius=RADIUS, weights=weights)
    assert fit.chosen == "translation"
    assert problems.error_percent(fit.model, truth, HORIZON, last_quat, last).max() < 0.1


@pytest.mark.slow
def test_a_stop_is_found_and_slow_movers_keep_moving():
    rng = np.random.default_rng(6)
    stopped = []
    for _ in range(2):
        path = np.minimum(TIMES, 0.42)[:, None] * [0.8, 0.1, 0] + 0.003 * rng.normal(size=(15, 3))
        turns = rotations.rotvecs_to_quats(
            np.minimum(TIMES, 0.42)[:, None] * [0, 0, 2.0] + 0.01 * rng.normal(size=(15, 3))
        )
        quats = rotations.multiply(turns, rotations.conjugate(turns[-1]))
        fit = model_selection.fit(TIMES, quats, path - path[-1], radius=RADIUS)
        stopped.append(fit.chosen == "static" and fit.rested)
    assert all(stopped)
    slow = models.MotionModel("translation", velocity=[0.1 * SIZE, 0, 0])
    frozen = []
    for _ in range(2):
        quats, d, _, _ = problems.observe(slow, TIMES, rng, 0.005 * SIZE, np.radians(1) / 3**0.5)
        frozen.append(model_selection.fit(TIMES, quats, d, radius=RADIUS).chosen == "static")
    assert not all(frozen)


def test_a_body_that_brakes_and_stands_in_its_last_three_poses_stays():
    rng = np.random.default_rng(11)
    for _ in range(2):
        left = np.maximum(TIMES[-3] - TIMES, 0.0)[:, None]
        path = -3.0 * left**2 * [1.0, 0.2, 0.0] + 0.001 * SIZE * rng.normal(size=(15, 3))
        fit = model_selection.fit(TIMES, rotations.identity(15), path - path[-1], radius=RADIUS)
        assert fit.rested
        _, displacements = models.evaluate(fit.model, np.array([0.25, 1.0]))
        assert np.abs(displacements).max() < 0.01 * SIZE


@pytest.mark.default_cases("2.0")
@pytest.mark.parametrize("acceleration", [0.5, 2.0, 8.0])
def test_the_apex_of_a_throw_is_not_a_stop(acceleration):
    rng = np.random.default_rng(12)
    for noise in (0.0, 0.002, 0.01):
        path = -0.5 * acceleration * (TIMES[-1] - TIMES)[:, None] ** 2 * [0.0, 0.0, 1.0]
        path = path + noise * SIZE * rng.normal(size=(15, 3))
        fit = model_selection.fit(TIMES, rotations.identity(15), path - path[-1], radius=RADIUS, up=UP)
        assert not fit.rested
        assert fit.chosen == "translation, quadratic"


def swing(phase_per_window, start=0.4):
    """A pendulum that goes through so many radians of its phase in the window, from the phase `start`."""
    frequency = phase_per_window / T_MAX
    phase = start + phase_per_window  # at t_max
    return models.MotionModel(
        "ballistic_spin",
        angular_velocity=[0, 0.35 * frequency * np.cos(phase), 0],
        angular_acceleration=[0, -0.35 * frequency**2 * np.sin(phase), 0],
        center_offset=[0.1, 0, 0.7],
        frequency=frequency,
    )


@pytest.mark.parametrize("phase_per_window", [3.0, 12.0])
def test_a_pendulum_swings_on_with_its_frequency(phase_per_window):
    truth = swing(phase_per_window)
    rng = np.random.default_rng(15)
    quats, d, last_quat, last = problems.observe(truth, TIMES, rng, 0.002 * SIZE, np.radians(0.3))
    quats[4] = rotations.multiply(rotations.rotvecs_to_quats(np.array([0, 1.0, 0])), quats[4])
    fit = model_selection.fit(TIMES, quats, d, radius=RADIUS)
    assert fit.chosen == "pendulum"
    assert problems.error_percent(fit.model, truth, HORIZON, last_quat, last).max() < 5
    assert fit.model.covariance_names[-1] == "frequency"
    sigma = fit.model.covariance[-1, -1] ** 0.5
    assert 0 < sigma < 0.1 * truth.frequency
    assert abs(fit.model.frequency - truth.frequency) < 4 * sigma


def test_less_than_a_quarter_of_a_period_is_no_swing():
    for phase_per_window in (0.5, 1.0):
        truth = swing(phase_per_window)
        quats, d, _, _ = problems.observe(truth, TIMES, np.random.default_rng(16), 1e-4 * SIZE, 1e-4)
        fit = model_selection.fit(TIMES, quats, d, radius=RADIUS)
        assert fit.chosen not in ("pendulum", "spring")
        assert fit.model.frequency == 0


def test_noise_that_swings_by_chance_is_no_swing():
    rng = np.random.default_rng(17)
    for name in ("uniform", "hinge"):
        quats, d, _, _ = problems.observe(MOTIONS[name][0], TIMES, rng, 0.005 * SIZE, np.radians(0.6), 0.7)
        assert model_selection.fit(TIMES, quats, d, radius=RADIUS).model.frequency == 0


def test_the_band_holds_the_true_error():
    rng = np.random.default_rng(7)
    inside = []
    for name in ("uniform", "hinge", "rolling", "ballistic, spinning"):
        truth = MOTIONS[name][0]
        quats, d, last_quat, last = problems.observe(truth, TIMES, rng, 0.005 * SIZE, np.radians(1) / 3**0.5)
        fit = model_selection.fit(TIMES, quats, d, radius=RADIUS)
        error = problems.error_percent(fit.model, truth, HORIZON[:1], last_quat, last)[0]
        inside.append(error <= 100 / SIZE * fit.history.band.widths(TIMES[-1] + HORIZON[0]))
    assert np.mean(inside) >= 0.9
    assert fit.history.band.half_width[-1] > fit.history.band.half_width[4] > 0


@pytest.mark.parametrize("count", [2, 4])
def test_a_body_that_enters_late_has_a_band_as_long_as_those_of_the_others(count):
    late = (np.arange(15) >= 15 - count).astype(float)
    quats, d, _, _ = problems.observe(MOTIONS["rolling"][0], TIMES, np.random.default_rng(5), 0.01 * SIZE, 0.02)
    fit = model_selection.fit(TIMES, quats, d, radius=RADIUS, weights=late)
    assert fit.history.band.times[-1] == pytest.approx(2 * T_MAX)
    assert fit.history.band.widths(T_MAX + HORIZON[:1])[0] > 0.2 * SIZE
    assert fit.history.warning(T_MAX + HORIZON[0]).startswith("not predictable past")


def test_the_start_of_the_scene_does_not_change_how_far_a_late_body_is_predictable():
    times = np.linspace(0, T_MAX, 200)
    quats, d, _, _ = problems.observe(MOTIONS["rolling"][0], times, np.random.default_rng(5), 0.01 * SIZE, 0.02)
    late, bands = (np.arange(200) >= 192).astype(float), []
    for first in (0, 150, 192):
        fit = model_selection.fit(times[first:], quats[first:], d[first:], radius=RADIUS, weights=late[first:])
        bands.append(fit.history.band)
    span, until = T_MAX - times[192], [band.predictable_until - T_MAX for band in bands]
    assert until == pytest.approx([until[-1]] * 3, abs=0.02 * span) and 0.1 * span < until[-1] < span
    near = T_MAX + span * np.array([0.3, 0.7, 1.0])
    for band in bands[:2]:
        np.testing.assert_allclose(band.widths(near), bands[-1].widths(near), rtol=0.02)


def test_a_drift_of_the_track_widens_the_band_and_not_the_fit():
    (plain, _), (wide, _) = (
        fitted("ballistic, spinning", np.random.default_rng(1), 2e-3, 2e-3, drift=drift)
        for drift in ((0, 0), (0.01, 0.3))
    )
    assert plain.model == wide.model
    own, wider = plain.history.band, wide.history.band
    assert (np.array(wider.half_angle) > own.half_angle).all() and wider.half_angle[-1] > 0.3
    assert plain.history.warning() == "" and wide.history.warning()


def test_a_law_that_contradicts_earlier_poses_is_rejected():
    """A path of five random waves, three of them too fast to be resolved."""
    rng, trusted = np.random.default_rng(0), []
    for _ in range(2):
        frequencies, ways = rng.uniform(5, 40, 5), 0.4 * rng.normal(size=(5, 3))
        path = np.sin(frequencies * TIMES[:, None] + rng.uniform(0, 6, 5)) @ ways
        fit = model_selection.fit(TIMES, rotations.identity(15), path - path[-1], radius=RADIUS)
        trusted.append(fit.history.band.predictable_until is None)
    assert not any(trusted)


def test_the_noise_is_estimated():
    fit, _ = fitted("hinge", np.random.default_rng(8), 0.004, 0.02)
    assert fit.sigma_t == pytest.approx(0.004, rel=0.4)
    assert fit.sigma_r == pytest.approx(0.02, rel=0.4)


def test_the_future_starts_at_the_bind_state_however_noisy():
    fit, _ = fitted("hinge", np.random.default_rng(10), 0.02, 0.1)
    quats, displacements = models.evaluate(fit.model, 0.0)
    assert quats.tolist() == [1, 0, 0, 0]
    assert displacements.tolist() == [0, 0, 0]
    assert np.linalg.norm(fit.model.offset_displacement) > 1e-3


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 6, 7])
def test_few_poses_give_a_simple_model_through_them(count):
    truth = MOTIONS["rolling"][0]
    times = np.linspace(0, T_MAX, count) if count > 1 else np.array([T_MAX])
    quats, d, last_quat, last = problems.observe(truth, times, np.random.default_rng(0), 1e-6, 1e-6)
    fit = model_selection.fit(times, quats, d, radius=RADIUS)
    if count == 1:
        assert fit.model.is_static
    else:
        assert fit.chosen == "translation + spin"
        assert problems.error_percent(fit.model, truth, HORIZON, last_quat, last).max() < 1


def test_a_body_that_never_moves_is_static_with_few_poses_too():
    fit = model_selection.fit(np.array([0.0, 1.0]), rotations.identity(2), np.zeros((2, 3)), radius=1.0)
    assert fit.chosen == "static"
    assert fit.model.is_static or np.abs(fit.model.offset_displacement).max() < 1e-9


def test_scale_and_units_of_time_do_not_change_the_choice():
    rng = np.random.default_rng(11)
    truth = MOTIONS["hinge"][0]
    quats, d, _, _ = problems.observe(truth, TIMES, rng, 0.003, 0.01)
    plain = model_selection.fit(TIMES, quats, d, radius=RADIUS)
    scaled = model_selection.fit(50 + 24 * TIMES, quats, 1000 * d, radius=1000 * RADIUS)
    assert plain.chosen == scaled.chosen
    np.testing.assert_allclose(scaled.model.angular_velocity * 24, plain.model.angular_velocity, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(
        models.evaluate(scaled.model, 12.0)[1] / 1000, models.evaluate(plain.model, 0.5)[1], atol=1e-5
    )


def test_the_world_twist_can_be_requested():
    truth = models.MotionModel(
        "world_twist",
        velocity=[0.5, 0, 0.1],
        angular_velocity=[0, 0.5, 1.5],
        angular_acceleration=[0.5, 0, 0],
        radius=RADIUS,
    )
    quats, d, last_quat, last = problems.observe(truth, TIMES, np.random.default_rng(12), 1e-7, 1e-7)
    fit = model_selection.fit(TIMES, quats, d, radius=RADIUS, candidates=["world twist"])
    assert fit.model.kind == "world_twist"
    assert problems.error_percent(fit.model, truth, HORIZON[:1], last_quat, last).max() < 0.1


def test_the_table_names_every_candidate_and_covariance_is_stored():
    fit, _ = fitted("uniform", np.random.default_rng(13), 0.003, 0.01)
    assert [s.name for s in fit.scores] == [*(c.name for c in candidates.FAMILY), *breaks.BREAKS]
    best = min(s.evidence for s in fit.scores)
    assert best <= next(s.evidence for s in fit.scores if s.name == fit.chosen) <= best + model_scores.STRONG
    variances = np.diag(fit.model.covariance)
    assert fit.model.covariance_names[0] == "velocity.x"
    assert (variances[:3] > 0).all()
    assert variances[0] ** 0.5 < 0.05


def test_equal_input_gives_equal_models():
    first, second = (fitted("rolling", np.random.default_rng(14), 0.003, 0.01)[0] for _ in range(2))
    assert first.model == second.model


@pytest.mark.parametrize("count", [2, 3, 5, 9, 15])
def test_meaningless_poses_give_finite_motions(count):
    rng = np.random.default_rng(count)
    times = np.sort(rng.uniform(size=count))
    quats = rotations.normalize(rng.normal(size=(count, 4)))
    fit = model_selection.fit(times, quats, rng.normal(size=(count, 3)), radius=RADIUS)
    band = fit.history.band
    for values in (*models.evaluate(fit.model, np.array([0.0, 1.0, 100.0])), band.half_width, band.half_angle):
        assert np.isfinite(values).all()


def test_exact_rest_is_static_to_the_bit():
    fit = model_selection.fit(TIMES, rotations.identity(15), np.zeros((15, 3)), radius=RADIUS)
    assert fit.model.is_static
    assert fit.chosen == "static"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"times": TIMES[::-1]}, "increasing"),
        ({"displacements": np.full((15, 3), np.nan)}, "finite"),
        ({"quats": np.zeros((15, 3))}, r"\(S, 4\)"),
        ({"radius": 0.0}, "radius"),
        ({"weights": -np.ones(15)}, "weights"),
        ({"candidates": ["warp"]}, "warp"),
        ({"candidates": ["free top"]}, "inertia"),
    ],
)
def test_unusable_tracks_are_refused(change, message):
    arguments = {
        "times": TIMES,
        "quats": rotations.identity(15),
        "displacements": np.zeros((15, 3)),
        "radius": RADIUS,
        **change,
    }
    with pytest.raises(ValueError, match=message):
        model_selection.fit(**arguments)


NOISE = 0.005 * SIZE, np.radians(1) / 3**0.5
STUDIED = [name for name in FITTED if name not in ("pendulum", "spring", "screw")]


@pytest.mark.nightly
def test_over_many_seeds_the_right_family_is_chosen_and_costs_little():
    rng, right, ratios = np.random.default_rng(30), [], []
    for name in STUDIED:
        truth, names = MOTIONS[name]
        ours, known = [], []
        for _ in range(20):
            quats, d, last_quat, last = problems.observe(truth, TIMES, rng, *NOISE)
            fit = model_selection.fit(TIMES, quats, d, radius=RADIUS)
            true = model_selection.fit(TIMES, quats, d, radius=RADIUS, candidates=names[-1:])
            right.append(fit.chosen in names)
            for result, model in ((ours, fit.model), (known, true.model)):
                result.append(problems.error_percent(model, truth, HORIZON[:1], last_quat, last)[0])
        ratios.append(np.median(ours) / np.median(known))
    assert np.mean(right) >= 0.85
    assert np.exp(np.mean(np.log(ratios))) <= 1.3


@pytest.mark.nightly
def test_over_many_seeds_stops_are_found_and_slow_movers_move():
    rng, stopped, frozen = np.random.default_rng(31), [], []
    for _ in range(40):
        way = np.minimum(TIMES, rng.uniform(0.4, 0.5))[:, None]
        path = way * [0.8, 0.1, 0] + NOISE[0] * rng.normal(size=(15, 3))
        turns = rotations.rotvecs_to_quats(way * [0, 0, 2.0] + NOISE[1] * rng.normal(size=(15, 3)))
        quats = rotations.multiply(turns, rotations.conjugate(turns[-1]))
        fit = model_selection.fit(TIMES, quats, path - path[-1], radius=RADIUS)
        stopped.append(fit.chosen == "static" and fit.rested)
        axis = rng.normal(size=3)
        slow = models.MotionModel("translation", velocity=0.1 * SIZE * axis / np.linalg.norm(axis))
        quats, d, _, _ = problems.observe(slow, TIMES, rng, *NOISE)
        frozen.append(model_selection.fit(TIMES, quats, d, radius=RADIUS).chosen == "static")
    assert np.mean(stopped) >= 0.9
    assert np.mean(frozen) <= 0.05


@pytest.mark.nightly
@pytest.mark.parametrize("correlation", [0.0, 0.5])
def test_over_many_seeds_the_band_holds_the_true_error(correlation):
    rng, inside = np.random.default_rng(32), []
    for name in STUDIED:
        truth = MOTIONS[name][0]
        for _ in range(8):
            quats, d, last_quat, last = problems.observe(truth, TIMES, rng, *NOISE, correlation)
            fit = model_selection.fit(TIMES, quats, d, radius=RADIUS)
            error = problems.error_percent(fit.model, truth, HORIZON[:1], last_quat, last)[0]
            inside.append(error <= 100 / SIZE * fit.history.band.widths(TIMES[-1] + HORIZON[0]))
    assert np.mean(inside) >= 0.9


@pytest.mark.nightly
def test_over_many_seeds_an_outlier_costs_little():
    rng, clean, dirty = np.random.default_rng(33), [], []
    for name in ("uniform", "ballistic", "spin", "hinge", "rolling", "ballistic, spinning"):
        truth = MOTIONS[name][0]
        for _ in range(8):
            quats, d, last_quat, last = problems.observe(truth, TIMES, rng, *NOISE)
            row = int(rng.integers(1, 12))
            spoiled_quats, spoiled = quats.copy(), d.copy()
            spoiled[row] += [0.5, -0.4, 0.3]
            spoiled_quats[row] = rotations.multiply(rotations.rotvecs_to_quats(np.array([0, 1.5, 0])), quats[row])
            for result, (q, x) in ((clean, (quats, d)), (dirty, (spoiled_quats, spoiled))):
                model = model_selection.fit(TIMES, q, x, radius=RADIUS).model
                result.append(problems.error_percent(model, truth, HORIZON[:1], last_quat, last)[0])
    assert np.median(dirty) <= 1.3 * np.median(clean)
