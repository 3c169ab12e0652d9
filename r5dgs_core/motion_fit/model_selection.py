"""Select the motion model of a group past t_max from its observed poses.

Every candidate law (`candidates`) and every kind of break in every gap (`breaks`) is fitted to all poses. They are
compared by their scores (`model_scores`): a break is chosen only with strong evidence, otherwise the simplest law near
the best one. After a break, the last part of the track is searched again. Notation: S poses, tau = t - t_max <= 0;
radius weights rotations against displacements.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..motion import models, rotations, torque_free_rotation
from ..motion.history import EMPTY, History
from ..motion.pose_track import PoseTrack
from . import band as bands
from . import candidates as families
from . import fitted_motion, model_scores, noise, search, simple_rules
from .candidates import Candidate, Noise
from .search import Selected


@dataclass(frozen=True)
class Score:
    """One row of the score table.

    Attributes:
        name: Name of the candidate.
        parameters: Number of its free parameters, including the six of the pose.
        evidence: Its score, see `model_scores`; infinite if it was not fitted, or if the poses do not determine the
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
        slips: Times at which the tracked rotation slipped by a constant turn, see `slips`.
        slipped: First and last time of the poses whose rotations are wrong by that turn.
    """

    model: models.MotionModel
    scores: tuple[Score, ...]
    chosen: str
    rested: bool
    sigma_t: float
    sigma_r: float
    history: History = EMPTY
    slips: tuple[float, ...] = ()
    slipped: tuple[tuple[float, float], ...] = ()


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
    drift: tuple[float, float] = (0.0, 0.0),
    up: np.ndarray | None = None,  # [3]
) -> Fit:
    """Fit all candidates to a pose track and select one.

    Args:
        times: Increasing, any spacing; the last is t_max. [S]
        quats: Rotations relative to the bind state, unit wxyz, any sign. [S, 4]
        displacements: Displacements of the pivot relative to the bind state, world units. [S, 3]
        radius: Radius of the group, world units, > 0.
        weights: Confidence of each pose, >= 0; 0 excludes a pose. None for equal weights. [S]
        candidates: Names in `candidates.BY_NAME`, without breaks; None for `candidates.FAMILY` and all breaks.
        inertia: Inertia of the group in the bind state, up to a factor (`torque_free_rotation.inertia`), or None. If
            given and not nearly that of a ball, the free top is a candidate. [3, 3]
        least_noise: Lower bounds of the noise of displacements (per component, world units) and rotations (rad), for
            noise that the scatter about a smooth motion does not show.
        drift: Standard deviations of displacements and rotations due to a slow drift; they widen the band alone.
        up: Upward direction, or None if unknown. Bodies bounce off level floors, and on a vertical line, friction
            stops none. [3]

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
    turns = rotations.make_continuous(rotations.normalize(quats[used]))
    shares = weights[used] / weights[used].mean()
    track = PoseTrack((times[used] - times[-1]) / span, turns, displacements[used] / radius, shares, _unit(up))
    if candidates is None and inertia is not None and torque_free_rotation.tumbles(np.asarray(inertia, np.float64)):
        family = (*family, replace(families.FREE_TOP, inertia=np.asarray(inertia, np.float64)))
    family = tuple(replace(candidate, window=track.window) for candidate in family)
    least = Noise(max(least_noise[0] / radius, noise.FLOOR), max(least_noise[1], noise.FLOOR))
    if len(track) < 4:
        selected = search.select_from_few_poses(track, family)
    else:
        selected = search.select(track, family, least, candidates is None, up)
    noise_of_drift = bands.drift_noise(least, Noise(drift[0] / radius, drift[1]))
    # A body that enters late has a short span; its band reaches as far as those of the other bodies.
    until = float(times[-1] - times[0]) / span
    return _result(selected, family, float(times[-1]), radius, span, noise_of_drift, until)


def _result(
    selected: Selected,
    family: tuple[Candidate, ...],
    t_max: float,
    radius: float,
    span: float,
    drift: Noise,
    until: float,
) -> Fit:
    """Fit in world units; ``drift`` and ``until`` are those of `band.confidence_band`."""
    chosen, noise_level, level = selected.chosen, selected.noise_level, selected.noise
    variance = model_scores.covariance_factor(chosen, selected.track, level, noise_level)
    widths = bands.confidence_band(selected, variance, drift, until)
    rule = simple_rules.better(selected.track, level, chosen) if widths.unknown else None
    predicted = rule or chosen
    model = fitted_motion.to_model(predicted, variance, radius, span)
    parts = [(part, fitted_motion.events(part, noise_level.variance, t_max, span)) for part in selected.earlier]
    parts.append((chosen, fitted_motion.events(chosen, variance, t_max, span)))
    found = tuple(event for _, own in parts for event in own)
    owners = [part for part, own in parts for _ in own]
    first = t_max + span * selected.first
    segments = fitted_motion.segments([*owners, chosen], found, first, t_max, radius, span)
    band = widths.scaled(t_max, radius, span)
    name = predicted.candidate.law.name
    rests = bool(found) and found[-1].kind == "stop"
    by_name = {s.candidate.name: s for s in selected.solutions}
    listed = {c.name: c.parameters for c in family} | {s.candidate.name: s.parameters for s in selected.solutions}
    table = []
    for each, parameters in listed.items():
        s = by_name.get(each)
        root = math.nan if s is None else math.sqrt(float((s.robust * s.squares).mean()) / 6)
        table.append(Score(each, parameters, math.inf if s is None else noise_level.score(s), root))
    scale = math.sqrt(noise_level.level)
    return Fit(
        model,
        tuple(table),
        chosen="static" if rests and rule is None else name,
        rested=rests,
        sigma_t=scale * level.place * radius,
        sigma_r=scale * level.turn,
        history=History(found, segments, band),
        slips=tuple(t_max + span * time for part, _ in parts for time in part.candidate.slip_times),
        slipped=tuple(
            (t_max + span * between[0], t_max + span * between[1])
            for part, _ in parts
            if (between := part.candidate.slipped) is not None
        ),
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


def _unit(up: np.ndarray | None) -> tuple[float, float, float] | None:
    if up is None:
        return None
    x, y, z = np.asarray(up, np.float64) / np.linalg.norm(up)
    return float(x), float(y), float(z)


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
