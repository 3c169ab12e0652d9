"""Select the motion model of a group past t_max from its observed poses.

Every candidate law (`candidates`) and every kind of break in every gap (`kinks`) is fitted to all poses. The evidence
for each (`evidence`) decides: a break needs strong evidence, and of the laws without one, the simplest near the best is
taken. After a break, the last part of the track is searched again. Notation: S poses, tau = t - t_max <= 0; radius
weights rotations against displacements.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..motion import free_top, models, rotations
from ..motion.history import NONE, History
from ..motion.pose_track import PoseTrack
from . import band as bands
from . import candidates as families
from . import evidence as evidences
from . import fitted_motion, kinks, noise
from .candidates import Candidate, Noise, Solution
from .evidence import Evidence

HELD_OUT = 0.2  # share of the last poses in tests of shadows
FREQUENCY_ERROR = 0.25  # largest relative standard deviation of a determined frequency
_SEEN = 0.9  # periods of each of two oscillations that must be seen
_FEW = 8  # poses below which breaks are not searched, and large candidates not tried
_PER_POSE = 3  # parameters per pose of the largest candidate for few poses
STEEP = 0.9  # cosine of the angle to the vertical below which a motion is vertical
_ROUNDS = 3  # of the noise
_TOO_LARGE = 0.4  # variance of the residuals below which the noise is estimated again
_EXACT = 1e-4  # gain at which the selected candidate is final
_LEAST_PART = 7  # poses after a break that are searched for a law of their own


@dataclass(frozen=True)
class Score:
    """One row of the score table.

    Attributes:
        name: Name of the candidate.
        parameters: Number of its free parameters, including the six of the pose.
        evidence: Its score, see `evidence`; infinite if it was not fitted, or if the poses do not determine the
            frequency of an oscillation.
        fit: Root mean square of its residuals in units of the noise, or NaN if it was not fitted.
    """

    name: str
    parameters: int
    evidence: float
    fit: float


@dataclass(frozen=True)
class Fit:
    """A selected motion model with the evidence for it.

    Attributes:
        model: The motion past t_max.
        scores: The score table, in the order of the candidates; breaks last.
        chosen: Name of the law in `model`.
        rested: True if the body has come to rest, in which case `chosen` is "static".
        sigma_t: Noise of the displacements, per component, world units.
        sigma_r: Noise of the rotations, per component, rad.
        history: Events and segments in the observed window, and the confidence band past t_max.
    """

    model: models.MotionModel
    scores: tuple[Score, ...]
    chosen: str
    rested: bool
    sigma_t: float
    sigma_r: float
    history: History = NONE


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
    up: np.ndarray | None = None,  # [3]
) -> Fit:
    """Fit all candidates to a pose track and select one.

    Args:
        times: Increasing, any spacing; the last is t_max. [S]
        quats: Rotations relative to the bind state, unit wxyz, any sign. [S, 4]
        displacements: Displacements of the pivot relative to the bind state, world units. [S, 3]
        radius: Radius of the group, world units, > 0.
        weights: Confidence of each pose, >= 0; 0 excludes a pose. None for equal weights. [S]
        candidates: Names of candidates in `candidates.BY_NAME`, without breaks; None for `candidates.FAMILY` and breaks.
        inertia: Inertia of the group in the bind state, up to a factor (`free_top.inertia`), or None. If given and
            not nearly that of a ball, the free top is a candidate. [3, 3]
        least_noise: Lower bounds of the noise of displacements (per component, world units) and rotations (rad), if
            more is known than the scatter about a smooth motion shows.
        up: Upward direction, or None if unknown. A body that slows down on a vertical line falls back; on any other
            line, and if ``up`` is None, friction may stop it. [3]

    Returns:
        The fit. With fewer than four poses of positive weight, at most a velocity and a spin; with one, static.

    Source: selection by a Bayesian information criterion with Cauchy losses and an allowance for correlated noise;
        band from the covariance and from the spread of the near-best candidates.
    """
    times, quats, displacements = (np.asarray(x, np.float64) for x in (times, quats, displacements))
    weights = np.ones(len(times)) if weights is None else np.asarray(weights, np.float64)
    _check(times, quats, displacements, weights, radius)
    family = families.FAMILY if candidates is None else tuple(_named(name, inertia) for name in candidates)
    used = weights > 0
    if used.sum() < 2 or times[used][-1] == times[used][0]:
        return _static(radius)
    span = float(times[-1] - times[used][0])
    track = PoseTrack(
        (times[used] - times[-1]) / span,
        rotations.make_continuous(rotations.normalize(quats[used])),
        displacements[used] / radius,
        weights[used] / weights[used].mean(),
    )
    if candidates is None and inertia is not None and free_top.tumbles(np.asarray(inertia, np.float64)):
        family = (*family, replace(families.FREE_TOP, inertia=np.asarray(inertia, np.float64)))
    family = tuple(replace(candidate, window=track.window) for candidate in family)
    if len(track) < 4:
        selected = _few(track, family)
    else:
        least = Noise(max(least_noise[0] / radius, noise.FLOOR), max(least_noise[1], noise.FLOOR))
        selected = _select(track, family, least, candidates is None, up)
    return _result(selected, family, float(times[-1]), radius, span)


@dataclass(frozen=True)
class _Selected:
    """Result of the selection: the chosen solution among all of the same part of a track.

    Attributes:
        chosen: Chosen solution, refined.
        solutions: All solutions.
        evidence: Noise level.
        track: The poses that they were fitted to.
        noise: Their noise.
        before: Breaks before this part, with the track and evidence that they were found in.
    """

    chosen: Solution
    solutions: tuple[Solution, ...]
    evidence: Evidence
    track: PoseTrack
    noise: Noise
    before: tuple[tuple[Solution, Evidence], ...] = ()


def _select(
    track: PoseTrack, family: tuple[Candidate, ...], least: Noise, breaks: bool, up: np.ndarray | None
) -> _Selected:
    """Fit four or more poses, whose noise is at least ``least``."""
    level = noise.contrasts(track)
    level = Noise(max(level.place, least.place), max(level.turn, least.turn))
    most = 6 * len(track) - 6 if len(track) >= _FEW else _PER_POSE * len(track)
    tried = [c for c in family if c.parameters <= most] or [min(family, key=lambda c: c.parameters)]
    found = [s for c in tried if (s := families.solve(c, track, level)) is not None]
    found = found or [s for s in [families.solve(families.STATIC, track, level)] if s is not None]
    broken = kinks.search(track, level) if breaks and len(track) >= _FEW else []
    for _ in range(_ROUNDS):
        shares = _shares((*found, *broken))
        if min(shares) > _TOO_LARGE:
            break
        finer = level.scaled(*(math.sqrt(min(share, 1.0)) for share in shares))
        finer = Noise(max(finer.place, least.place), max(finer.turn, least.turn))
        if finer.place > 0.9 * level.place and finer.turn > 0.9 * level.turn:
            break
        level = finer
        gaps_matter = _best(found, broken).candidate.placed
        found = [_again(s, track, level) for s in found]
        broken = kinks.search(track, level) if gaps_matter else [_again(s, track, level) for s in broken]
    evidence = Evidence.of((*found, *broken))
    laws = [s for s in found if _determined(s, evidence) and not _rises(s, up)] or found[:1]
    chosen = evidences.simplest(laws, evidence)
    if broken:
        best = min(broken, key=evidence.score)
        if evidence.score(best) + evidences.STRONG < min(evidence.score(s) for s in laws):
            chosen = best
    solutions = (*laws, *broken)
    final = _again(chosen, track, level, _EXACT)
    solutions = tuple(final if s is chosen else s for s in solutions)
    return _Selected(final, solutions, evidence, track, level)


def _again(solution: Solution, track: PoseTrack, level: Noise, enough: float | None = None) -> Solution:
    """Refit a solution from its own parameters."""
    options = {} if enough is None else {"enough": enough, "steps": 40}
    return families.solve(solution.candidate, track, level, [solution.theta], **options) or solution


def _best(*groups: Sequence[Solution]) -> Solution:
    """Solution with the least loss per degree of freedom."""
    every = [s for group in groups for s in group]
    return min(every, key=lambda s: s.loss / max(s.residuals.size - s.parameters, 1))


def _shares(solutions: Sequence[Solution]) -> tuple[float, float]:
    """Variances of the place and turn residuals of the best solution, in units of the noise."""
    best = _best(solutions)
    weights = (best.weights * best.robust)[:, None]
    free = max(1 - best.parameters / best.residuals.size, 0.1)
    means = (weights * best.residuals**2).sum(0) / (weights.sum() * free)
    return float(means[:3].mean()), float(means[3:].mean())


def _determined(solution: Solution, evidence: Evidence) -> bool:
    """Return True if the frequencies are inside their range and known to `FREQUENCY_ERROR`, or if none is free.

    Of a sum of oscillations, nearly a full period of each must be seen, since slower ones can imitate any curve.
    """
    candidate = solution.candidate
    rows = candidate.parts(np.arange(candidate.parameters))
    window = candidate.window
    for block in ("pace", "pace2"):
        if block not in rows:
            continue
        index = int(rows[block][0])
        frequency = float(window.frequency(solution.theta[index]))
        if "pace2" in rows and frequency < _SEEN * 2 * math.pi / -window.first:
            return False
        share = (frequency - window.low) / (window.high - window.low)
        deviation = math.sqrt(max(evidence.variance * solution.inverse[index, index], 0.0))
        sigma = deviation * share * (1 - share) * (window.high - window.low)
        if not (0.01 < share < 0.99 and sigma < FREQUENCY_ERROR * frequency):
            return False
    return True


def _rises(solution: Solution, up: np.ndarray | None) -> bool:
    """Return True for friction without spin on a vertical line, which is the way of a body thrown upwards."""
    if up is None or solution.candidate.kind != "friction" or "w" in solution.candidate.blocks:
        return False
    v = solution.candidate.parts(solution.theta)["v"]
    return bool(abs(v @ up) > STEEP * np.linalg.norm(v) * np.linalg.norm(up))


def _few(track: PoseTrack, family: tuple[Candidate, ...]) -> _Selected:
    """Fit two or three poses: the simplest of static, translation, spin and both with errors below a hundredth."""
    level = Noise(1e-2, 1e-2)
    allowed = [c for c in family if c.parameters <= 12 and not {"a", "kappa", "u"} & set(c.blocks)]
    fits = [families.solve(c, track, level, enough=1e-9) for c in allowed or [families.STATIC]]
    solutions = tuple(s for s in fits if s is not None)
    roots = [math.sqrt(float(s.squares.mean()) / 6) for s in solutions]
    index = next((i for i, root in enumerate(roots) if root <= 1.0), int(np.argmin(roots)))
    return _Selected(solutions[index], solutions, Evidence(len(track), 1.0, 1.0), track, level)


def _result(selected: _Selected, family: tuple[Candidate, ...], t_max: float, radius: float, span: float) -> Fit:
    """Fit in world units."""
    chosen, evidence, level = selected.chosen, selected.evidence, selected.noise
    model = fitted_motion.to_model(chosen, evidence, radius, span)
    found = fitted_motion.events(chosen, evidence, t_max, span)
    first = t_max + span * float(selected.track.tau[0])
    band = bands.of(chosen, selected.solutions, evidence, selected.track, level).scaled(t_max, radius, span)
    name = chosen.candidate.law.name
    rests = bool(found) and found[-1].kind == "stop"
    by_name = {s.candidate.name: s for s in selected.solutions}
    listed = {c.name: c.parameters for c in family} | {s.candidate.name: s.parameters for s in selected.solutions}
    table = []
    for each, parameters in listed.items():
        s = by_name.get(each)
        root = math.nan if s is None else math.sqrt(float((s.robust * s.squares).mean()) / 6)
        table.append(Score(each, parameters, math.inf if s is None else evidence.score(s), root))
    scale = math.sqrt(evidence.level)
    return Fit(
        model,
        tuple(table),
        chosen="static" if rests else name,
        rested=rests,
        sigma_t=scale * level.place * radius,
        sigma_r=scale * level.turn,
        history=History(found, fitted_motion.segments(chosen, found, first, t_max, radius, span), band),
    )


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
    return Fit(model, scores, "static", False, 0.0, 0.0)
