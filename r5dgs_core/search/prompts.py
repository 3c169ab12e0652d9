"""Parse prompts with "everything", "nothing" and exclusions ("everything but the ball", "not the vase")."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass

from .. import errors
from . import english

MAX_LETTERS = 1000  # per prompt, to bound the cost, which grows with its length and the number of names
Phrase = tuple[str, list[str]]  # as written, and its words (`english.phrases`)

_THINGS = r"(?:\s+(?:of\s+)?(?:the|these|those|them|it|my))?(?:\s+(?:objects?|things?|items?))?"
_ALL = rf"(?:the\s+)?(?:everything|anything|all|every|each|any){_THINGS}"
_NONE = rf"(?:nothing|none{_THINGS}|no\s+(?:objects?|things?))"
_EVERYTHING = re.compile(_ALL, re.IGNORECASE)
_NOTHING = re.compile(_NONE, re.IGNORECASE)
# Words that exclude anywhere in a prompt.
_EXCEPT = re.compile(
    r"(?:\b(?:but|and)\s+|[,;]\s*)?\bnot\b|\bexcept(?:ing)?\b(?:\s+for\b)?|\bexcluding\b|\bother\s+than\b|\bapart\s+from\b",
    re.IGNORECASE,
)
# Words that exclude only at the beginning or after "everything": a "mug without a handle" is a mug.
_BUT = re.compile(
    rf"\s*(?:{_ALL}|{_NONE})?\s*(?P<but>\b(?:but|without|minus|besides)\b)|\s*(?:all|every|any)\b.*?(?P<late>\bbut\b)",
    re.IGNORECASE | re.DOTALL,
)


@dataclass(frozen=True)
class Prompt:
    """A parsed prompt.

    Attributes:
        wanted: Phrases of the objects to find, in addition to ``everything``.
        excluded: Phrases of the objects to leave out.
        everything: True if the prompt selects all objects.
    """

    wanted: tuple[Phrase, ...] = ()
    excluded: tuple[Phrase, ...] = ()
    everything: bool = False


def parse(text: str, names: Iterable[str] = ()) -> Prompt:
    """Parse a prompt.

    Args:
        names: Names of objects; a prompt that equals one selects only that, even "Not" or "all".

    Raises:
        UsageError: Nothing follows an excluding word, or the prompt is longer than `MAX_LETTERS`.
    """
    if len(text) > MAX_LETTERS:
        raise errors.UsageError(
            f"a prompt of {len(text)} letters: expected at most {MAX_LETTERS}; name fewer objects at a time"
        )
    known = {_spelled(name) for name in names}
    found = None if _spelled(text) in known else _first(text)
    if found is None:
        return _list(text, known)
    left, word, right = text[: found[0]].strip(" ,;"), text[slice(*found)].strip(" ,;"), text[found[1] :].strip()
    if not right:
        raise errors.UsageError(f"{text.strip()!r}: nothing to exclude after {word!r}; name an object after it")
    if _spelled(right) not in known:
        right = _EXCEPT.sub(" and ", right)  # "not the vase and not the ball" excludes both
    excluded = _list(right, known)
    if _NOTHING.fullmatch(left):  # "nothing but the mug" is the mug
        return excluded
    if excluded.everything:
        return Prompt()
    kept = Prompt(everything=True) if not left or _EVERYTHING.fullmatch(left) else _list(left, known)
    return Prompt(kept.wanted, excluded.wanted, kept.everything)


def _list(text: str, names: set[str]) -> Prompt:
    """Parse a text without excluding words: phrases, some of which may be names, "everything" or "nothing"."""
    words = english.words_of(text)
    if words and _spelled(text) in names:
        return Prompt(wanted=((text.strip(), words),))
    wanted, everything = [], False
    for said, words in english.phrases(text):
        named = _spelled(said) in names
        if not named and _EVERYTHING.fullmatch(said):
            everything = True
        elif named or not _NOTHING.fullmatch(said):
            wanted.append((said, words))
    return Prompt(tuple(wanted), everything=everything)


def _first(text: str) -> tuple[int, int] | None:
    """Start and end of the first excluding word, or None."""
    always, but = _EXCEPT.search(text), _BUT.match(text)
    spans = [always.span()] if always is not None else []
    spans += [but.span("but" if but["but"] else "late")] if but is not None else []
    return min(spans, default=None)


def _spelled(name: str) -> str:
    return " ".join(name.casefold().split())
