"""Construction of a scene's lookup table: an embedding of each object, from its appearance or its names.

Every object except the background gets an embedding. Image encoders embed pictures of the object (`best_views`),
sentence models its name, aliases and caption. The table also stores words with their embeddings, which are found
without the encoder, and match thresholds (`calibration`).
"""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from .. import errors
from ..scene.lookup_table import EmbeddingSource, LookupTable
from ..scene.scene import Scene, SceneObject
from ..search import english, object_search
from . import best_views, calibration, common_nouns
from .encoders import encoder_base

_NUMBERED = re.compile(r"^(?:object|obj|id|segment|instance|mask)?[\s_#.-]*\d+$", re.IGNORECASE)

Progress = Callable[[str, int, int], None]  # called with the stage, the number of finished items, and their total


@dataclass(frozen=True)
class SceneWithTable:
    """A scene with a lookup table.

    Attributes:
        scene: The scene.
        notes: Sentences for the user: objects without an embedding, with the reason.
    """

    scene: Scene
    notes: tuple[str, ...]


@dataclass(frozen=True)
class _Views:
    """Embeddings of one object [V, D] and their sources; thresholds are not set yet."""

    embeddings: np.ndarray
    sources: tuple[EmbeddingSource, ...]


def make(
    scene: Scene,
    encoder: encoder_base.Encoder,
    words: Sequence[str] = (),
    *,
    backend: str = "auto",
    progress: Progress | None = None,
) -> SceneWithTable:
    """Add a lookup table to a scene, replacing an existing one.

    Args:
        encoder: The encoder; queries must use the same one.
        words: Words to store besides the objects' names and the common nouns.
        progress: Called for the stages "views" and "objects".

    Returns:
        The scene with its table, and notes for the user.

    Raises:
        BackendError: No object can be embedded.
    """
    items = [item for item in scene.objects if item.id > 0 and item.count]
    empty = [item.name for item in scene.objects if item.id > 0 and not item.count]
    if encoder.card.sees:
        found, notes = _from_pictures(scene, items, encoder, backend, progress)
    else:
        found, notes = _from_words(items, encoder, progress)
    if empty:
        notes.append(f"without Gaussians, and so without an embedding: {', '.join(empty)}")
    if not found:
        raise errors.BackendError(
            f"{scene.name}: no object has anything to embed; {'; '.join(notes) or 'the scene has no objects'}"
        )
    nouns = encoder_base.embed_phrases(encoder, common_nouns.words())
    vocabulary, embeddings = _vocabulary(items, words, encoder, nouns)
    return SceneWithTable(_assembled(scene, encoder, found, nouns, vocabulary, embeddings), tuple(notes))


def _from_words(
    items: Sequence[SceneObject], encoder: encoder_base.Encoder, progress: Progress | None
) -> tuple[dict[int, _Views], list[str]]:
    """Embed the names, aliases and captions of objects, one embedding per phrase."""
    found, nameless = {}, []
    for done, item in enumerate(items):
        phrases = [word for word in (item.name, *item.aliases, item.caption) if word.strip()]
        phrases = [word for word in dict.fromkeys(phrases) if not _NUMBERED.match(word.strip())]
        if phrases:
            found[item.id] = _Views(
                encoder_base.embed_phrases(encoder, phrases), tuple(EmbeddingSource(phrase, 0.0) for phrase in phrases)
            )
        else:
            nameless.append(item.name)
        if progress:
            progress("objects", done + 1, len(items))
    notes = (
        [f"without a name, alias or caption, and so without an embedding: {', '.join(nameless)}"] if nameless else []
    )
    return found, notes


def _from_pictures(
    scene: Scene, items: Sequence[SceneObject], encoder: encoder_base.Encoder, backend: str, progress: Progress | None
) -> tuple[dict[int, _Views], list[str]]:
    """Embed pictures of objects, one embedding per view: the mean of the isolated object and the object in place."""
    looked = None if progress is None else functools.partial(progress, "views")
    sightings = best_views.find(scene, [item.id for item in items], backend=backend, progress=looked)
    found, unseen = {}, []
    for done, item in enumerate(items):
        own = sightings.get(item.id, [])
        if own:
            shown = [best_views.crops(scene, item.id, each, backend=backend) for each in own]
            both = [encoder.embed_images(list(side)) for side in zip(*shown, strict=True)]
            found[item.id] = _Views(
                encoder_base.unit(np.mean(both, axis=0)),
                tuple(EmbeddingSource(each.camera.name, 0.0, each.t, each.box) for each in own),
            )
        else:
            unseen.append(item.name)
        if progress:
            progress("objects", done + 1, len(items))
    notes = [f"seen by no camera, and so without an embedding: {', '.join(unseen)}"] if unseen else []
    return found, notes


def _vocabulary(
    items: Sequence[SceneObject], words: Sequence[str], encoder: encoder_base.Encoder, nouns: np.ndarray
) -> tuple[tuple[str, ...], np.ndarray]:
    """Words to store, without duplicates, names first, and their embeddings."""
    named = [word for item in items for word in (item.name, *item.aliases)]
    known = {tuple(english.words_of(noun)): row for row, noun in enumerate(common_nouns.words())}
    chosen: dict[tuple[str, ...], str] = {}
    for word in (*named, *words, *common_nouns.words()):
        said = object_search.phrases_of(word)
        if len(said) == 1:  # queries are split, so a phrase of several parts is never looked up
            chosen.setdefault(tuple(said[0]), word.strip())
    fresh = [word for said, word in chosen.items() if said not in known]
    rows = dict(zip(fresh, encoder_base.embed_phrases(encoder, fresh), strict=True))
    stacked = [rows[word] if word in rows else nouns[known[said]] for said, word in chosen.items()]
    return tuple(chosen.values()), np.stack(stacked)


def _assembled(
    scene: Scene,
    encoder: encoder_base.Encoder,
    found: dict[int, _Views],
    nouns: np.ndarray,
    vocabulary: tuple[str, ...],
    words: np.ndarray,
) -> Scene:
    """Write embeddings, thresholds and words to the scene, in the rows of its objects."""
    rows = {item.id: row for row, item in enumerate(scene.objects)}
    most = max(len(own.sources) for own in found.values())
    shape = (len(scene.objects), encoder.card.dimension)
    embeddings, views = np.zeros(shape, np.float32), np.zeros((shape[0], most, shape[1]), np.float32)
    for object_id, own in found.items():
        embeddings[rows[object_id]] = encoder_base.unit(own.embeddings.mean(0))
        views[rows[object_id], : len(own.sources)] = own.embeddings
    embeddings, views, words = (_packed(array) for array in (embeddings, views, words))
    filled = [rows[object_id] for object_id in found]
    places = [(row, k) for row, own in zip(filled, found.values(), strict=True) for k in range(len(own.sources))]
    means, each = embeddings[filled], np.stack([views[place] for place in places])
    if encoder.card.sees:
        names = [(scene.objects[row].name, *scene.objects[row].aliases) for row in filled]
        by_row = dict(zip(filled, names, strict=True))
        whole = calibration.for_pictures(means, nouns, names)
        single = calibration.for_pictures(each, nouns, [by_row[row] for row, _ in places])
    else:
        whole, single = (calibration.for_words(some, nouns, len(found)) for some in (means, each))
    thresholds = dict(zip(filled, whole.thresholds.tolist(), strict=True))
    of_views = dict(zip(places, single.thresholds.tolist(), strict=True))
    sources = dict(zip(filled, (own.sources for own in found.values()), strict=True))
    table = LookupTable(
        encoder=encoder.card,
        canonical=encoder_base.CANONICAL,
        views=tuple(
            tuple(replace(view, threshold=of_views[row, k]) for k, view in enumerate(sources.get(row, ())))
            for row in range(len(scene.objects))
        ),
        thresholds=tuple(thresholds.get(row) for row in range(len(scene.objects))),
        margin=whole.margin,
        pooling="mean" if encoder.card.sees else "max",
    )
    return replace(
        scene.with_arrays(
            embeddings=embeddings,
            vocabulary_embeddings=words,
            canonical_embeddings=_packed(encoder_base.embed_phrases(encoder, encoder_base.CANONICAL)),
            view_embeddings=views,
        ),
        vocabulary=vocabulary,
        lookup=table,
    )


def _packed(array: np.ndarray) -> np.ndarray:
    """Round to half precision, which compresses to two thirds; the error of 1e-3 in a cosine is negligible."""
    return array.astype(np.float16).astype(np.float32)
