"""JSON parser limited in size, depth and memory; every fault raises one error of the caller's class.

Accepted content can be written as JSON again: numbers are finite and in range, and text is valid Unicode.
"""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path
from typing import Any

from .errors import R5dgsError

MAX_BYTES = 64 << 20  # per file
MAX_MEMORY = 256 << 20  # bytes of parsed values, as estimated by `memory_of`
MAX_DEPTH = 64  # nesting levels
_DAMAGED = "write the file again, or copy it again"  # default remedy
_MAX_DIGITS = 19  # of a 64-bit integer; longer text is not converted, because that takes quadratic time


def parse(
    data: bytes,
    place: str,
    kind: type[R5dgsError],
    remedy: str = _DAMAGED,
    *,
    finite: bool = True,
    memory: int = MAX_MEMORY,
    size: int = MAX_BYTES,
) -> Any:
    """Parse JSON.

    Args:
        data: UTF-8 text.
        place: Start of error messages: the file, or the member of a file.
        kind: Class of the error.
        remedy: End of error messages about damage.
        finite: Reject NaN, infinity and floats out of range; otherwise the caller checks its numbers.
        memory: Memory limit of the result, without its text, bytes.
        size: Size limit of ``data``, bytes.

    Returns:
        Dictionaries, lists, strings, 64-bit integers, finite floats, booleans and None.

    Raises:
        R5dgsError: Of class ``kind``: invalid JSON, too large, nested deeper than `MAX_DEPTH`, a repeated key in an
            object, an unpaired surrogate, an integer of more than 64 bits, or a float that ``finite`` rejects.
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
            parse_constant=(lambda constant: _refuse(constant, data)) if finite else float,
            parse_float=_float if finite else float,
            parse_int=_integer,
            object_pairs_hook=_object,
        )
        _check_depth(content)
        _check_text(data, content)
    except json.JSONDecodeError as error:
        fault = f"not valid JSON: {error.msg} at line {error.lineno}, column {error.colno}"
        raise kind(f"{place}: damaged, {fault}; {remedy}") from error
    except RecursionError as error:
        raise kind(f"{place}: damaged, JSON nested deeper than {MAX_DEPTH} levels; {remedy}") from error
    except ValueError as error:  # from `decode` and the hooks
        raise kind(f"{place}: damaged, {error}; {remedy}") from error
    return content


def read(path: Path, kind: type[R5dgsError], remedy: str = _DAMAGED, *, finite: bool = True) -> Any:
    """Parse a JSON file, see `parse`; a missing or unreadable file is also an error of class ``kind``."""
    try:
        with open(path, "rb") as stream:
            data = stream.read(MAX_BYTES + 1)
    except FileNotFoundError as error:
        raise kind(f"{path}: the file is missing") from error
    except (OSError, ValueError) as error:  # ValueError: a null character in the path
        raise kind(f"{path}: cannot be read ({error})") from error
    return parse(data, str(path), kind, remedy, finite=finite, size=MAX_BYTES)


def memory_of(data: bytes) -> int:
    """Return an upper bound of the memory of parsed values, without their text, from separator counts; bytes."""
    return 240 * data.count(b"{") + 64 * (data.count(b"[") + data.count(b","))


def _refuse(constant: str, data: bytes) -> float:
    line = data.count(b"\n", 0, data.find(constant.encode())) + 1  # may be too small if a name contains the constant
    raise ValueError(f"expected finite numbers, found {constant} (line {line})")


def _float(text: str) -> float:
    value = float(text)
    if value in (float("inf"), -float("inf")):
        raise ValueError(f"the number {text[:40]} is out of range")
    return value


def _integer(text: str) -> int:
    value = int(text) if len(text) <= _MAX_DIGITS + 1 else 1 << 63
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
    for _ in range(MAX_DEPTH + 1):
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
    """Raise UnicodeEncodeError, a ValueError, for unpaired surrogates, which only an escape can encode in UTF-8."""
    if b"\\u" in data:
        json.dumps(content, ensure_ascii=False).encode()
