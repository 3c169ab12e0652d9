"""From which cosine on a phrase means an object: found with common nouns, most of which name something else.

Cosines of one encoder crowd together, and those of one object lie higher than those of another, so a cosine is counted
in standard deviations above the mean of the nouns' cosines with the same embedding. The limit in these units is such
that nouns which name something else pass it only as often as is allowed.

Sentence models take their limit from the nouns alone: each stands for an object in turn, so the scene has no part in
it. For models that see, it comes from the scene's own objects, as pictures and words of such models never come near.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from . import common_nouns

FALSE_ALARMS = 0.1  # of prompts for things that a scene does not hold, those that may find something
_MOST_EACH = 0.02  # of them, for one object
_LIKELY_TRUE = 0.03  # share of the nouns that may name an object of which nobody says what it is
_MARGIN = 2.0  # how far below the best cosine others match, in standard deviations: 1.5 to 2.5 find as much


@dataclass(frozen=True)
class Calibration:
    """What nouns say about embeddings.

    Attributes:
        limit: From how many standard deviations above the mean on a phrase is a match.
        thresholds: The same as a cosine, for each embedding. [R]
        margin: How far below the best cosine of a query others match.
    """

    limit: float
    thresholds: np.ndarray
    margin: float


def for_words(rows: np.ndarray, nouns: np.ndarray, objects: int) -> Calibration:
    """Calibrate embeddings of phrases.

    Args:
        rows: The embeddings, unit. [R, D]
        nouns: Embeddings of `common_nouns.words()`, unit. [W, D]
        objects: Objects of the scene that have an embedding.
    """
    words, things = common_nouns.words(), common_nouns.things()
    places = [words.index(thing) for thing in things]
    limit = _limit(standardize(nouns[places], nouns)[~common_nouns.relations()[places]], objects)
    return _calibration(rows, nouns, limit)


def for_pictures(rows: np.ndarray, nouns: np.ndarray, names: Sequence[Sequence[str]]) -> Calibration:
    """Calibrate embeddings of pictures.

    Args:
        rows: The objects' embeddings, unit. [R, D]
        nouns: Embeddings of `common_nouns.words()`, unit. [W, D]
        names: What is known of each object's name; a name that is no common noun says nothing. [R]
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
    return _calibration(rows, nouns, _limit(above[false], len(rows)))


def standardize(rows: np.ndarray, nouns: np.ndarray) -> np.ndarray:
    """How far each noun's cosine with an embedding lies above the mean of all nouns', in standard deviations. [R, W]"""
    cosines = np.asarray(rows, np.float64) @ np.asarray(nouns, np.float64).T
    return (cosines - cosines.mean(-1, keepdims=True)) / np.maximum(cosines.std(-1, keepdims=True), 1e-9)


def _limit(false: np.ndarray, objects: int) -> float:
    each = min(FALSE_ALARMS / max(objects, 1), _MOST_EACH)
    return float(np.quantile(false, 1 - each)) if false.size else 0.0


def _calibration(rows: np.ndarray, nouns: np.ndarray, limit: float) -> Calibration:
    cosines = np.asarray(rows, np.float64) @ np.asarray(nouns, np.float64).T
    if not len(cosines):
        return Calibration(limit, np.zeros(0), 0.0)
    spread = cosines.std(-1)
    return Calibration(limit, cosines.mean(-1) + limit * spread, float(_MARGIN * spread.mean()))
