"""Similarity of words that may be misspelled or incomplete."""

from __future__ import annotations

import difflib

_TYPO_RATIO = 0.75
_LETTERS_PER_SLIP = 3  # letters of the shorter word per allowed typo
_MAX_SLIPS = 3


def similarity(word: str, present: str) -> float:
    """Similarity of a query word to a word of a name: 1 if equal, 0.6 to 0.95 for a part or a typo, else 0.

    Parts of the name's word match ("glob" of "globe"); words that contain the name's do not ("cupboard" is not a cup).
    """
    if word == present:
        return 1.0
    if len(word) >= 3 and present.startswith(word):
        return 0.75 + 0.2 * len(word) / len(present)
    if len(word) >= 3 and word in present:
        return 0.6 + 0.2 * len(word) / len(present)
    shorter, longer = sorted((len(word), len(present)))
    if shorter < 4 or 2 * shorter < _TYPO_RATIO * (shorter + longer):  # upper bound of the ratio below
        return 0.0
    ratio = difflib.SequenceMatcher(None, word, present, autojunk=False).ratio()
    if sorted(word) == sorted(present):
        ratio = max(ratio, 0.85)  # transposed letters
    return 0.9 * ratio if ratio >= _TYPO_RATIO else 0.0


def nearness(word: str, other: str) -> float:
    """Similarity of two words: 1 if equal, less for each typo, 0 for more typos than their length allows."""
    shorter, longer = sorted((len(word), len(other)))
    excused = min(shorter // _LETTERS_PER_SLIP, _MAX_SLIPS)
    if longer - shorter > excused:
        return 0.0
    slips = edit_distance(word, other, excused)
    return 1 - slips / longer if slips <= excused else 0.0


def edit_distance(word: str, other: str, most: int) -> int:
    """Damerau-Levenshtein distance: inserted, missing or wrong letters, or two transposed ones.

    Args:
        word: One word.
        other: The other word.
        most: Upper limit; the cost grows with this times the length of the words.

    Returns:
        The distance, or ``most + 1`` if it is larger.
    """
    rows: list[dict[int, int]] = [{}, {j: j for j in range(min(len(other), most) + 1)}]
    for i, letter in enumerate(word, 1):
        last, before = rows
        row: dict[int, int] = {}
        for j in range(max(0, i - most), min(len(other), i + most) + 1):
            best = i if j == 0 else min(row.get(j - 1, most), before.get(j, most)) + 1
            if j > 0:
                best = min(best, before.get(j - 1, most + 1) + (letter != other[j - 1]))
            if i > 1 and j > 1 and letter == other[j - 2] and word[i - 2] == other[j - 1]:
                best = min(best, last.get(j - 2, most) + 1)
            row[j] = best
        rows = [before, row]
    return min(rows[1].get(len(other), most + 1), most + 1)
