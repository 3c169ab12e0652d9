"""Embeddings of objects and words that are stored in a scene.

Notation: M objects, at most V views of an object, D numbers of an embedding, W words, C canonical phrases.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .lookup_table import LookupTable
from .scene import Scene


@dataclass(frozen=True)
class StoredEmbeddings:
    """Stored embeddings of a scene, for finding objects by words other than their names.

    Attributes:
        object_ids: Ids of the M objects, in the order of ``embeddings``.
        embeddings: One unit row per object, zero if it has none. [M, D]
        vocabulary: The W words with an embedding.
        vocabulary_embeddings: One unit row per word. [W, D]
        table: Metadata of the embeddings, None if the file has none.
        canonical_embeddings: One unit row per canonical phrase. [C, D] or None
        view_embeddings: For each object, one unit row per view, zero-padded. [M, V, D] or None
    """

    object_ids: tuple[int, ...]
    embeddings: np.ndarray
    vocabulary: tuple[str, ...]
    vocabulary_embeddings: np.ndarray
    table: LookupTable | None = None
    canonical_embeddings: np.ndarray | None = None
    view_embeddings: np.ndarray | None = None

    @classmethod
    def of(cls, scene: Scene) -> StoredEmbeddings | None:
        """Return the embeddings of a scene, or None if it stores none."""
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
