"""Calibration of match thresholds: the minimum cosine of a phrase and an object, estimated from common nouns.

Cosines of one encoder lie close together, and their level differs between objects. A cosine is therefore standardized
by the mean and standard deviation of the nouns' cosines with the same embedding. The limit in these units is a quantile
of the nouns that name something else, so that false alarms stay below a given rate.

For sentence models, the limit comes from the nouns alone: each takes the role of an object, so the scene has no
influence. For image encoders, it comes from the scene's own objects, because embeddings of pictures and words lie far
apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from . import common_nouns

FALSE_ALARMS = 0.1  # accepted share of prompts for missing objects that still match an object
_MAX_FALSE_ALARMS_PER_OBJECT = 0.02  # the same for one object
_LIKELY_TRUE = 0.03  # assumed share of nouns that describe an object whose name is not a noun of the list
_MARGIN = 2.0  # distance of further matches below the best cosine, in standard deviations; 1.5 to 2.5 work as well


@dataclass(frozen=True)
class Thresholds:
    """Thresholds estimated from the cosines of nouns.

    Attributes:
        limit: Minimum of a match, in standard deviations above the mean.
        thresholds: Minimum cosine of a match, for each embedding. [R]
        margin: Accepted distance of further matches below a query's best cosine.
    """

    limit: float
    thresholds: np.ndarray
    margin: float


def for_words(rows: np.ndarray, nouns: np.ndarray, objects: int) -> Thresholds:
    """Calibrate embeddings of phrases.

    Args:
        rows: The embeddings, unit. [R, D]
        nouns: Embeddings of `common_nouns.words()`, unit. [W, D]
        objects: Number of objects with an embedding.
    """
    words, things = common_nouns.words(), common_nouns.things()
    places = [words.index(thing) for thing in things]
    limit = _limit(standardize(nouns[places], nouns)[~common_nouns.relations()[places]], objects)
    return _thresholds(rows, nouns, limit)


def for_pictures(rows: np.ndarray, nouns: np.ndarray, names: Sequence[Sequence[str]]) -> Thresholds:
    """Calibrate embeddings of pictures.

    Args:
        rows: The objects' embeddings, unit. [R, D]
        nouns: Embeddings of `common_nouns.words()`, unit. [W, D]
        names: Known names of each object; names that are not common nouns are ignored. [R]
    """
    words = common_nouns.words()
    above = standardize(rows, nouns)
    false = np.ones(above.shape, bool)
    for row, own in enumerate(names):
        known = [noun for name in own if (noun := common_nouns.known(name)) is not None]
        if known:
            false[row] = ~common_nouns.relations()[[words.index(noun) for noun in known]].any(0)
        else:
            false[row, np.argsort(above[row])[len(words) - round(_LIKELY_TRUE * len(words)) :]] = False
    return _thresholds(rows, nouns, _limit(above[false], len(rows)))


def standardize(rows: np.ndarray, nouns: np.ndarray) -> np.ndarray:
    """Standardize the nouns' cosines with each embedding: standard deviations above the nouns' mean. [R, W]"""
    cosines = np.asarray(rows, np.float64) @ np.asarray(nouns, np.float64).T
    return (cosines - cosines.mean(-1, keepdims=True)) / np.maximum(cosines.std(-1, keepdims=True), 1e-9)


def _limit(false: np.ndarray, objects: int) -> float:
    each = min(FALSE_ALARMS / max(objects, 1), _MAX_FALSE_ALARMS_PER_OBJECT)
    return float(np.quantile(false, 1 - each)) if false.size else 0.0


def _thresholds(rows: np.ndarray, nouns: np.ndarray, limit: float) -> Thresholds:
    cosines = np.asarray(rows, np.float64) @ np.asarray(nouns, np.float64).T
    if not len(cosines):
        return Thresholds(limit, np.zeros(0), 0.0)
    spread = cosines.std(-1)
    return Thresholds(limit, cosines.mean(-1) + limit * spread, float(_MARGIN * spread.mean()))
