"""Search for a scene's objects by text, with an encoder for words that the scene does not store."""

from __future__ import annotations

from .. import errors
from ..scene import stored_embeddings
from ..scene.lookup_table import EncoderCard
from ..scene.scene import Scene
from ..search import object_search
from ..search.object_search import Match
from .encoders import encoder_base


def find(
    scene: Scene, text: str, encoder: encoder_base.Encoder | None = None, threshold: float = object_search.THRESHOLD
) -> list[Match]:
    """Find the objects that a text names or describes, best first; returns an empty list without matches.

    Args:
        scene: The scene; with a lookup table, words are also compared by embedding.
        text: One or several things: "red mug", "mugs and lemon".
        encoder: Encoder for words that the scene does not store: the one that made its table. Names, aliases and stored
            words work without it.
        threshold: Minimum score of a match.

    Raises:
        BackendError: The encoder did not make the scene's table, or the scene has no table.
    """
    return object_search.search(scene, text, threshold, _embed(scene, encoder))


def unanswered(
    scene: Scene, text: str, encoder: encoder_base.Encoder | None = None, threshold: float = object_search.THRESHOLD
) -> list[str]:
    """Phrases of a text that no object matches; arguments as in `find`."""
    embeddings = stored_embeddings.StoredEmbeddings.of(scene)
    return object_search.unanswered(object_search.labels_of(scene), text, threshold, embeddings, _embed(scene, encoder))


def check(stored: EncoderCard, asked: EncoderCard, place: str) -> None:
    """Raise `BackendError` if an encoder is not the one that made a table."""
    if stored.digest != asked.digest or stored.kind != asked.kind:
        raise errors.BackendError(
            f"{place}: its lookup table was made by {_describe(stored)}, and cannot be used with {_describe(asked)}; "
            "give the one that made it, or make the table again: r5dgs lookup SCENE --encoder DIR"
        )


def unknown(scene: Scene, text: str) -> list[str]:
    """Phrases of a text that need an encoder, because they are neither names nor stored words."""
    return object_search.unknown(object_search.labels_of(scene), text, stored_embeddings.StoredEmbeddings.of(scene))


def _embed(scene: Scene, encoder: encoder_base.Encoder | None) -> object_search.Embed | None:
    if encoder is None:
        return None
    if scene.lookup is None:
        raise errors.BackendError(
            f"{scene.name}: has no lookup table for an encoder; make one: r5dgs lookup SCENE --encoder DIR"
        )
    check(scene.lookup.encoder, encoder.card, scene.name)
    return lambda phrase: encoder_base.embed_phrases(encoder, [phrase])[0]


def _describe(card: EncoderCard) -> str:
    return f"the {card.kind} encoder {card.name!r} (SHA-256 {card.digest[:12]}...)"
