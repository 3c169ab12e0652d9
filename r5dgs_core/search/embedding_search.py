"""Match phrases to objects by stored embeddings, with calibrated scores.

Notation: M objects, at most V views of an object, D numbers of an embedding, W words, C canonical phrases. An object
embedding e is compared with a phrase embedding q by the cosine e . q and by LERF's relevancy, the minimum over the
canonical phrases c of exp(s e . q) / (exp(s e . q) + exp(s e . c)).

The scale of cosines differs between encoders and objects, so each embedding has its own threshold, calibrated when the
table is made (`language.calibration`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from ..scene.stored_embeddings import StoredEmbeddings

UNCALIBRATED = 0.25  # threshold for a file without encoder metadata
PASS = 0.5  # score at the threshold
_BEST = 0.95  # score far above the threshold, below that of a name match
_SPREAD = 0.25  # spread of cosines for a file without encoder metadata
_MAX_EXPONENT = 700.0  # largest exponent with a finite exponential
_BESIDE = 0.4  # maximum score of an object far below the best match


@dataclass(frozen=True)
class EmbeddingMatch:
    """Match of one object with a phrase.

    Attributes:
        object_id: Id of the object.
        score: In [0, 0.95]; a match if at least `PASS`.
        cosine: Cosine between the best embedding of the object and that of the phrase.
        relevancy: See the module; None if no canonical phrases are stored.
    """

    object_id: int
    score: float
    cosine: float
    relevancy: float | None


def ask(embeddings: StoredEmbeddings, query: np.ndarray) -> list[EmbeddingMatch]:
    """Score each object that has an embedding against a phrase, best first.

    An object whose cosine is more than the table's margin below the best one does not match.

    Args:
        embeddings: Stored embeddings of the scene.
        query: Embedding of the phrase, unit. [D]
    """
    query, table = np.asarray(query, np.float64), embeddings.table
    answers = [one for row in range(len(embeddings.object_ids)) if (one := _answer(embeddings, row, query)) is not None]
    if table is not None and answers:
        least = max(one.cosine for one in answers) - table.margin
        answers = [one if one.cosine >= least else replace(one, score=min(one.score, _BESIDE)) for one in answers]
    return sorted(answers, key=lambda one: (-round(one.score, 6), -one.cosine, one.object_id))


def relevancy(cosine: float, canonical: np.ndarray, scale: float) -> float:
    """LERF relevancy from the cosines of an object with a phrase and with the canonical phrases. canonical: [C]"""
    return float(1.0 / (1.0 + np.exp(min(-scale * (cosine - float(np.max(canonical))), _MAX_EXPONENT))))


def _answer(embeddings: StoredEmbeddings, row: int, query: np.ndarray) -> EmbeddingMatch | None:
    """Best match among an object's embeddings, or None if it has none. query: float64"""
    rows, thresholds = _rows(embeddings, row)
    if not len(rows):
        return None
    cosines = np.clip(rows @ query, -1, 1)
    best = int(np.argmax(cosines - thresholds))
    cosine, above = float(cosines[best]), float(cosines[best] - thresholds[best])
    table, canonical, found = embeddings.table, embeddings.canonical_embeddings, None
    if table is not None and canonical is not None and len(canonical):
        found = relevancy(cosine, canonical @ rows[best], table.encoder.scale)
    spread = _SPREAD if table is None else table.margin
    return EmbeddingMatch(embeddings.object_ids[row], _score(above, spread), cosine, found)


def _score(above: float, spread: float) -> float:
    """Score of a cosine relative to the threshold: 0 far below it, `PASS` at it, `_BEST` far above."""
    share = math.exp(-min(abs(above) / max(spread, 1e-9), _MAX_EXPONENT))
    return PASS + (_BEST - PASS) * (1 - share) if above >= 0 else PASS * share


def _rows(embeddings: StoredEmbeddings, row: int) -> tuple[np.ndarray, np.ndarray]:
    """Embeddings to compare for an object and their thresholds; empty if it has none. [R, D], [R]"""
    table, views = embeddings.table, embeddings.view_embeddings
    if table is None:
        own = np.asarray(embeddings.embeddings[row], np.float64)[None]
        return (own if own.any() else own[:0]), np.full(int(own.any()), UNCALIBRATED)
    threshold = table.thresholds[row]
    if threshold is None:
        return np.zeros((0, table.encoder.dimension)), np.zeros(0)
    if table.pooling == "max" and views is not None and table.views[row]:
        count = len(table.views[row])
        return np.asarray(views[row, :count], np.float64), np.array([view.threshold for view in table.views[row]])
    return np.asarray(embeddings.embeddings[row], np.float64)[None], np.array([threshold])
