"""Words to objects of a scene, with an encoder for words that the scene does not store."""

from __future__ import annotations

from .. import errors
from ..scene import lookup
from ..scene.lookup import Match
from ..scene.lookup_table import EncoderCard
from ..scene.scene import Scene
from . import encoders


def find(
    scene: Scene, text: str, encoder: encoders.Encoder | None = None, threshold: float = lookup.THRESHOLD
) -> list[Match]:
    """Objects that a text names or means, best first; none where nothing does.

    Args:
        scene: The scene; with a lookup table, words are also compared by meaning.
        text: One or several things: "red mug", "mugs and lemon".
        encoder: For words that the scene does not store: the one that made its table. Names, aliases and stored words
            need none.
        threshold: Least score of a match.

    Raises:
        BackendError: The encoder is another one, or the scene has no table for it.
    """
    return lookup.search(scene, text, threshold, _embed(scene, encoder))


def unanswered(
    scene: Scene, text: str, encoder: encoders.Encoder | None = None, threshold: float = lookup.THRESHOLD
) -> list[str]:
    """Phrases of a text that no object matches; arguments as of `find`."""
    meanings = lookup.Meanings.of(scene)
    return lookup.unanswered(lookup.labels_of(scene), text, threshold, meanings, _embed(scene, encoder))


def check(stored: EncoderCard, asked: EncoderCard, place: str) -> None:
    """Raise `BackendError` where an encoder is not the one that made a table."""
    if stored.digest != asked.digest or stored.kind != asked.kind:
        raise errors.BackendError(
            f"{place}: its lookup table was made by {_said(stored)}, and cannot be asked with {_said(asked)}; give "
            "the one that made it, or make the table again: r5dgs lookup SCENE --encoder DIR"
        )


def unknown(scene: Scene, text: str) -> list[str]:
    """Phrases of a text that only an encoder can answer: no name says them, and no stored word does."""
    return lookup.unknown(lookup.labels_of(scene), text, lookup.Meanings.of(scene))


def _embed(scene: Scene, encoder: encoders.Encoder | None) -> lookup.Embed | None:
    if encoder is None:
        return None
    if scene.lookup is None:
        raise errors.BackendError(
            f"{scene.name}: has no lookup table for an encoder; make one: r5dgs lookup SCENE --encoder DIR"
        )
    check(scene.lookup.encoder, encoder.card, scene.name)
    return lambda phrase: encoders.embed_phrases(encoder, [phrase])[0]


def _said(card: EncoderCard) -> str:
    return f"the {card.kind} encoder {card.name!r} (SHA-256 {card.digest[:12]}...)"
