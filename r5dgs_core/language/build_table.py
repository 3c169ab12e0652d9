"""Making the lookup table of a scene: what each object looks like or is called, as an encoder sees it.

Every object but the background gets an embedding. One that sees gets it from pictures of the object
(`best_views`), a sentence model from its name, aliases and caption. Beside them go words with their embeddings, so that
these are found without the encoder, and thresholds (`calibration`).
"""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from .. import errors
from ..scene.lookup_table import Table, View
from ..scene.scene import Scene, SceneObject
from ..search import english, object_search
from . import best_views, calibration, common_nouns
from .encoders import encoder_base

_NUMBERED = re.compile(r"^(?:object|obj|id|segment|instance|mask)?[\s_#.-]*\d+$", re.IGNORECASE)

Progress = Callable[[str, int, int], None]  # told what is done, how much of it, and of how much


@dataclass(frozen=True)
class Made:
    """A scene with a lookup table.

    Attributes:
        scene: The scene.
        notes: Sentences for the user: objects without an embedding and why.
    """

    scene: Scene
    notes: tuple[str, ...]


@dataclass(frozen=True)
class _Views:
    """Of one object: its V embeddings [V, D] and where they come from, thresholds not yet known."""

    embeddings: np.ndarray
    sources: tuple[View, ...]


def make(
    scene: Scene,
    encoder: encoder_base.Encoder,
    words: Sequence[str] = (),
    *,
    backend: str = "auto",
    progress: Progress | None = None,
) -> Made:
    """Give a scene a lookup table, in place of one that it has.

    Args:
        scene: The scene.
        encoder: The encoder; queries have to come from the same one.
        words: Words to store beside the objects' names and the common nouns.
        backend: Rasterizer.
        progress: Told of "views" and "objects" done, and their number.

    Returns:
        The scene with its table, and what there is to say.

    Raises:
        BackendError: No object has anything to embed.
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
    return Made(_assembled(scene, encoder, found, nouns, vocabulary, embeddings), tuple(notes))


def _from_words(
    items: Sequence[SceneObject], encoder: encoder_base.Encoder, progress: Progress | None
) -> tuple[dict[int, _Views], list[str]]:
    """What objects are called, each phrase an embedding."""
    found, nameless = {}, []
    for done, item in enumerate(items):
        phrases = [word for word in (item.name, *item.aliases, item.caption) if word.strip()]
        phrases = [word for word in dict.fromkeys(phrases) if not _NUMBERED.match(word.strip())]
        if phrases:
            found[item.id] = _Views(
                encoder_base.embed_phrases(encoder, phrases), tuple(View(phrase, 0.0) for phrase in phrases)
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
    """How objects look, each view an embedding: the mean of the object alone and in its place."""
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
                tuple(View(each.camera.name, 0.0, each.t, each.box) for each in own),
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
    """The words to store, each once, names first, and their embeddings."""
    named = [word for item in items for word in (item.name, *item.aliases)]
    known = {tuple(english.words_of(noun)): row for row, noun in enumerate(common_nouns.words())}
    chosen: dict[tuple[str, ...], str] = {}
    for word in (*named, *words, *common_nouns.words()):
        said = object_search.wishes(word)
        if len(said) == 1:  # what a query would cut is never looked up
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
    """The scene with everything in the rows of its objects."""
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
    table = Table(
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
        scene,
        embeddings=embeddings,
        vocabulary=vocabulary,
        vocabulary_embeddings=words,
        lookup=table,
        canonical_embeddings=_packed(encoder_base.embed_phrases(encoder, encoder_base.CANONICAL)),
        view_embeddings=views,
    )


def _packed(array: np.ndarray) -> np.ndarray:
    """Rounded to half precision, which a zip packs into two thirds; 1e-3 of a cosine is nothing."""
    return array.astype(np.float16).astype(np.float32)
