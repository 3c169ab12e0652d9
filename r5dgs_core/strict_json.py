"""The one reader of JSON: bounded in size, depth and memory; every fault is one error of the caller's class.

Accepted content can be written as JSON again: numbers are finite and in range, and text is valid Unicode.
"""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path
from typing import Any

from .errors import R5dgsError

MOST_BYTES = 64 << 20  # of a file
MOST_MEMORY = 256 << 20  # of what the parser builds, as `memory_of` estimates it
MOST_DEPTH = 64
_MOST_DIGITS = 19  # of integers of 64 bits; Python limits what it converts to 4300


def parse(
    data: bytes,
    place: str,
    kind: type[R5dgsError],
    remedy: str = "is it truncated?",
    *,
    memory: int = MOST_MEMORY,
    size: int = MOST_BYTES,
) -> Any:
    """Parse JSON.

    Args:
        data: UTF-8 text.
        place: Start of messages: the file, or the member of a file.
        kind: Class of the error.
        remedy: End of messages about damage.
        memory: Limit of the memory that the result may take beside its text, bytes.
        size: Limit of the length of ``data``, bytes.

    Returns:
        Dictionaries, lists, strings, integers of 64 bits, finite floats, booleans and None.

    Raises:
        R5dgsError: Of class ``kind``: not JSON, too large, nested deeper than `MOST_DEPTH`, a key that occurs twice in
            an object, NaN, infinity, a number out of range, or half of a surrogate pair.
    """
    needed = memory_of(data)
    if len(data) > size or needed > memory:
        raise kind(
            f"{place}: expected JSON of at most {size >> 20} MiB that needs {memory >> 20} MiB of memory, found "
            f"{len(data) / 2**20:.1f} MiB that need about {needed / 2**20:.0f} MiB"
        )
    try:
        content = json.loads(
            data.decode("utf-8"),
            parse_constant=lambda constant: _refuse(constant, data),
            parse_float=_float,
            parse_int=_integer,
            object_pairs_hook=_object,
        )
        _check_depth(content)
        _check_text(data, content)
    except json.JSONDecodeError as error:
        fault = f"not valid JSON: {error.msg} at line {error.lineno}, column {error.colno}"
        raise kind(f"{place}: damaged, {fault}; {remedy}") from error
    except RecursionError as error:
        raise kind(f"{place}: damaged, JSON nested deeper than {MOST_DEPTH} levels; {remedy}") from error
    except ValueError as error:  # of `decode` and of the functions below
        raise kind(f"{place}: damaged, {error}; {remedy}") from error
    return content


def read(path: Path, kind: type[R5dgsError], remedy: str = "is it truncated?") -> Any:
    """Parse a JSON file, as `parse`; a missing or unreadable file is an error of class ``kind`` too."""
    try:
        with open(path, "rb") as stream:
            data = stream.read(MOST_BYTES + 1)
    except FileNotFoundError as error:
        raise kind(f"{path}: the file is missing") from error
    except OSError as error:
        raise kind(f"{path}: cannot be read ({error})") from error
    return parse(data, str(path), kind, remedy, size=MOST_BYTES)


def memory_of(data: bytes) -> int:
    """Return an upper bound of the memory of parsed values, without their text, from counts of separators; bytes."""
    return 240 * data.count(b"{") + 64 * (data.count(b"[") + data.count(b","))


def _refuse(constant: str, data: bytes) -> float:
    line = data.count(b"\n", 0, data.find(constant.encode())) + 1  # it may stand in a name before
    raise ValueError(f"expected finite numbers, found {constant} (line {line})")


def _float(text: str) -> float:
    value = float(text)
    if value in (float("inf"), -float("inf")):
        raise ValueError(f"the number {text[:40]} is out of range")
    return value


def _integer(text: str) -> int:
    value = int(text) if len(text) <= _MOST_DIGITS + 1 else 1 << 63
    if not -(1 << 63) <= value < 1 << 63:
        raise ValueError(f"the integer {text[:40]} has more than 64 bits")
    return value


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    result = dict(pairs)
    if len(result) < len(pairs):
        twice = Counter(key for key, _ in pairs).most_common(1)[0][0]
        raise ValueError(f"the key {twice[:60]!r} occurs twice in one object")
    return result


def _check_depth(content: Any) -> None:
    nodes = [content]
    for _ in range(MOST_DEPTH + 1):
        nodes = [
            child
            for node in nodes
            if isinstance(node, dict | list)
            for child in (node.values() if isinstance(node, dict) else node)
        ]
        if not nodes:
            return
    raise RecursionError


def _check_text(data: bytes, content: Any) -> None:
    """Refuse half surrogate pairs, which only an escape can bring into UTF-8."""
    if b"\\u" in data:
        json.dumps(content, ensure_ascii=False).encode()
