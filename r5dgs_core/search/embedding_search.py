"""What stored embeddings say about words: which objects a phrase means, how surely, and that it means none.

Notation: M objects, V views of an object at most, D numbers of an embedding, W words, C canonical phrases. An embedding
e of an object answers a phrase q by its cosine e . q, and by the relevancy of LERF, the least over the canonical
phrases c of exp(s e . q) / (exp(s e . q) + exp(s e . c)).

What a cosine is worth differs from encoder to encoder and from object to object, so each embedding has a threshold of
its own, calibrated where the table is made (`language.calibration`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from ..scene.stored_embeddings import Meanings

UNCALIBRATED = 0.25  # threshold of a file that says nothing about its encoder
PASS = 0.5  # score at the threshold
_BEST = 0.95  # score far above the threshold: below a name's
_SPREAD = 0.25  # of cosines, in a file that says nothing about its encoder
_MOST_EXPONENT = 700.0  # whose exponential is a number
_BESIDE = 0.4  # most of an object that fits far worse than another


@dataclass(frozen=True)
class Meant:
    """How well one object fits a phrase.

    Attributes:
        object_id: Id in the table.
        score: In [0, 0.95]; from `PASS` on it is a match.
        cosine: Of the embedding that answers with that of the phrase.
        relevancy: See the module, None where no canonical phrases are stored.
    """

    object_id: int
    score: float
    cosine: float
    relevancy: float | None


def ask(meanings: Meanings, query: np.ndarray) -> list[Meant]:
    """How well each object that has an embedding fits a phrase, the best first.

    An object whose cosine is more than the table's margin below the best one's is no match beside that one.

    Args:
        meanings: What the scene stores.
        query: Embedding of the phrase, unit. [D]
    """
    query, table = np.asarray(query, np.float64), meanings.table
    answers = [one for row in range(len(meanings.object_ids)) if (one := _answer(meanings, row, query)) is not None]
    if table is not None and answers:
        least = max(one.cosine for one in answers) - table.margin
        answers = [one if one.cosine >= least else replace(one, score=min(one.score, _BESIDE)) for one in answers]
    return sorted(answers, key=lambda one: (-round(one.score, 6), -one.cosine, one.object_id))


def relevancy(cosine: float, canonical: np.ndarray, scale: float) -> float:
    """LERF's, of a cosine with a phrase beside those with the canonical ones. canonical: [C]"""
    return float(1.0 / (1.0 + np.exp(min(-scale * (cosine - float(np.max(canonical))), _MOST_EXPONENT))))


def _answer(meanings: Meanings, row: int, query: np.ndarray) -> Meant | None:
    """The best that an object's embeddings say, None where it has none. query: float64"""
    rows, thresholds = _rows(meanings, row)
    if not len(rows):
        return None
    cosines = np.clip(rows @ query, -1, 1)
    best = int(np.argmax(cosines - thresholds))
    cosine, above = float(cosines[best]), float(cosines[best] - thresholds[best])
    table, canonical, found = meanings.table, meanings.canonical_embeddings, None
    if table is not None and canonical is not None and len(canonical):
        found = relevancy(cosine, canonical @ rows[best], table.encoder.scale)
    spread = _SPREAD if table is None else table.margin
    return Meant(meanings.object_ids[row], _score(above, spread), cosine, found)


def _score(above: float, spread: float) -> float:
    """Of a cosine that lies so far above the threshold: 0 far below it, `PASS` at it, `_BEST` far above."""
    share = math.exp(-min(abs(above) / max(spread, 1e-9), _MOST_EXPONENT))
    return PASS + (_BEST - PASS) * (1 - share) if above >= 0 else PASS * share


def _rows(meanings: Meanings, row: int) -> tuple[np.ndarray, np.ndarray]:
    """The embeddings that answer for an object and their thresholds; none where it has none. [R, D], [R]"""
    table, views = meanings.table, meanings.view_embeddings
    if table is None:
        own = np.asarray(meanings.embeddings[row], np.float64)[None]
        return (own if own.any() else own[:0]), np.full(int(own.any()), UNCALIBRATED)
    threshold = table.thresholds[row]
    if threshold is None:
        return np.zeros((0, table.encoder.dimension)), np.zeros(0)
    if table.pooling == "max" and views is not None and table.views[row]:
        count = len(table.views[row])
        return np.asarray(views[row, :count], np.float64), np.array([view.threshold for view in table.views[row]])
    return np.asarray(meanings.embeddings[row], np.float64)[None], np.array([threshold])
