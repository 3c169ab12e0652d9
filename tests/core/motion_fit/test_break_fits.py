import numpy as np
import pytest

from r5dgs_core.motion import rotations
from r5dgs_core.motion.pose_track import PoseTrack
from r5dgs_core.motion_fit import break_fits, breaks, candidates

NOISE = candidates.Noise(0.01, 0.02)
TAU = np.linspace(-1, 0, 9)
GAPS = np.array([3, 5, 7])
KINDS = list(breaks.BREAKS.items())


def random_track():
    rng = np.random.default_rng(0)
    quats = rotations.rotvecs_to_quats(0.5 * rng.normal(size=(len(TAU), 3)))
    return PoseTrack(TAU, quats, rng.normal(size=(len(TAU), 3)), np.ones(len(TAU)))


def all_kinds(logit=None):
    """All kinds of breaks in some gaps, and parameters of each [B, P]; ``logit`` is that of the time of the break."""
    families = [breaks.BreakCandidate(name, "ballistic_spin", (*kind.blocks, "c")) for name, kind in KINDS]
    flags = [(kind.rests_before, kind.starts_slowly) for _, kind in KINDS]
    kinds = [(family, *both) for family, both in zip(families, flags, strict=True)]
    every = break_fits.Breaks.of(kinds, TAU[GAPS - 1], TAU[GAPS])
    theta = np.random.default_rng(1).normal(size=every.own.shape) * every.own
    if logit is not None:
        theta[:, break_fits.ROWS["c"]] = logit
    return families, every, theta


@pytest.mark.parametrize("logit", [None, 6.0, -6.0])
def test_the_joint_fit_has_the_residuals_of_each_break(logit):
    track = random_track()
    families, every, theta = all_kinds(logit)
    values, _ = every.linearized(theta, np.arange(len(theta)), track, NOISE)
    for i, family in enumerate(families):
        for k, gap in enumerate(GAPS):
            row = i * len(GAPS) + k
            own = break_fits.rows_of(family)
            broken = breaks.BreakCandidate(
                family.name, family.kind, family.blocks, low=TAU[gap - 1], high=TAU[gap], gap=int(gap)
            )
            expected = candidates.residuals(broken, theta[row, own], track, NOISE)
            np.testing.assert_allclose(values[row], expected, atol=1e-9)


@pytest.mark.parametrize("logit", [None, 6.0])
def test_the_slopes_match_central_differences(logit):
    track, step = random_track(), 1e-5
    _, every, theta = all_kinds(logit)
    rows = np.arange(len(theta))
    _, slopes = every.linearized(theta, rows, track, NOISE)
    for parameter in range(break_fits.COUNT):
        nudge = np.zeros(break_fits.COUNT)
        nudge[parameter] = step
        up, down = (every.linearized(theta + sign * nudge, rows, track, NOISE)[0] for sign in (1, -1))
        expected = (up - down) / (2 * step) * every.own[:, parameter, None, None]
        np.testing.assert_allclose(slopes[:, parameter], expected, atol=1e-5 * np.abs(slopes).max())


def test_some_of_the_breaks_are_the_same_as_all():
    track, (_, every, theta) = random_track(), all_kinds()
    some = np.array([1, 4, 11])
    all_values, all_slopes = every.linearized(theta, np.arange(len(theta)), track, NOISE)
    values, slopes = every.linearized(theta[some], some, track, NOISE)
    np.testing.assert_allclose(values, all_values[some], atol=1e-12)
    np.testing.assert_allclose(slopes, all_slopes[some], atol=1e-12)


@pytest.mark.parametrize("count", [5, 6, 7])
def test_a_break_is_tried_only_if_twelve_numbers_are_left_over(count):
    rng, tau = np.random.default_rng(2), np.linspace(-1, 0, count)
    track = PoseTrack(tau, rotations.identity(count), rng.normal(size=(count, 3)), np.ones(count))
    found = breaks.search(track, candidates.Noise(0.1, 0.1))
    sizes = {name: 7 + sum(3 for _ in kind.blocks) for name, kind in KINDS}
    assert {s.candidate.name for s in found} == {name for name, size in sizes.items() if size <= 6 * count - 12}
