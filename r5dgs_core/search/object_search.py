"""Find objects by words, without any network: by names and aliases first, then by stored embeddings.

A query is split into phrases at "and", "," and the like, unless it is a name that contains such a word. Each phrase is
compared with every name and alias. `prompts` handles "everything", "not" and the like. Words match as a whole, in the
plural, as the beginning or a part of a longer name, or with a small typo. If no name matches a phrase completely, it is
also compared with the stored embeddings (`embedding_search`), if an embedding of the phrase is available.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from .. import errors
from ..scene.scene import Scene
from ..scene.stored_embeddings import StoredEmbeddings
from . import embedding_search as stored
from . import english, prompts, spelling

THRESHOLD = stored.PASS
EVERYTHING = "all"  # prefix of the reason of a match by "everything"
Embed = Callable[[str], np.ndarray | None]  # returns the unit embedding of a phrase [D], or None if unavailable
_SETTLED = 0.9  # minimum score of a complete match by name
_HEAD_WEIGHT = 0.65  # weight of the last word, the head noun: "coffee mug" is a mug


@dataclass(frozen=True)
class Match:
    """One object that matches a query.

    Attributes:
        object_id: Id of the object.
        score: In (0, 1], 1 for its exact name.
        why: Reason for display, such as "name 'mug'" or "alias 'cup', near 'cupp'".
        cosine: Cosine of the embeddings, None for a match by name.
        relevancy: See `embedding_search`; None for a match by name or without canonical phrases.
    """

    object_id: int
    score: float
    why: str
    cosine: float | None = None
    relevancy: float | None = None


@dataclass(frozen=True)
class Label:
    """Names of an object. Sufficient for `search_labels`, so search works without the scene file."""

    object_id: int
    name: str
    aliases: tuple[str, ...] = ()


def labels_of(scene: Scene) -> list[Label]:
    """Labels of a scene's objects, including the background."""
    return [Label(item.id, item.name, item.aliases) for item in scene.objects if item.id >= 0]


def search(scene: Scene, text: str, threshold: float = THRESHOLD, embed: Embed | None = None) -> list[Match]:
    """Find the objects that a text names or describes, best first.

    Args:
        scene: The scene; its stored embeddings are used for words in its vocabulary.
        text: One or several names: "red mug", "mugs and lemon".
        threshold: Minimum score of a match.
        embed: Returns the embedding of other words, from the encoder of the scene's embeddings.

    Returns:
        Matches with score >= threshold, ranked by score, then by id; empty if nothing matches.

    Raises:
        ConfigError: An excluded phrase has no match.
    """
    labels, embeddings = labels_of(scene), StoredEmbeddings.of(scene)
    check_exclusions(labels, text, not_excluded(labels, text, threshold, embeddings, embed))
    return search_labels(labels, text, threshold, embeddings, embed)


def search_labels(
    labels: Sequence[Label],
    text: str,
    threshold: float = THRESHOLD,
    embeddings: StoredEmbeddings | None = None,
    embed: Embed | None = None,
) -> list[Match]:
    """Same as `search`, on names and aliases, and on stored embeddings if given.

    Excluded phrases without a match are ignored here; the caller checks `not_excluded`.
    """
    prompt, best = _parsed(labels, text), {}
    if prompt.everything:
        why = f"{EVERYTHING} others" if prompt.excluded else EVERYTHING
        best = {label.object_id: Match(label.object_id, 1.0, why) for label in labels if label.object_id > 0}
    for match in _matches(labels, prompt.wanted, threshold, embeddings, embed):
        if match.object_id not in best or match.score > best[match.object_id].score:
            best[match.object_id] = match
    for match in _matches(labels, prompt.excluded, threshold, embeddings, embed):
        best.pop(match.object_id, None)
    return _ranked(best.values())


def unanswered(
    labels: Sequence[Label],
    text: str,
    threshold: float = THRESHOLD,
    embeddings: StoredEmbeddings | None = None,
    embed: Embed | None = None,
) -> list[str]:
    """Wanted phrases without a match; arguments as for `search_labels`."""
    wanted = _parsed(labels, text).wanted
    return [
        phrase
        for phrase, phrase_words in wanted
        if not _matches(labels, [(phrase, phrase_words)], threshold, embeddings, embed)
    ]


def not_excluded(
    labels: Sequence[Label],
    text: str,
    threshold: float = THRESHOLD,
    embeddings: StoredEmbeddings | None = None,
    embed: Embed | None = None,
) -> list[str]:
    """Excluded phrases without a match; arguments as for `search_labels`."""
    excluded = _parsed(labels, text).excluded
    return [
        phrase
        for phrase, phrase_words in excluded
        if not _matches(labels, [(phrase, phrase_words)], threshold, embeddings, embed)
    ]


def check_exclusions(labels: Sequence[Label], text: str, missing: Sequence[str]) -> None:
    """Reject a text with excluded phrases without a match, because it would select unintended objects.

    Args:
        labels: Labels of the objects.
        missing: Result of `not_excluded` for the text.

    Raises:
        ConfigError: ``missing`` is not empty.
    """
    if missing:
        raise errors.ConfigError(f"{text.strip()!r} excludes an unknown object: {explain_nothing(labels, missing[0])}")


def is_nothing(labels: Sequence[Label], text: str) -> bool:
    """True if a text selects no object at all, such as "none" and "not everything"."""
    prompt = _parsed(labels, text)
    return bool(english.words_of(text)) and not prompt.wanted and not prompt.everything


def unknown(labels: Sequence[Label], text: str, embeddings: StoredEmbeddings | None) -> list[str]:
    """Phrases that need an encoder: no name matches them completely and no stored word has an embedding for them."""
    prompt = _parsed(labels, text)
    return [
        phrase
        for phrase, phrase_words in (*prompt.wanted, *prompt.excluded)
        if not any(match.score >= _SETTLED for match in _named(labels, phrase_words))
        and (embeddings is None or vocabulary_row(embeddings.vocabulary, phrase_words) is None)
    ]


def suggest(labels: Sequence[Label], text: str, count: int = 3) -> list[str]:
    """Names and aliases that are similar to a text without matches.

    Args:
        labels: Labels of the objects.
        text: Text as typed.
        count: Maximum number of suggestions.

    Returns:
        The most similar name or alias of each object within a few typos of the text, best first.
    """
    ranked = []
    for label in labels:
        nearest = max(((_closeness(text, name), name) for name in (label.name, *label.aliases)), key=lambda c: c[0])
        if nearest[0] > 0:
            ranked.append((-nearest[0], label.object_id, nearest[1]))
    return [name for _, _, name in sorted(ranked)[:count]]


def explain_nothing(labels: Sequence[Label], text: str) -> str:
    """Message for a text without matches: similar names, else the existing names."""
    problem = f"nothing matches {text.strip()!r}"
    meant = suggest(labels, text)
    if meant:
        return f"{problem}; did you mean {' or '.join(repr(name) for name in meant)}?"
    return f"{problem}; the scene has: {', '.join(label.name for label in labels) or 'no objects'}"


def phrases_of(text: str) -> list[list[str]]:
    """Normalised words of each phrase of a text, without fillers."""
    return [words for _, words in english.phrases(text)]


def vocabulary_row(vocabulary: Sequence[str], phrase_words: Sequence[str]) -> int | None:
    """Row of the first vocabulary entry that equals a phrase, or None."""
    return _vocabulary_rows(tuple(vocabulary)).get(tuple(phrase_words))


@functools.lru_cache(maxsize=8)
def _vocabulary_rows(vocabulary: tuple[str, ...]) -> dict[tuple[str, ...], int]:
    """Row of each vocabulary entry that is a single phrase, by its normalised words."""
    rows: dict[tuple[str, ...], int] = {}
    for row, word in enumerate(vocabulary):
        said = phrases_of(word)
        if len(said) == 1:
            rows.setdefault(tuple(said[0]), row)
    return rows


def _parsed(labels: Sequence[Label], text: str) -> prompts.Prompt:
    return prompts.parse(text, [name for label in labels for name in (label.name, *label.aliases)])


def _matches(
    labels: Sequence[Label],
    phrases: Sequence[tuple[str, list[str]]],
    threshold: float,
    embeddings: StoredEmbeddings | None,
    embed: Embed | None,
) -> list[Match]:
    """Matches of any of the phrases with a score of at least ``threshold``."""
    found = [
        match
        for phrase, phrase_words in phrases
        for match in _phrase_matches(labels, phrase, phrase_words, embeddings, embed)
    ]
    return [match for match in found if match.score >= threshold]


def _phrase_matches(
    labels: Sequence[Label],
    phrase: str,
    phrase_words: list[str],
    embeddings: StoredEmbeddings | None,
    embed: Embed | None,
) -> list[Match]:
    """All matches of one phrase, regardless of score."""
    named = _named(labels, phrase_words)
    if embeddings is None or any(match.score >= _SETTLED for match in named):
        return named
    row = vocabulary_row(embeddings.vocabulary, phrase_words)
    query = embeddings.vocabulary_embeddings[row] if row is not None else embed(phrase) if embed is not None else None
    if query is None:
        return named
    known = {label.object_id: label for label in labels}
    meant = [one for one in stored.ask(embeddings, query) if one.object_id in known and one.object_id >= 0]
    if row is not None:  # a word with a stored embedding is not matched as a typo or prefix of another word
        fitting = {one.object_id for one in meant if one.score >= stored.PASS}
        named = [m for m in named if m.object_id in fitting or _ends_with(known[m.object_id], phrase_words[-1])]
    word = phrase if row is None else embeddings.vocabulary[row]
    return [*named, *(_by_meaning(one, word) for one in meant)]


def _by_meaning(one: stored.EmbeddingMatch, phrase: str) -> Match:
    why = f"meaning of {phrase!r} ({one.cosine:.2f})"
    return Match(one.object_id, one.score, why, one.cosine, one.relevancy)


def _named(labels: Sequence[Label], phrase_words: list[str]) -> list[Match]:
    asked = tuple(phrase_words)
    return [match for label in labels if (match := _match(label, asked)) is not None]


def _ends_with(label: Label, word: str) -> bool:
    """Return True if a word of a name ends with ``word``: a chessboard is a board."""
    return any(present.endswith(word) for name in (label.name, *label.aliases) for present in english.words_of(name))


def _ranked(matches: Iterable[Match]) -> list[Match]:
    return sorted(matches, key=lambda match: (-round(match.score, 6), match.object_id))


@functools.lru_cache(maxsize=1 << 14)  # several public functions repeat the same comparisons
def _match(label: Label, phrase_words: tuple[str, ...]) -> Match | None:
    """Best match among the object's name and aliases for one phrase; aliases have slightly less weight."""
    best: Match | None = None
    for kind, text, weight in (("name", label.name, 1.0), *(("alias", alias, 0.97) for alias in label.aliases)):
        words = english.words_of(text)
        if not words:
            continue
        table = [[spelling.similarity(word, present) for present in words] for word in phrase_words]
        whole = "".join(words)
        said = [max(*row, spelling.similarity(word, whole)) for word, row in zip(phrase_words, table, strict=True)]
        covered = said[0] if len(said) == 1 else _HEAD_WEIGHT * said[-1] + (1 - _HEAD_WEIGHT) * _mean(said[:-1])
        named = _mean([max(column) for column in zip(*table, strict=True)])
        # Unmatched words of the name cost little; unmatched words of the phrase cost much.
        score = weight * covered * (0.85 + 0.15 * named)
        if score > 0 and (best is None or score > best.score):
            spelled = "" if max(said) == 1 else f", near {' '.join(phrase_words)!r}"
            best = Match(label.object_id, score, f"{kind} {text!r}{spelled}")
    return best


def _mean(values: list[float]) -> float:
    return sum(values) / len(values)


def _closeness(text: str, name: str) -> float:
    """Similarity of two texts in [0, 1]: maximum over pairs of words and over all words joined."""
    asked = [word for phrase_words in phrases_of(text) for word in phrase_words]
    present = english.words_of(name)
    if not asked or not present:
        return 0.0
    pairs = [(a, b) for a in asked for b in present] + [("".join(asked), "".join(present))]
    return max(spelling.nearness(a, b) for a, b in pairs)
