"""Search of a pose track for its motion law and the breaks in it. Notation as in `model_selection`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..motion import rotations
from ..motion.pose_track import PoseTrack
from . import backtest, kinks, noise, slips
from . import candidates as families
from . import evidence as evidences
from .candidates import Candidate, Noise, Solution
from .evidence import Evidence

FREQUENCY_ERROR = 0.25  # maximum relative standard deviation of a determined frequency
_SEEN = 0.9  # minimum number of observed periods of each of two oscillations
_FEW = 8  # number of poses below which neither breaks nor large candidates are tried
_PER_POSE = 3  # maximum number of parameters per pose of a candidate for few poses
STEEP = 0.9  # cosine of the angle to the vertical below which a motion is vertical
_ROUNDS = 3  # rounds of noise estimation
_MEDIAN_SQUARE = 0.455  # median square of a normal variable with unit variance
_NOTHING_FITS = 9.0  # squared misfit of the best candidate above which the estimated noise is increased
_TOO_LARGE = 0.4  # variance of the residuals, in units of the noise, below which the noise is estimated again
_EXACT = 1e-4  # gain of a step below which the selected candidate is final
_CONTRADICTED = 3.0  # squared prediction error, relative to the best law's, above which a law is rejected
_SMALL_JUMP = 0.15  # relative change of the rates below which a break needs stronger evidence
_POOR = 3.0  # residuals' variance, relative to the noise, above which a track may have several breaks
_HOPELESS_LOSS = 200.0  # excess of the loss of a candidate above which it is not refitted
_HOPELESS = 30.0  # score excess of plain parts above which a track is not cut
_CUTS = 4  # number of breaks at which such a track is cut on trial
_FEWEST = 4  # minimum number of poses of its parts
_PLAIN = ("static", "translation + spin", "ballistic + spin", "drag")  # laws that determine the cut
_WELL = 1.5  # loss of a part, relative to that of noise, below which it is not searched again
_AHEAD = 1 / 3  # time past t_max, in spans, over which a law must be plausible
_RUNAWAY = 2.5  # distance in this time, relative to the largest observed, above which a law is not plausible
_LEAST_PART = 7  # minimum number of poses after a break to search them for a separate law


@dataclass(frozen=True)
class Selected:
    """Result of the selection: the chosen solution among all of the same part of a track.

    Attributes:
        chosen: Chosen solution, refined.
        solutions: All solutions.
        evidence: Noise level.
        track: The poses that they were fitted to.
        noise: Their noise.
        earlier: Solutions with events before the track of `chosen`, in order.
        first: Time of the first pose.
    """

    chosen: Solution
    solutions: tuple[Solution, ...]
    evidence: Evidence
    track: PoseTrack
    noise: Noise
    first: float
    earlier: tuple[Solution, ...] = ()


def select(
    track: PoseTrack, family: tuple[Candidate, ...], least: Noise, breaks: bool, up: np.ndarray | None
) -> Selected:
    """Fit four or more poses.

    Args:
        track: The poses.
        family: Laws to try.
        least: Lower bound of the noise.
        breaks: True to try breaks.
        up: See `model_selection.fit`.
    """
    level = noise.contrasts(track)
    level = Noise(max(level.place, least.place), max(level.turn, least.turn))
    most = 6 * len(track) - 6 if len(track) >= _FEW else _PER_POSE * len(track)
    tried = [c for c in family if c.parameters <= most] or [min(family, key=lambda c: c.parameters)]
    found, broken, slipped = _try_all(tried, track, level, breaks)
    coarser = _misfit((*found, *broken, *slipped))
    if (
        max(coarser) > _NOTHING_FITS
    ):  # if the noise is underestimated, the robust losses of all candidates are nearly equal
        level = level.scaled(*(math.sqrt(max(ratio, 1.0)) for ratio in coarser))
        found, broken, slipped = _try_all(tried, track, level, breaks)
    for _ in range(_ROUNDS):
        shares = _shares((*found, *broken, *slipped))
        if min(shares) > _TOO_LARGE:
            break
        finer = level.scaled(*(math.sqrt(min(share, 1.0)) for share in shares))
        finer = Noise(max(finer.place, least.place), max(finer.turn, least.turn))
        if finer.place > 0.9 * level.place and finer.turn > 0.9 * level.turn:
            break
        best = _best(found, broken, slipped)
        found = _refined(found, best, track, level, finer)
        slipped = _refined(slipped, best, track, level, finer)
        searched = isinstance(best.candidate, kinks.Kink)
        broken = kinks.search(track, finer) if searched else _refined(broken, best, track, level, finer)
        level = finer
    evidence = Evidence.of((*found, *broken, *slipped), _floor(level, least))
    laws = [s for s in found if _determined(s, evidence) and not _rises(s, up)] or found[:1]
    plausible = [s for s in laws if not runs_away(s, track)] or laws[:1]
    chosen = _simplest(plausible, evidence, track, level)
    smooth = [s for s in plausible if not s.candidate.events(s.theta)]
    if chosen.candidate.events(chosen.theta) and smooth:
        other = _simplest(smooth, evidence, track, level)
        chosen = other if evidence.score(chosen) + evidences.STRONG > evidence.score(other) else chosen
    if broken:
        best = min(broken, key=evidence.score)
        if evidence.score(best) + _margin(best) < min(evidence.score(s) for s in plausible):
            chosen = best
    if slipped:
        best = min(slipped, key=evidence.score)
        if evidence.score(best) < min(evidence.score(s) for s in (*laws, *broken)):
            chosen = best
    solutions = (*laws, *broken, *slipped)
    final = _again(chosen, track, level, _EXACT)
    solutions = tuple(final if s is chosen else s for s in solutions)
    whole = Selected(final, solutions, evidence, track, level, float(track.tau[0]))
    cut = _cut(whole, broken, family, up, _floor(level, least)) if broken and evidence.variance > _POOR else None
    return cut or _with_parts(whole, family, up)


def _try_all(
    tried: Sequence[Candidate], track: PoseTrack, level: Noise, breaks: bool
) -> tuple[list[Solution], list[Solution], list[Solution]]:
    """Fits of all laws, of all kinds of breaks, and of slips."""
    hopeless, solved = math.inf, {}
    for candidate in sorted(tried, key=lambda c: c.name not in _PLAIN):  # a good fit early on saves time later
        solution = solved[candidate.name] = families.solve(candidate, track, level, hopeless=hopeless)
        if solution is not None:
            hopeless = min(hopeless, _hopeless(solution))
    found = [s for c in tried if (s := solved[c.name]) is not None]
    found = found or [s for s in [families.solve(families.STATIC, track, level)] if s is not None]
    if not breaks or len(track) < _FEW:
        return found, [], []
    return found, kinks.search(track, level, hopeless), slips.search(track, level, hopeless)


def _hopeless(best: Solution) -> float:
    """Loss above which other candidates may end early, from that of a good one."""
    free = max(best.residuals.size - best.parameters, 1)
    return best.loss + families.HOPELESS_LOSS * max(1.0, best.loss / free)


def _misfit(solutions: Sequence[Solution]) -> tuple[float, float]:
    """Median squared position and rotation residuals per component, of the solution with the smallest ones."""
    medians = [np.median(s.residuals.reshape(-1, 2, 3) ** 2, 0).mean(-1) / _MEDIAN_SQUARE for s in solutions]
    place, turn = min(medians, key=lambda pair: float(np.prod(np.maximum(pair, 1.0))))
    return float(place), float(turn)


def _margin(kink: Solution) -> float:
    """Minimum evidence for a break; small jumps need more, because drifting tracks imitate them."""
    assert isinstance(kink.candidate, kinks.Kink)
    return evidences.STRONG * max(1.0, _SMALL_JUMP / max(kink.candidate.jump(kink.theta), 1e-3)) ** 2


def _floor(level: Noise, least: Noise) -> float:
    """Minimum variance of residuals in units of the noise, from the lower bound of the noise."""
    return min(least.place / level.place, least.turn / level.turn) ** 2


def _with_parts(whole: Selected, family: tuple[Candidate, ...], up: np.ndarray | None) -> Selected:
    """Search the parts before and after a break for more breaks, and the last part for a separate law.

    The break's own fit of a part is replaced only by one with strong evidence.
    """
    kink = whole.chosen.candidate
    if not isinstance(kink, kinks.Kink):
        return whole
    result = whole
    for rows in (slice(0, kink.gap), slice(kink.gap, None)):
        track = whole.track.rows(rows)
        loss, free = float(whole.chosen.losses[rows].sum()), 6 * len(track) - kink.law.parameters
        if len(track) < _LEAST_PART or loss < _WELL * min(whole.evidence.level, 1.0) * free:
            continue
        own = tuple(replace(candidate, window=track.window) for candidate in family)
        part = select(track, own, whole.noise, breaks=len(track) >= _FEW, up=up)
        level = replace(whole.evidence, count=len(track))
        shared = level.of_sums(loss, kink.law.parameters)
        if level.score(part.chosen) + evidences.STRONG > shared:
            continue
        if rows.start:
            result = replace(part, evidence=level, first=whole.first, earlier=(*result.earlier, whole.chosen))
        elif isinstance(part.chosen.candidate, kinks.Kink):
            # The kink of the whole track assumed one law before it: search again from the earlier break on.
            rest = whole.track.rows(slice(part.chosen.candidate.gap, None))
            own = tuple(replace(candidate, window=rest.window) for candidate in family)
            result = select(rest, own, whole.noise, breaks=len(rest) >= _FEW, up=up)
            return replace(result, first=whole.first, earlier=(*part.earlier, part.chosen, *result.earlier))
    return result


def _cut(
    whole: Selected, broken: Sequence[Solution], family: tuple[Candidate, ...], up: np.ndarray | None, least: float
) -> Selected | None:
    """Search the parts before and after the best break independently, for tracks that no candidate explains.

    Args:
        whole: Result of the whole track.
        broken: Breaks that were tried in it.
        family: Laws to try.
        up: See `model_selection.fit`.
        least: Minimum variance of the residuals.

    Returns:
        None if this is not clearly better than the best single candidate.
    """
    track, found = whole.track, []
    for kink in sorted(broken, key=lambda s: s.loss)[:_CUTS]:
        gap = kink.candidate.last_choice - kinks.LEAST_AFTER
        rows = (slice(0, gap), slice(gap, None))
        sides = [track.rows(row) for row in rows]
        if min(map(len, sides)) < _FEWEST or any(gap == other[1] for other in found):
            continue
        plain = [_plain(side, whole.noise) for side in sides]
        found.append((sum(s.loss + s.parameters for s in plain), gap, kink, sides, plain))
    if not found:
        return None
    _, _, kink, sides, plain = min(found, key=lambda entry: entry[:2])
    best = min(whole.solutions, key=whole.evidence.score)
    if _excess(plain, best, least) > _HOPELESS:
        return None
    parts = []
    for side in sides:
        own = tuple(replace(candidate, window=side.window) for candidate in family)
        parts.append(select(side, own, whole.noise, breaks=len(side) >= _FEW, up=up))
    before, after = parts
    pieces = (before.chosen, after.chosen)
    if _excess(pieces, best, least) > -evidences.STRONG:
        return None
    evidence = Evidence.of_parts(pieces, least)
    earlier = (*before.earlier, *([before.chosen] if before.chosen.candidate.placed else []), kink, *after.earlier)
    return replace(after, evidence=replace(evidence, count=len(after.track)), first=whole.first, earlier=earlier)


def _plain(track: PoseTrack, level: Noise) -> Solution:
    """Fit of the best plain law to a part of a track."""
    laws = (replace(families.BY_NAME[name], window=track.window) for name in _PLAIN)
    found = [s for law in laws if (s := families.solve(law, track, level)) is not None]
    return min(found, key=lambda s: s.loss + s.parameters)


def _excess(parts: Sequence[Solution], single: Solution, least: float) -> float:
    """Score of two parts of a track minus that of a single candidate, by the noise level of the parts."""
    evidence = Evidence.of_parts(parts, least)
    placed = 1 + sum(part.candidate.placed for part in parts)
    loss, parameters = sum(part.loss for part in parts), sum(part.parameters for part in parts)
    return evidence.of_sums(loss, parameters, placed) - evidence.score(single)


def _refined(
    solutions: Sequence[Solution], best: Solution, track: PoseTrack, level: Noise, finer: Noise
) -> list[Solution]:
    """Refits to the same poses with less noise; residuals of solutions far worse than the best are only rescaled."""
    scales = np.repeat([level.place / finer.place, level.turn / finer.turn], 3)
    return [
        _again(s, track, finer) if s.loss < best.loss + _HOPELESS_LOSS else replace(s, residuals=scales * s.residuals)
        for s in solutions
    ]


def _again(solution: Solution, track: PoseTrack, level: Noise, enough: float | None = None) -> Solution:
    """Refit a solution from its own parameters."""
    options = {} if enough is None else {"enough": enough, "steps": 40}
    return families.solve(solution.candidate, track, level, [solution.theta], **options) or solution


def _best(*groups: Sequence[Solution]) -> Solution:
    """Solution with the least loss per degree of freedom."""
    every = [s for group in groups for s in group]
    return min(every, key=lambda s: s.loss / max(s.residuals.size - s.parameters, 1))


def _shares(solutions: Sequence[Solution]) -> tuple[float, float]:
    """Variances of the position and rotation residuals of the best solution, in units of the noise."""
    best = _best(solutions)
    weights = (best.weights * best.robust)[:, None]
    free = max(1 - best.parameters / best.residuals.size, 0.1)
    means = (weights * best.residuals**2).sum(0) / (weights.sum() * free)
    return float(means[:3].mean()), float(means[3:].mean())


def _determined(solution: Solution, evidence: Evidence) -> bool:
    """Return True if the frequencies are inside their range and known to `FREQUENCY_ERROR`, or if none is free.

    For bounces, at least one flight between two of them must be longer than two gaps between poses. For a sum of
    oscillations, nearly a full period of each must be observed, because slower ones can imitate any curve.
    """
    candidate = solution.candidate
    rows = candidate.parts(np.arange(candidate.parameters))
    window = candidate.window
    if "bounce" in rows:
        times = [float(time.reshape(-1)[0]) for _, time in candidate.events(solution.theta)]
        return bool(len(times) < 2 or max(np.diff(times)) > 2 * -window.first / (evidence.count - 1))
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


def _simplest(laws: Sequence[Solution], evidence: Evidence, track: PoseTrack, level: Noise) -> Solution:
    """Law with the fewest parameters among those near the best whose refits to earlier poses predict the later ones.

    Evidence alone may follow small systematic errors of a track, which predicting later poses reveals. Among laws with
    equally many parameters, the evidence decides.
    """
    best = min(evidence.score(s) for s in laws)
    near = [s for s in laws if evidence.score(s) <= best + evidences.NEAR]
    misses = [backtest.relative_error(s, track, level, evidence.variance) for s in near]
    limit = _CONTRADICTED * max(min(misses), 1.0)
    fit = [s for s, miss in zip(near, misses, strict=True) if miss <= limit]
    return min(fit, key=lambda s: (s.parameters, evidence.score(s)))


def _rises(solution: Solution, up: np.ndarray | None) -> bool:
    """Return True for friction without spin on a vertical line, as of a body thrown upwards."""
    if up is None or solution.candidate.kind != "friction" or "w" in solution.candidate.blocks:
        return False
    v = solution.candidate.parts(solution.theta)["v"]
    return bool(abs(v @ up) > STEEP * np.linalg.norm(v) * np.linalg.norm(up))


def runs_away(solution: Solution, track: PoseTrack) -> bool:
    """Return True if the body would move or turn much further past t_max than in any equal observed time."""
    ends = np.searchsorted(track.tau, track.tau + _AHEAD)
    starts = np.flatnonzero(ends < len(track))
    if len(starts) == 0:
        return False
    ends, tau = ends[starts], track.tau
    ways = track.displacements[ends] - track.displacements[starts]
    seen = (ways**2).sum(-1) + 2 / 3 * ((track.turned[ends] - track.turned[starts]) ** 2).sum(-1)
    most = float(np.max(np.sqrt(seen) * _AHEAD / (tau[ends] - tau[starts])))
    quats, d = solution.candidate.path(solution.theta, np.linspace(0.0, _AHEAD, 9))
    angle = float(rotations.angle_between(quats[1:], quats[:-1]).sum())
    return bool(math.hypot(float(np.linalg.norm(d[-1] - d[0])), angle * math.sqrt(2 / 3)) > _RUNAWAY * most)


def few(track: PoseTrack, family: tuple[Candidate, ...]) -> Selected:
    """Fit two or three poses: the simplest of static, translation, spin and both with errors below a hundredth."""
    level = Noise(1e-2, 1e-2)
    allowed = [c for c in family if c.parameters <= 12 and not {"a", "kappa", "u"} & set(c.blocks)]
    fits = [families.solve(c, track, level, enough=1e-9) for c in allowed or [families.STATIC]]
    solutions = tuple(s for s in fits if s is not None)
    roots = [math.sqrt(float(s.squares.mean()) / 6) for s in solutions]
    index = next((i for i, root in enumerate(roots) if root <= 1.0), int(np.argmin(roots)))
    return Selected(solutions[index], solutions, Evidence(len(track), 1.0, 1.0), track, level, float(track.tau[0]))
