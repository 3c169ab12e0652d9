"""Embeddings of objects and words that a scene stores.

Notation: M objects, V views of an object at most, D numbers of an embedding, W words, C canonical phrases.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .lookup_table import Table
from .scene import Scene


@dataclass(frozen=True)
class Meanings:
    """Embeddings that a scene stores, by which words find objects that are called otherwise.

    Attributes:
        object_ids: Ids of the M objects, in the order of ``embeddings``.
        embeddings: One row per object, unit, zero for an object without. [M, D]
        vocabulary: The W words with an embedding.
        vocabulary_embeddings: One row per word, unit. [W, D]
        table: What is known about them, None in files that say nothing.
        canonical_embeddings: One row per canonical phrase, unit. [C, D] or None
        view_embeddings: Of each object, one row per view, unit, zero past the last. [M, V, D] or None
    """

    object_ids: tuple[int, ...]
    embeddings: np.ndarray
    vocabulary: tuple[str, ...]
    vocabulary_embeddings: np.ndarray
    table: Table | None = None
    canonical_embeddings: np.ndarray | None = None
    view_embeddings: np.ndarray | None = None

    @classmethod
    def of(cls, scene: Scene) -> Meanings | None:
        """Those of a scene; None where it stores none."""
        if scene.embeddings is None or scene.vocabulary_embeddings is None:
            return None
        return cls(
            tuple(item.id for item in scene.objects),
            scene.embeddings,
            scene.vocabulary,
            scene.vocabulary_embeddings,
            scene.lookup,
            scene.canonical_embeddings,
            scene.view_embeddings,
        )
