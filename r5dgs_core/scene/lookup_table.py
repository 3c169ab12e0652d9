"""Metadata of a scene's stored embeddings: encoder, views and match thresholds.

Notation: D numbers of an embedding, C canonical phrases, as in `embedding_search`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

POOLINGS = ("mean", "max")


@dataclass(frozen=True)
class EncoderCard:
    """Encoder that made the embeddings, and its settings.

    Attributes:
        kind: "clip", "siglip", "open_clip" or "text".
        name: Name of its folder, for display.
        digest: Hexadecimal SHA-256 of its weights; queries must use the same weights.
        dimension: D.
        templates: Sentences with "{}" for the phrase; the embedding of a phrase is the mean over them.
        scale: s of the relevancy, see `embedding_search`.
    """

    kind: str
    name: str
    digest: str
    dimension: int
    templates: tuple[str, ...]
    scale: float = 10.0

    @property
    def sees(self) -> bool:
        """True if the encoder has an image tower."""
        return self.kind != "text"


@dataclass(frozen=True)
class EmbeddingSource:
    """Source of one embedding of an object.

    Attributes:
        source: Name of the camera, or the phrase.
        threshold: Minimum cosine of a match with this embedding.
        t: Scene time of the image, None for a phrase.
        box: Crop of the image: left, top, right, bottom in pixels of that camera; None for a phrase.
    """

    source: str
    threshold: float
    t: float | None = None
    box: tuple[float, float, float, float] | None = None


@dataclass(frozen=True)
class LookupTable:
    """Metadata of a scene's embeddings.

    Attributes:
        encoder: Encoder that made them.
        canonical: The C phrases that every query is compared with.
        views: Views of each object, corresponding to the rows of `Scene.view_embeddings`; empty for an object without
            an embedding.
        thresholds: Minimum cosine of a match with each object's embedding, None for an object without one.
        margin: Maximum cosine difference from the best match at which other objects still match.
        pooling: Embeddings that are compared: "mean" for the object's own, "max" for the best of its views.
    """

    encoder: EncoderCard
    canonical: tuple[str, ...]
    views: tuple[tuple[EmbeddingSource, ...], ...]
    thresholds: tuple[float | None, ...]
    margin: float
    pooling: str

    def select(self, rows: Sequence[int]) -> LookupTable:
        """Table restricted to the given rows, in their order."""
        return replace(
            self,
            views=tuple(self.views[row] for row in rows),
            thresholds=tuple(self.thresholds[row] for row in rows),
        )
