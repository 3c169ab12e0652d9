"""English text processing for names and prompts: plural normalisation and splitting into phrases."""

from __future__ import annotations

import re
import unicodedata

_FILLER = frozenset(("a", "an", "the", "this", "that", "these", "those", "of", "in", "on", "at", "my", "all", "any"))
# Counts before a noun are not part of its name; "mug two" keeps its number.
_COUNTS = frozenset(("both", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten", "some", "few"))
# Irregular plurals, and singulars that look like plurals.
_PLURALS = {
    **{"men": "man", "women": "woman", "children": "child", "people": "person", "lives": "life"},
    **{"feet": "foot", "teeth": "tooth", "geese": "goose", "mice": "mouse", "quizzes": "quiz"},
    **{f"{word}es": word for word in ("gas", "lens", "iris", "canvas", "atlas", "potato", "tomato", "mango", "hero")},
}
_NO_PLURALS = frozenset(("gas", "lens", "canvas", "atlas"))
_PLURAL_ENDINGS = (
    *((f"{start}ves", f"{start}f") for start in ("lea", "loa", "el", "hal", "cal", "wol", "scar", "hoo", "thie")),
    *(("knives", "knife"), ("wives", "wife")),
)
_SPLIT = re.compile(r"\s*(?:,|;|\+|&|/|\band\b|\bor\b|\bplus\b)\s*", re.IGNORECASE)


def words_of(text: str) -> list[str]:
    """Words in lower case without accents, normalised by `singular`; numbers are words."""
    plain = "".join(c for c in unicodedata.normalize("NFKD", text) if not unicodedata.combining(c))
    return [singular(word) for word in re.findall(r"[^\W_]+", plain.casefold())]


def singular(word: str) -> str:
    """Normalise an English noun so that singular and plural are spelled alike.

    The result is the singular, except for ambiguous plural endings: "cookies" and "berries" end alike, as do "caches"
    and "torches", "fuses" and "buses"; so "cookie", "cache" and "fuse" become "cooky", "cach" and "fus".
    """
    if word in _PLURALS:
        return _PLURALS[word]
    for plural, one in _PLURAL_ENDINGS:
        if word.endswith(plural):
            return word.removesuffix(plural) + one
    if word.endswith("s") and not word.endswith(("ss", "us", "is")) and word not in _NO_PLURALS and len(word) > 3:
        word = word[:-1]
    if len(word) > 3 and word.endswith("ie"):
        return word[:-2] + "y"
    if len(word) > 3 and (word.endswith(("che", "she", "xe", "sse", "ze")) or re.search("[^ao]use$", word)):
        return word[:-1]
    return word


def phrases(text: str) -> list[tuple[str, list[str]]]:
    """Phrases listed in a text: each as written, and its words without fillers and counts."""
    result = []
    for part in _SPLIT.split(" ".join(text.split())):  # the search below is quadratic in runs of spaces
        words = words_of(part)
        kept = [word for word in words if word not in _FILLER] or words
        while len(kept) > 1 and kept[0] in _COUNTS:
            kept = kept[1:]
        if kept:
            result.append((part.strip(), kept))
    return result
