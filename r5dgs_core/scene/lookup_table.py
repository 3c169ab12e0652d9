"""Description of the embeddings that a scene stores: their encoder, their views, and the thresholds of a match.

Notation: D numbers of an embedding, C canonical phrases, as in `embedding_search`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

POOLINGS = ("mean", "max")


@dataclass(frozen=True)
class EncoderCard:
    """Which encoder made the embeddings, and how.

    Attributes:
        kind: "clip", "siglip", "open_clip" or "text".
        name: Name of its folder, for people.
        digest: SHA-256 of its weights, hexadecimal: queries have to come from the same ones.
        dimension: D.
        templates: Sentences with "{}" for the phrase; a phrase is the mean over them.
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
        """Whether it looks at pixels."""
        return self.kind != "text"


@dataclass(frozen=True)
class View:
    """What one embedding of an object was made of.

    Attributes:
        source: Name of the camera, or the phrase.
        threshold: Least cosine of a match with this embedding.
        t: Scene time of the picture, None for a phrase.
        box: What was cut out: left, top, right, bottom in pixels of that camera, None for a phrase.
    """

    source: str
    threshold: float
    t: float | None = None
    box: tuple[float, float, float, float] | None = None


@dataclass(frozen=True)
class Table:
    """What a scene stores about its embeddings, beside the numbers.

    Attributes:
        encoder: What made them.
        canonical: The C phrases that everything is compared with.
        views: Of each object of the scene's table, its views, the rows of `Scene.view_embeddings`; none for an object
            that has no embedding.
        thresholds: Least cosine of a match with each object's embedding, None for an object without.
        margin: How far below the best cosine others still match.
        pooling: What answers: "mean", the object's embedding, or "max", the best of its views.
    """

    encoder: EncoderCard
    canonical: tuple[str, ...]
    views: tuple[tuple[View, ...], ...]
    thresholds: tuple[float | None, ...]
    margin: float
    pooling: str

    def select(self, rows: Sequence[int]) -> Table:
        """The table for other objects, each by the row that it had."""
        return replace(
            self,
            views=tuple(self.views[row] for row in rows),
            thresholds=tuple(self.thresholds[row] for row in rows),
        )
