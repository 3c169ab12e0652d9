import numpy as np
import pytest

from r5dgs_core.motion import models, pose_track, rotations
from r5dgs_core.motion_fit import breaks, candidates, fitted_motion, model_selection, plausibility
from tests.support import problems
from tests.support.problems import RADIUS, SIZE, T_MAX

TIMES = np.linspace(0, T_MAX, 15)
STEP = TIMES[1] - TIMES[0]
END = 1.0
SIGMA = 0.005 * SIZE, np.radians(0.8)
G = np.array([0.0, 0.0, -10.0])
V, W = np.array([[0.9, -0.3, 0.4], [-0.6, 0.8, 0.2]]), np.array([[1.0, -0.5, 2.0], [0.3, 1.5, -1.0]])
ZERO = np.zeros(3)
STEPS = [1, 0, 0.5], [-0.5, 1, 0], [0.2, -1, 1]  # velocities between two impacts


def turned(spin, way):
    return rotations.rotvecs_to_quats(spin * way)


def broken(at, v=V, w=W, g=ZERO, after=ZERO):
    """Poses of a motion whose rates change at a time; g acts always, ``after`` acts since then."""

    def path(t):
        before, since = np.minimum(t - at, 0)[:, None], np.maximum(t - at, 0)[:, None]
        fall = 0.5 * g * (t[:, None] - at) ** 2 + 0.5 * after * since**2
        return rotations.multiply(turned(w[1], since), turned(w[0], before)), v[0] * before + v[1] * since + fall

    return path


def observed(path, rng=None, sigma=SIGMA):
    """Fit of the poses of a motion, and the error at the end in % of the size."""
    rng = rng or np.random.default_rng(0)
    quats, d = path(TIMES)
    quats = rotations.multiply(turned(sigma[1], rng.normal(size=(15, 3))), quats)
    d = d + sigma[0] * rng.normal(size=(15, 3))
    fit = model_selection.fit(
        TIMES, rotations.multiply(quats, rotations.conjugate(quats[-1])), d - d[-1], radius=RADIUS
    )
    true_quats, true = (x[0] for x in path(np.array([END])))
    turn, move = models.evaluate(fit.model, END - T_MAX)
    angle = rotations.angle_between(rotations.multiply(turn, quats[-1]), true_quats)
    return fit, 100 / SIZE * np.sqrt(((d[-1] + move - true) ** 2).sum() + 2 / 3 * (RADIUS * angle) ** 2)


CASES = {
    "impact": (broken(0.5), "impact"),
    "start": (broken(0.5, [ZERO, V[0]], [ZERO, W[0]]), "start"),
    "stop": (broken(0.5, [V[0], ZERO], [W[0], ZERO]), "stop"),
    "throw": (broken(0.45, [ZERO, V[0]], [ZERO, W[0]], after=G), "start"),
    "drop": (broken(0.45, [ZERO, ZERO], [ZERO, ZERO], after=G), "start"),
    "land": (broken(0.5, [[0.3, 0, -4], ZERO], [W[0], ZERO], g=ZERO), "stop"),
    "bounce": (broken(0.45, [[0.5, 0, -4], [0.5, 0, 3]], W, g=G), "impact"),
    "falls from a table": (broken(0.45, [V[0], V[0]], [W[0], W[0]], after=G), "change"),
}


@pytest.mark.default_cases("impact", "start", "bounce")
@pytest.mark.parametrize("name", CASES)
def test_a_break_is_found_within_a_step_and_the_last_law_goes_on(name):
    path, kind = CASES[name]
    fit, error = observed(path)
    (event,) = fit.history.events
    true = 0.5 if name in ("impact", "start", "stop", "land") else 0.45
    assert event.kind == kind
    assert abs(event.time - true) < STEP
    assert 0 < event.sigma < STEP
    assert error < 12
    assert fit.history.band.widths(END) > 0


@pytest.mark.default_cases("stop", "throw", "falls from a table")
@pytest.mark.parametrize("name", CASES)
def test_a_break_without_noise_is_exact(name):
    fit, error = observed(CASES[name][0], sigma=(1e-7 * SIZE, 1e-7))
    assert len(fit.history.events) == 1
    assert error < 0.1


@pytest.mark.default_cases("3")
@pytest.mark.parametrize("left", [2, 3])
def test_few_poses_after_a_break_suffice(left):
    errors = []
    for seed in range(2):
        at = TIMES[-left] - 0.6 * STEP
        fit, error = observed(broken(at), np.random.default_rng(seed))
        assert abs(fit.history.events[-1].time - at) < STEP
        errors.append(error)
    assert max(errors) < {2: 10, 3: 8}[left]


def test_segments_lie_between_events_and_hold_the_rates_of_each_side():
    fit, _ = observed(CASES["impact"][0], sigma=(1e-6 * SIZE, 1e-6))
    before, after = fit.history.segments
    assert (before.start, before.stop, after.stop) == (0.0, fit.history.events[0].time, T_MAX)
    for segment, v, w in zip((before, after), V, W, strict=True):
        np.testing.assert_allclose(segment.parameters["velocity"], v, atol=0.01)
        np.testing.assert_allclose(segment.parameters["angular_velocity"], w, atol=0.01)
    still, _ = observed(CASES["start"][0])
    assert still.history.segments[0].kind == "static"


def test_segments_hold_the_constants_of_their_law():
    def path(t):
        g, speed, keep = 16.0, 3.0, 0.8
        first = 0.15
        second = first + 2 * speed / g
        k = (t >= first).astype(int) + (t >= second)
        since = t - np.array([first - 2 * speed / keep / g, first, second])[k]
        up = np.array([speed / keep, speed, speed * keep])[k]
        return rotations.identity(len(t)), np.stack([0.5 * t, 0 * t, up * since - 0.5 * g * since**2], -1)

    fit, _ = observed(path, sigma=(1e-6 * SIZE, 1e-6))
    assert [event.kind for event in fit.history.events] == ["impact", "impact"]
    for segment in fit.history.segments:
        np.testing.assert_allclose(segment.parameters["restitution"], 0.8, atol=1e-3)
    assert "bounce_time" in fit.history.segments[-1].parameters
    assert "bounce_time" not in fit.history.segments[0].parameters


def test_two_impacts_are_both_found():
    def path(t):
        first, second = 0.2, 0.55
        spans = [np.minimum(t, first), np.clip(t - first, 0, second - first), np.maximum(t - second, 0)]
        d = sum(span[:, None] * np.array(v) for span, v in zip(spans, STEPS, strict=True))
        return rotations.identity(len(t)), d

    fit, error = observed(path)
    assert [event.kind for event in fit.history.events] == ["impact", "impact"]
    np.testing.assert_allclose([event.time for event in fit.history.events], [0.2, 0.55], atol=STEP)
    assert error < 8


def test_the_last_part_may_have_a_law_of_its_own():
    def path(t):
        since = np.maximum(t - 0.21, 0)[:, None]
        way = -np.expm1(-5 * since) / 5
        before = np.minimum(t - 0.21, 0)[:, None]
        return rotations.multiply(turned(4 * W[1], way), turned(W[0], before)), V[0] * before + 2.5 * V[1] * way

    fit, error = observed(path)
    assert fit.model.kind == "drag"
    assert abs(fit.history.events[-1].time - 0.21) < STEP
    assert error < 5


@pytest.mark.default_cases("0.7")
@pytest.mark.parametrize("correlation", [0.0, 0.7])
def test_smooth_motions_have_no_events(correlation):
    rng, found = np.random.default_rng(1), 0
    for _ in range(3):
        v, w, a = rng.normal(size=3), 1.5 * rng.normal(size=3), rng.choice([0, 8.0]) * rng.normal(size=3)
        noise = rng.normal(size=(15, 6))
        for i in range(1, 15):
            noise[i] = correlation * noise[i - 1] + np.sqrt(1 - correlation**2) * noise[i]
        tau = (TIMES - T_MAX)[:, None]
        d = v * tau + 0.5 * a * tau**2 + SIGMA[0] * noise[:, :3]
        quats = rotations.multiply(turned(SIGMA[1], noise[:, 3:]), turned(w, tau))
        quats = rotations.multiply(quats, rotations.conjugate(quats[-1]))
        found += len(model_selection.fit(TIMES, quats, d - d[-1], radius=RADIUS).history.events)
    assert found == 0


def test_a_ball_that_bounced_bounces_on():
    g, keep, speed, first = 20.0, 0.8, 3.0, 0.15
    hits, speeds = [first - 2 * speed / keep / g], [speed / keep]
    while len(hits) < 12:
        hits.append(hits[-1] + 2 * speeds[-1] / g)
        speeds.append(keep * speeds[-1])

    def path(t):
        k = np.searchsorted(hits, t, side="right") - 1
        y, up = t - np.array(hits)[k], np.array(speeds)[k]
        return turned(W[0], t[:, None]), np.stack([0.5 * t, 0.2 * t, up * y - 0.5 * g * y**2], -1)

    fit, error = observed(path)
    assert fit.model.kind == "bounce"
    assert fit.model.restitution == pytest.approx(keep, abs=0.03)
    np.testing.assert_allclose([event.time for event in fit.history.events], hits[1:4], atol=STEP)
    assert T_MAX + fit.model.bounce_time == pytest.approx(hits[4], abs=0.02)
    assert error < 4


def test_a_body_that_friction_stopped_rests():
    def path(t):
        u = np.minimum(t, 0.5)[:, None]
        way = u - u**2
        return turned(np.array([0, 5.0, 0]), way), np.array([1.5, 0, 0]) * way

    fit, error = observed(path)
    assert fit.rested and fit.chosen == "static"
    assert [event.kind for event in fit.history.events] == ["stop"]
    assert error < 2
    assert not fit.model.turns or np.abs(fit.model.offset_rotvec).max() < 0.1


def test_each_kind_of_break_is_tried_in_each_gap():
    rng = np.random.default_rng(3)
    fit = model_selection.fit(TIMES, rotations.identity(15), rng.normal(size=(15, 3)), radius=RADIUS)
    assert {score.name for score in fit.scores} >= set(breaks.BREAKS)


def test_a_small_change_of_the_rates_needs_more_evidence_than_a_large_one():
    still = np.zeros((2, 3))
    for change, count in ((0.1, 0), (0.5, 1)):
        path = broken(0.4, v=np.array([[3.0, 0, 0], [3.0, change, 0]]), w=still)
        fit, _ = observed(path, np.random.default_rng(1), (7e-4 * SIZE, 7e-4))
        assert len(fit.history.events) == count


def test_bounces_that_no_pose_separates_are_one_event():
    parts = {"bounce": np.array([-0.5]), "logit_rho": np.array([0.0]), "w": ZERO}
    parts |= {"v": np.array([1.0, 0, 0.5]), "a": np.array([0, 0, -10.0]), "r": ZERO, "e": ZERO}
    ball = candidates.BY_NAME["bounces"]
    theta = ball.pack(parts)
    solution = candidates.FittedCandidate(ball, theta, np.eye(len(theta)), np.zeros((15, 6)), np.ones(15))
    assert len(ball.events(theta)) > 10
    found = fitted_motion.events(solution, 1.0, T_MAX, T_MAX)
    assert len(found) > 1
    assert min(np.diff([event.time for event in found])) > T_MAX / 15


def test_motion_without_a_fitting_law_is_not_taken_for_rest():
    truth = problems.MOTIONS["free axis"][0]
    quats, d, *_ = problems.observe(truth, TIMES, np.random.default_rng(0), 1e-7 * SIZE, 1e-7)
    names = ["static", "ballistic + spin, accelerating"]
    fit = model_selection.fit(TIMES, quats, d, radius=RADIUS, candidates=names)
    assert fit.chosen == names[1]


@pytest.mark.parametrize(("acceleration", "much"), [(1.0, False), (200.0, True)])
def test_a_law_that_moves_a_body_further_than_ever_is_implausible(acceleration, much):
    tau = np.linspace(-1, 0, 15)
    track = pose_track.PoseTrack(tau, rotations.identity(15), 3.0 * tau[:, None] * [1, 0, 0], np.ones(15))
    law = candidates.BY_NAME["translation, quadratic"]
    theta = law.pack({"r": ZERO, "e": ZERO, "v": np.array([3.0, 0, 0]), "a": np.array([0, acceleration, 0])})
    solution = candidates.FittedCandidate(law, theta, np.eye(len(theta)), np.zeros((15, 6)), np.ones(15))
    assert plausibility.runs_away(solution, track) == much
