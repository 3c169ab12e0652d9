"""Search of a pose track for its motion law and the breaks in it. Notation as in `model_selection`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..motion import models
from ..motion.pose_track import PoseTrack
from . import backtest, breaks, model_scores, noise, plausibility, rough_bounces, slips
from . import candidates as families
from .candidates import Candidate, FittedCandidate, Noise
from .model_scores import NoiseLevel

FREQUENCY_ERROR = 0.25  # maximum relative standard deviation of a determined frequency
_FEW = 8  # number of poses below which neither breaks nor large candidates are tried
_PER_POSE = 3  # maximum number of parameters per pose of a candidate for few poses
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
_CUTS = 4  # maximum number of breaks at which such a track is tentatively cut
_MIN_SIDE_POSES = 4  # minimum number of poses on each side of such a break
_FEW_BLOCKS = {"v", "w"}  # blocks of laws for two or three poses
_WELL = 1.5  # loss of a part, relative to that of noise, below which it is not searched again
_MIN_PART_POSES = 7  # minimum number of poses after a break to search them for a separate law


@dataclass(frozen=True)
class Selected:
    """Result of the selection: the chosen solution among all of the same part of a track.

    Attributes:
        chosen: Chosen solution, refined.
        solutions: All solutions.
        noise_level: Noise level.
        track: The poses that they were fitted to.
        noise: Their noise.
        earlier: Solutions with events before the track of `chosen`, in order.
        first: Time of the first pose.
    """

    chosen: FittedCandidate
    solutions: tuple[FittedCandidate, ...]
    noise_level: NoiseLevel
    track: PoseTrack
    noise: Noise
    first: float
    earlier: tuple[FittedCandidate, ...] = ()


def select(
    track: PoseTrack, family: tuple[Candidate, ...], least: Noise, try_breaks: bool, up: np.ndarray | None
) -> Selected:
    """Fit four or more poses.

    Args:
        track: The poses.
        family: Laws to try.
        least: Lower bound of the noise.
        try_breaks: True to try breaks.
        up: See `model_selection.fit`.
    """
    level = noise.estimate(track)
    level = Noise(max(level.place, least.place), max(level.turn, least.turn))
    most = 6 * len(track) - 6 if len(track) >= _FEW else _PER_POSE * len(track)
    tried = [c for c in family if c.parameters <= most] or [min(family, key=lambda c: c.parameters)]
    found, broken, slipped = _try_all(tried, track, level, try_breaks)
    coarser = _misfit((*found, *broken, *slipped))
    # If the noise is underestimated, the robust losses of all candidates are nearly equal.
    if max(coarser) > _NOTHING_FITS:
        level = level.scaled(*(math.sqrt(max(ratio, 1.0)) for ratio in coarser))
        found, broken, slipped = _try_all(tried, track, level, try_breaks)
    for _ in range(_ROUNDS):
        shares = _residual_variances((*found, *broken, *slipped))
        if min(shares) > _TOO_LARGE:
            break
        finer = level.scaled(*(math.sqrt(min(share, 1.0)) for share in shares))
        finer = Noise(max(finer.place, least.place), max(finer.turn, least.turn))
        if finer.place > 0.9 * level.place and finer.turn > 0.9 * level.turn:
            break
        best = _best(found, broken, slipped)
        found = _refined(found, best, track, level, finer)
        slipped = _refined(slipped, best, track, level, finer)
        searched = isinstance(best.candidate, breaks.BreakCandidate)
        broken = breaks.search(track, finer) if searched else _refined(broken, best, track, level, finer)
        broken = rough_bounces.added(broken, track, finer, found)
        level = finer
    noise_level = NoiseLevel.of((*found, *broken, *slipped), _floor(level, least))
    laws = [s for s in found if _determined(s, noise_level) and plausibility.is_possible(s, up)] or found[:1]
    plausible = [s for s in laws if not plausibility.runs_away(s, track)] or laws[:1]
    chosen = _simplest(plausible, noise_level, track, level)
    smooth = [s for s in plausible if not s.candidate.events(s.theta)]
    if chosen.candidate.events(chosen.theta) and smooth:
        other = _simplest(smooth, noise_level, track, level)
        chosen = other if noise_level.score(chosen) + model_scores.STRONG > noise_level.score(other) else chosen
    broken = [s for s in broken if not plausibility.leans(s, up)]
    if broken:
        best = min(broken, key=noise_level.score)
        if all(noise_level.score(best) + _margin(best, s) < noise_level.score(s) for s in plausible):
            chosen = best
    if slipped:
        best = min(slipped, key=noise_level.score)
        if noise_level.score(best) < min(noise_level.score(s) for s in (*laws, *broken)):
            chosen = best
    solutions = (*laws, *broken, *slipped)
    final = _refit(chosen, track, level, _EXACT)
    solutions = tuple(final if s is chosen else s for s in solutions)
    whole = Selected(final, solutions, noise_level, track, level, float(track.tau[0]))
    cut = _cut(whole, broken, family, up, _floor(level, least)) if broken and noise_level.variance > _POOR else None
    return cut or _with_parts(whole, family, up)


def _try_all(
    tried: Sequence[Candidate], track: PoseTrack, level: Noise, try_breaks: bool
) -> tuple[list[FittedCandidate], list[FittedCandidate], list[FittedCandidate]]:
    """Fits of all laws, of all kinds of breaks, and of slips."""
    hopeless, solved = math.inf, {}
    for candidate in sorted(tried, key=lambda c: c.name not in families.PLAIN):  # a good fit early on saves time later
        solution = solved[candidate.name] = families.solve(candidate, track, level, hopeless=hopeless)
        if solution is not None:
            hopeless = min(hopeless, _hopeless(solution))
    found = [s for c in tried if (s := solved[c.name]) is not None]
    found = found or [s for s in [families.solve(families.STATIC, track, level)] if s is not None]
    if not try_breaks or len(track) < _FEW:
        return found, [], []
    broken = [*breaks.search(track, level, hopeless), *rough_bounces.search(track, level, found, hopeless)]
    return found, broken, slips.search(track, level, hopeless)


def _hopeless(best: FittedCandidate) -> float:
    """Loss above which other candidates may end early, from that of a good one."""
    free = max(best.residuals.size - best.parameters, 1)
    return best.loss + families.HOPELESS_LOSS * max(1.0, best.loss / free)


def _misfit(solutions: Sequence[FittedCandidate]) -> tuple[float, float]:
    """Median squared position and rotation residuals per component, of the solution with the smallest ones."""
    medians = [np.median(s.residuals.reshape(-1, 2, 3) ** 2, 0).mean(-1) / _MEDIAN_SQUARE for s in solutions]
    place, turn = min(medians, key=lambda pair: float(np.prod(np.maximum(pair, 1.0))))
    return float(place), float(turn)


def _margin(broken: FittedCandidate, law: FittedCandidate) -> float:
    """Minimum evidence for a break against a law; small jumps need more, because drifting tracks imitate them."""
    if isinstance(broken.candidate, rough_bounces.RoughBounces):
        return model_scores.NEAR if law.candidate.kind == broken.candidate.kind else model_scores.STRONG
    assert isinstance(broken.candidate, breaks.BreakCandidate)
    return model_scores.STRONG * max(1.0, _SMALL_JUMP / max(broken.candidate.jump(broken.theta), 1e-3)) ** 2


def _floor(level: Noise, least: Noise) -> float:
    """Minimum variance of residuals in units of the noise, from the lower bound of the noise."""
    return min(least.place / level.place, least.turn / level.turn) ** 2


def _with_parts(whole: Selected, family: tuple[Candidate, ...], up: np.ndarray | None) -> Selected:
    """Search the parts before and after a break for more breaks, and the last part for a separate law.

    The break's own fit of a part is replaced only by one with strong evidence.
    """
    first = whole.chosen.candidate
    if not isinstance(first, breaks.BreakCandidate):
        return whole
    result = whole
    for rows in (slice(0, first.gap), slice(first.gap, None)):
        track = whole.track.rows(rows)
        loss, free = float(whole.chosen.losses[rows].sum()), 6 * len(track) - first.law.parameters
        if len(track) < _MIN_PART_POSES or loss < _WELL * min(whole.noise_level.level, 1.0) * free:
            continue
        own = tuple(replace(candidate, window=track.window) for candidate in family)
        part = select(track, own, whole.noise, try_breaks=len(track) >= _FEW, up=up)
        level = replace(whole.noise_level, count=len(track))
        shared = level.of_sums(loss, first.law.parameters)
        if level.score(part.chosen) + model_scores.STRONG > shared:
            continue
        if rows.start:
            result = replace(part, noise_level=level, first=whole.first, earlier=(*result.earlier, whole.chosen))
        elif isinstance(part.chosen.candidate, breaks.BreakCandidate):
            # The break of the whole track assumed one law before it: search again from the earlier break on.
            rest = whole.track.rows(slice(part.chosen.candidate.gap, None))
            own = tuple(replace(candidate, window=rest.window) for candidate in family)
            result = select(rest, own, whole.noise, try_breaks=len(rest) >= _FEW, up=up)
            return replace(result, first=whole.first, earlier=(*part.earlier, part.chosen, *result.earlier))
    return result


def _cut(
    whole: Selected,
    broken: Sequence[FittedCandidate],
    family: tuple[Candidate, ...],
    up: np.ndarray | None,
    least: float,
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
    single = [s for s in broken if isinstance(s.candidate, breaks.BreakCandidate)]
    for solution in sorted(single, key=lambda s: s.loss)[:_CUTS]:
        gap = solution.candidate.poses_with_choices - breaks.MIN_POSES_AFTER
        rows = (slice(0, gap), slice(gap, None))
        sides = [track.rows(row) for row in rows]
        if min(map(len, sides)) < _MIN_SIDE_POSES or any(gap == other[1] for other in found):
            continue
        plain = [_plain(side, whole.noise) for side in sides]
        found.append((sum(s.loss + s.parameters for s in plain), gap, solution, sides, plain))
    if not found:
        return None
    _, _, broken_at, sides, plain = min(found, key=lambda entry: entry[:2])
    best = min(whole.solutions, key=whole.noise_level.score)
    if _excess(plain, best, least) > _HOPELESS:
        return None
    parts = []
    for side in sides:
        own = tuple(replace(candidate, window=side.window) for candidate in family)
        parts.append(select(side, own, whole.noise, try_breaks=len(side) >= _FEW, up=up))
    before, after = parts
    pieces = (before.chosen, after.chosen)
    if _excess(pieces, best, least) > -model_scores.STRONG:
        return None
    noise_level = NoiseLevel.of_parts(pieces, least)
    earlier = (
        *before.earlier,
        *([before.chosen] if before.chosen.candidate.discrete_choices else []),
        broken_at,
        *after.earlier,
    )
    return replace(after, noise_level=replace(noise_level, count=len(after.track)), first=whole.first, earlier=earlier)


def _plain(track: PoseTrack, level: Noise) -> FittedCandidate:
    """Fit of the best plain law to a part of a track."""
    laws = (replace(families.BY_NAME[name], window=track.window) for name in families.PLAIN)
    found = [s for law in laws if (s := families.solve(law, track, level)) is not None]
    return min(found, key=lambda s: s.loss + s.parameters)


def _excess(parts: Sequence[FittedCandidate], single: FittedCandidate, least: float) -> float:
    """Score of two parts of a track minus that of a single candidate, by the noise level of the parts."""
    noise_level = NoiseLevel.of_parts(parts, least)
    choices = 1 + sum(part.candidate.discrete_choices for part in parts)
    loss, parameters = sum(part.loss for part in parts), sum(part.parameters for part in parts)
    return noise_level.of_sums(loss, parameters, choices) - noise_level.score(single)


def _refined(
    solutions: Sequence[FittedCandidate], best: FittedCandidate, track: PoseTrack, level: Noise, finer: Noise
) -> list[FittedCandidate]:
    """Refits to the same poses with less noise; residuals of solutions far worse than the best are only rescaled."""
    scales = np.repeat([level.place / finer.place, level.turn / finer.turn], 3)
    return [
        _refit(s, track, finer) if s.loss < best.loss + _HOPELESS_LOSS else replace(s, residuals=scales * s.residuals)
        for s in solutions
    ]


def _refit(solution: FittedCandidate, track: PoseTrack, level: Noise, enough: float | None = None) -> FittedCandidate:
    """Refit a solution from its own parameters."""
    options = {} if enough is None else {"enough": enough, "steps": 40}
    return families.solve(solution.candidate, track, level, [solution.theta], **options) or solution


def _best(*groups: Sequence[FittedCandidate]) -> FittedCandidate:
    """Candidate with the least loss per degree of freedom."""
    every = [s for group in groups for s in group]
    return min(every, key=lambda s: s.loss / max(s.residuals.size - s.parameters, 1))


def _residual_variances(solutions: Sequence[FittedCandidate]) -> tuple[float, float]:
    """Variances of the position and rotation residuals of the best solution, in units of the noise."""
    best = _best(solutions)
    weights = (best.weights * best.robust)[:, None]
    free = max(1 - best.parameters / best.residuals.size, 0.1)
    means = (weights * best.residuals**2).sum(0) / (weights.sum() * free)
    return float(means[:3].mean()), float(means[3:].mean())


def _determined(solution: FittedCandidate, noise_level: NoiseLevel) -> bool:
    """Return True if the poses resolve the motion, and its frequencies are known to `FREQUENCY_ERROR`."""
    candidate, window = solution.candidate, solution.candidate.window
    kind = models.KINDS[candidate.kind]
    if not kind.resolved(candidate.parts(solution.theta), window, noise_level.count):
        return False
    for block in kind.frequency_blocks:
        if block not in candidate.rows:
            continue
        index = int(candidate.rows[block][0])
        frequency = float(window.frequency(solution.theta[index]))
        share = (frequency - window.low) / (window.high - window.low)
        deviation = math.sqrt(max(noise_level.variance * solution.inverse[index, index], 0.0))
        sigma = deviation * share * (1 - share) * (window.high - window.low)
        if not (0.01 < share < 0.99 and sigma < FREQUENCY_ERROR * frequency):
            return False
    return True


def _simplest(
    laws: Sequence[FittedCandidate], noise_level: NoiseLevel, track: PoseTrack, level: Noise
) -> FittedCandidate:
    """Law with the fewest parameters among those near the best whose refits to earlier poses predict the later ones.

    Scores alone may follow small systematic errors of a track, which predicting later poses reveals. Among laws with
    equally many parameters, the score decides.
    """
    best = min(noise_level.score(s) for s in laws)
    near = [s for s in laws if noise_level.score(s) <= best + model_scores.NEAR]
    misses = [backtest.relative_error(s, track, level, noise_level.variance) for s in near]
    limit = _CONTRADICTED * max(min(misses), 1.0)
    fit = [s for s, miss in zip(near, misses, strict=True) if miss <= limit]
    return min(fit, key=lambda s: (s.parameters, noise_level.score(s)))


def select_from_few_poses(track: PoseTrack, family: tuple[Candidate, ...]) -> Selected:
    """Fit two or three poses: the simplest of static, translation, spin and both with errors below a hundredth."""
    level = Noise(1e-2, 1e-2)
    allowed = [c for c in family if set(c.blocks) <= _FEW_BLOCKS]
    fits = [families.solve(c, track, level, enough=1e-9) for c in allowed or [families.STATIC]]
    solutions = tuple(s for s in fits if s is not None)
    roots = [math.sqrt(float(s.squares.mean()) / 6) for s in solutions]
    index = next((i for i, root in enumerate(roots) if root <= 1.0), int(np.argmin(roots)))
    return Selected(solutions[index], solutions, NoiseLevel(len(track), 1.0, 1.0), track, level, float(track.tau[0]))
