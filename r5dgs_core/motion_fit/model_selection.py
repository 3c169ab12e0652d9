"""Select the motion model of a group past t_max from its observed poses.

Every candidate family (`candidates`) is fitted to the noisy poses. The simplest one with a held-out error near the best
is selected, unless the body has come to rest. Notation: S poses, tau = t - t_max <= 0; radius weights rotations against
displacements.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..motion import free_top, models, rotations
from . import candidates as families
from . import fitted_motion, rest_detection
from .candidates import Candidate, Solution, Track

logger = logging.getLogger(__name__)

HELD_OUT = 0.2
WITHIN = 1.5
_FREE_AXIS = families.BY_NAME["ballistic + spin, free axis"]
_LARGEST = families.BY_NAME["full, free centre"]
FREQUENCY_ERROR = 0.25  # largest relative standard deviation of a determined frequency
PARALLEL_RAD = math.radians(15.0)  # largest angle between a spin and its rate without tumbling


@dataclass(frozen=True)
class Score:
    """One row of the score table.

    Attributes:
        name: Name of the candidate.
        parameters: Number of its free parameters, including the six of the pose.
        held_out: Root mean square of the held-out residuals in units of the noise; infinite if not fitted, or if the
            poses do not determine the frequency of an oscillation.
        fit: The same over all poses after the final fit, or NaN if there was no final fit.
    """

    name: str
    parameters: int
    held_out: float
    fit: float


@dataclass(frozen=True)
class Fit:
    """A selected motion model with the evidence for it.

    Attributes:
        model: The motion past t_max.
        scores: The score table, in the order of the candidates.
        chosen: Name of the candidate in `model`.
        rested: True if the body has come to rest, in which case `chosen` is "static".
        sigma_t: Noise of the displacements, per component, world units.
        sigma_r: Noise of the rotations, per component, rad.
        band_tau: Times past t_max of `band`. [H]
        band: Two standard deviations of the position of a point of the body, world units; scaled by the held-out error
            of the chosen candidate if that exceeds the noise. [H]
    """

    model: models.MotionModel
    scores: tuple[Score, ...]
    chosen: str
    rested: bool
    sigma_t: float
    sigma_r: float
    band_tau: np.ndarray
    band: np.ndarray


def fit(
    times: np.ndarray,  # [S]
    quats: np.ndarray,  # [S, 4]
    displacements: np.ndarray,  # [S, 3]
    *,
    radius: float,
    weights: np.ndarray | None = None,  # [S]
    candidates: Sequence[str] | None = None,
    inertia: np.ndarray | None = None,  # [3, 3]
    least_noise: tuple[float, float] = (0.0, 0.0),
) -> Fit:
    """Fit all candidates to a pose track and select one.

    Args:
        times: Increasing, any spacing; the last is t_max. [S]
        quats: Rotations relative to the bind state, unit wxyz, any sign. [S, 4]
        displacements: Displacements of the pivot relative to the bind state, world units. [S, 3]
        radius: Radius of the group, world units, > 0.
        weights: Confidence of each pose, >= 0; 0 excludes a pose. None for equal weights. [S]
        candidates: Names of candidates in `candidates.BY_NAME`; None for `candidates.FAMILY`.
        inertia: Inertia of the group in the bind state, up to a factor (`free_top.inertia`), or None. If given, the
            free top is tried when one of the best candidates spins about a changing axis, and selected if it predicts
            the held-out poses better. [3, 3]
        least_noise: Lower bounds of the noise of displacements (per component, world units) and rotations (rad), if
            more is known than the scatter about a smooth motion shows.

    Returns:
        The fit. With fewer than four poses of positive weight, at most a velocity and a spin; with one, static.

    Source: selection by held-out error (the simplest within 1.5 times the best), rest test, band from the covariance
        inflated for correlated residuals and from the spread of the near-best candidates.
    """
    times, quats, displacements = (np.asarray(x, np.float64) for x in (times, quats, displacements))
    weights = np.ones(len(times)) if weights is None else np.asarray(weights, np.float64)
    _check(times, quats, displacements, weights, radius)
    family = families.FAMILY if candidates is None else tuple(_named(name, inertia) for name in candidates)
    used = weights > 0
    if used.sum() < 2 or times[used][-1] == times[used][0]:
        return _static(radius)
    span = float(times[-1] - times[used][0])
    track = Track(
        (times[used] - times[-1]) / span,
        rotations.make_continuous(rotations.normalize(quats[used])),
        displacements[used] / radius,
        weights[used] / weights[used].mean(),
    )
    family = _observable(family, track)
    if len(track.tau) < 4:
        return _few(track, family, radius, span)
    return _select(track, family, inertia, (least_noise[0] / radius, least_noise[1]), radius, span)


def _select(
    track: Track,
    family: tuple[Candidate, ...],
    inertia: np.ndarray | None,
    least_noise: tuple[float, float],
    radius: float,
    span: float,
) -> Fit:
    """Fit four or more poses. ``least_noise`` is in radii and rad; the other arguments are those of `fit`."""
    tried = tuple(c for c in family if not c.oscillates or families.may_swing(c, track))
    sigmas, outliers = _noise(track, tried)
    sigmas = (max(sigmas[0], least_noise[0]), max(sigmas[1], least_noise[1]))
    scores, solutions = _score(family, tried, track, sigmas, outliers)
    fits = {name: math.sqrt(solution.chi2) for name, solution in solutions.items()}
    table = [Score(c.name, c.parameters, scores[c.name], fits.get(c.name, math.nan)) for c in family]
    solution, evidence = min(solutions.values(), key=lambda s: s.candidate.parameters), track
    tail = rest_detection.poses_at_rest(solution, track, sigmas)
    if tail:
        evidence, solutions = track.rows(slice(-tail, None)), {}
        solution = families.solve(rest_detection.STATIC, evidence, sigmas)
        wider = math.sqrt(2.0)  # double the variance, because a resting body may move again
    else:
        if inertia is not None and any(_may_tumble(s, inertia) for s in solutions.values()):
            free = replace(families.FREE_TOP, inertia=np.asarray(inertia, np.float64))
            held, top = _held_out(free, track, sigmas, outliers), families.solve(free, track, sigmas)
            table.append(Score(free.name, free.parameters, held, math.sqrt(top.chi2)))
            # A simpler motion is replaced only if clearly worse; one with a free angular acceleration has more
            # parameters.
            if held * (1.0 if "eps" in solution.candidate.blocks else WITHIN) < scores[solution.candidate.name]:
                solution, solutions[free.name], scores[free.name] = top, top, held
        missed = scores[solution.candidate.name]  # assume errors after t_max like those at the held-out poses
        wider = max(1.0, missed if math.isfinite(missed) else 1.0)
    model = fitted_motion.to_model(solution, radius, span, evidence, sigmas)
    band_tau, band = fitted_motion.band(solution, list(solutions.values()), evidence, sigmas, radius, span)
    return Fit(
        model,
        tuple(table),
        chosen=solution.candidate.name,
        rested=tail > 0,
        sigma_t=sigmas[0] * radius,
        sigma_r=sigmas[1],
        band_tau=band_tau,
        band=wider * band,
    )


def _score(
    family: tuple[Candidate, ...],
    tried: tuple[Candidate, ...],
    track: Track,
    sigmas: tuple[float, float],
    outliers: np.ndarray,
) -> tuple[dict[str, float], dict[str, Solution]]:
    """Held-out errors of all candidates, and fits to all poses of those near the best, by name."""
    scores = {c.name: _held_out(c, track, sigmas, outliers) if c in tried else math.inf for c in family}
    solutions = {c.name: families.solve(c, track, sigmas) for c in _near(family, scores)}
    # Reject oscillations with an undetermined frequency; other candidates may then be near the best.
    for name, solution in solutions.items():
        if not _determined(solution, track, sigmas):
            scores[name] = math.inf
    near = _near(family, scores)
    return scores, {c.name: solutions.get(c.name) or families.solve(c, track, sigmas) for c in near}


def _may_tumble(picked: Solution, inertia: np.ndarray) -> bool:
    """Return True if the selected motion changes its spin axis and the inertia allows free tumbling."""
    if "eps" not in picked.candidate.blocks or not models.KINDS[picked.candidate.kind].may_tumble:
        return False
    p = picked.candidate.unpack(picked.theta)
    across = np.linalg.norm(np.cross(p["w"], p["eps"]))
    along = abs(float(p["w"] @ p["eps"]))
    return bool(np.arctan2(across, along) > PARALLEL_RAD) and free_top.tumbles(inertia)


def _near(family: Sequence[Candidate], scores: dict[str, float]) -> list[Candidate]:
    """Candidates with a held-out error within `WITHIN` of the best, or the first candidate if none could be fitted."""
    finite = [s for s in scores.values() if np.isfinite(s)]
    best = max(min(finite), 1e-3) if finite else math.inf
    return [c for c in family if scores[c.name] <= WITHIN * best and finite] or [family[0]]


def _observable(family: tuple[Candidate, ...], track: Track) -> tuple[Candidate, ...]:
    """Candidates adapted to the window, without oscillations if it is too short for any.

    Frequencies range from a quarter of a period in the window to four poses per period.
    """
    low = 0.5 * math.pi / float(track.tau[-1] - track.tau[0])
    high = 0.5 * math.pi / float(np.median(np.diff(track.tau)))
    middle = float(0.5 * (track.tau[0] + track.tau[-1]))
    adapted = (replace(c, tau_mid=middle, frequencies=(low, high)) for c in family)
    return tuple(c for c in adapted if not c.oscillates or low < high)


def _determined(solution: Solution, track: Track, sigmas: tuple[float, float]) -> bool:
    """Return True if the frequency is inside its range and known to `FREQUENCY_ERROR`, or if none is free."""
    candidate = solution.candidate
    if not candidate.oscillates:
        return True
    low, high = candidate.frequencies
    frequency = float(candidate.unpack(solution.theta)["frequency"][0])
    index = candidate.index("pace")
    variance = fitted_motion.covariance(solution, track, sigmas)[index, index]
    share = (frequency - low) / (high - low)
    sigma = math.sqrt(max(variance, 0.0)) * share * (1 - share) * (high - low)
    return 0.01 < share < 0.99 and sigma < FREQUENCY_ERROR * frequency


def _check(times: np.ndarray, quats: np.ndarray, displacements: np.ndarray, weights: np.ndarray, radius: float) -> None:
    count = len(times)
    shapes = (times.shape, quats.shape, displacements.shape, weights.shape)
    if count == 0 or shapes != ((count,), (count, 4), (count, 3), (count,)):
        raise ValueError(f"expected times (S,), quats (S, 4), displacements (S, 3), weights (S,), got {shapes}")
    if not all(np.isfinite(x).all() for x in (times, quats, displacements, weights)):
        raise ValueError("times, quats, displacements, weights: expected finite numbers")
    if not (np.diff(times) > 0).all():
        raise ValueError("times: expected strictly increasing")
    if not (weights >= 0).all():
        raise ValueError("weights: expected >= 0")
    if not (math.isfinite(radius) and radius > 0):
        raise ValueError(f"radius: expected > 0, got {radius}")


def _named(name: str, inertia: np.ndarray | None) -> Candidate:
    if name not in families.BY_NAME:
        raise ValueError(f"candidates: {name!r} is none of {', '.join(families.BY_NAME)}")
    if models.KINDS[families.BY_NAME[name].kind].needs_inertia and inertia is None:
        raise ValueError(f"candidates: {name!r} needs the inertia")
    return replace(families.BY_NAME[name], inertia=inertia)


def _static(radius: float) -> Fit:
    model = models.MotionModel(radius=radius)
    scores = (Score("static", 6, math.nan, math.nan),)
    return Fit(model, scores, "static", False, 0.0, 0.0, np.zeros(1), np.zeros(1))


def _few(track: Track, family: tuple[Candidate, ...], radius: float, span: float) -> Fit:
    """Fit two or three poses: the simplest of static, translation, spin and both with errors below a hundredth."""
    sigmas = (1e-2, 1e-2)
    allowed = [c for c in family if c.parameters <= 12 and not {"a", "kappa", "u"} & set(c.blocks)] or [
        rest_detection.STATIC
    ]
    solutions = [families.solve(c, track, sigmas) for c in allowed]
    roots = [math.sqrt(s.chi2) for s in solutions]
    index = next((i for i, root in enumerate(roots) if root <= 1.0), int(np.argmin(roots)))
    chosen = solutions[index]
    table = tuple(Score(c.name, c.parameters, math.inf, r) for c, r in zip(allowed, roots, strict=True))
    model = fitted_motion.to_model(chosen, radius, span, track, sigmas)
    band_tau, band = fitted_motion.band(chosen, solutions, track, sigmas, radius, span)
    return Fit(model, table, chosen.candidate.name, False, sigmas[0] * radius, sigmas[1], band_tau, band)


def _noise(track: Track, family: tuple[Candidate, ...]) -> tuple[tuple[float, float], np.ndarray]:
    """Noise of displacements and rotations from the residuals of the largest models, and their pose weights. [S]

    The spread within a group's own rigid fit would be too small, because it misses errors common to all members.
    """
    swings = (c for c in family if c.oscillates)
    wide = [c for c in (_FREE_AXIS, _LARGEST, *swings) if c.parameters <= 6 * len(track.tau) - 6] or [
        max(
            (c for c in family if c.parameters < 6 * len(track.tau)),
            key=lambda c: c.parameters,
            default=rest_detection.STATIC,
        )
    ]
    best: tuple[float, Solution, np.ndarray] | None = None
    starts: dict[str, np.ndarray] = {}
    sigmas = (1.0, 1.0)
    for _ in range(2):
        best = None
        for candidate in wide:
            solution = families.solve(candidate, track, sigmas, starts.get(candidate.name))
            starts[candidate.name] = solution.theta
            values = families.residuals(candidate, solution.theta[None], track, (1.0, 1.0))[0]
            dof = max(6 * len(track.tau) - candidate.parameters, 1) / (6 * len(track.tau))
            level = solution.chi2 / dof
            if best is None or level < best[0]:
                best = (level, solution, values)
        assert best is not None
        _, solution, values = best
        weights = (track.weights * solution.robust)[:, None]
        dof = max(6 * len(track.tau) - solution.candidate.parameters, 1) / (6 * len(track.tau))
        variances = (weights * values**2).sum(0) / (weights.sum() * dof)
        sigma_t, sigma_r = np.sqrt([variances[:3].mean(), variances[3:].mean()]).tolist()
        sigmas = (max(sigma_t, rest_detection.SIGMA_FLOOR), max(sigma_r, rest_detection.SIGMA_FLOOR))
    assert best is not None
    return sigmas, best[1].robust


def _held_out(candidate: Candidate, track: Track, sigmas: tuple[float, float], outliers: np.ndarray) -> float:
    """Root mean square residual of the last poses after a fit to the first ones, in units of the noise."""
    count = len(track.tau)
    held = max(3, math.ceil(HELD_OUT * count)) if count >= 8 else max(1, count // 4)
    # At least a third of the six numbers per pose must remain to separate noise from motion.
    if candidate.parameters > 4 * (count - held):
        return math.inf
    solution = families.solve(candidate, track.rows(slice(0, count - held)), sigmas)
    tail = track.rows(slice(count - held, count))
    values = families.residuals(candidate, solution.theta[None], tail, sigmas)[0]
    weights = (tail.weights * np.maximum(outliers[count - held :], 1e-6))[:, None]
    score = math.sqrt(float((weights * values**2).sum() / (6 * weights.sum())))
    return score if math.isfinite(score) else math.inf
