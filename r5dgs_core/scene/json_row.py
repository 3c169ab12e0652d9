"""Typed access to the objects of the JSON member of a scene file."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from .. import errors, findings


@dataclass(slots=True)
class Row:
    """Typed access to an object of the JSON member; each invalid entry is a separate fault.

    Attributes:
        data: The object.
        place: File, member and path to the object, for messages.
        guard: Context manager entered around each entry; entries whose errors it keeps are `findings.UNREAD`.
    """

    data: dict[str, Any]
    place: str
    guard: findings.Guard = findings.STRICT

    def get(self, key: str, kind: type) -> Any:
        """Value of a key with the given JSON type; integers are accepted as float."""
        with self.guard():
            value = self.data.get(key)
            if kind is float and isinstance(value, int) and not isinstance(value, bool):
                value = float(value)
            if not isinstance(value, kind) or (kind is not bool and isinstance(value, bool)):
                found = "nothing" if key not in self.data else repr(value)[:60]
                raise errors.SceneFileError(f"{self.place}: {key}: expected {kind.__name__}, found {found}")
            return value
        return findings.UNREAD

    def optional(self, key: str, kind: type) -> Any:
        """As `get`; None if the key is missing or null."""
        return None if self.lacks(key) else self.get(key, kind)

    def has(self, key: str) -> bool:
        """True if the key exists."""
        return self.data is not findings.UNREAD and key in self.data

    def lacks(self, key: str) -> bool:
        """True if the key is missing or null."""
        return self.data is not findings.UNREAD and self.data.get(key) is None

    def numbers(self, key: str, shape: tuple[int, ...]) -> np.ndarray:
        """Finite numbers of a given shape, float64."""
        with self.guard():
            value = self.data.get(key)
            try:
                array = np.array(value, np.float64)
            except (TypeError, ValueError):
                array = np.zeros(0)
            if array.shape != shape or not np.isfinite(array).all():
                raise errors.SceneFileError(
                    f"{self.place}: {key}: expected finite numbers of shape {shape}, found {value!r}"
                )
            return array
        return findings.UNREAD

    def floats(self, key: str, count: int) -> Any:
        """Tuple of ``count`` finite numbers."""
        values = self.numbers(key, (count,))
        return values if values is findings.UNREAD else tuple(values.tolist())

    def words(self, key: str) -> tuple[str, ...]:
        """Tuple of strings."""
        with self.guard():
            words = self.get(key, list)
            for word in words:
                if not isinstance(word, str):
                    raise errors.SceneFileError(f"{self.place}: {key}: expected words, found {word!r}")
            return tuple(words)
        return findings.UNREAD

    def each(self, key: str, reader: Callable[[Row], Any]) -> tuple[Any, ...]:
        """Objects of a list, each converted by ``reader``."""
        rows = self.get(key, list)
        if rows is findings.UNREAD:
            return rows
        for i, row in enumerate(rows):
            with self.guard():
                if not isinstance(row, dict):
                    raise errors.SceneFileError(f"{self.place}: {key}[{i}]: expected an object, found {row!r}")
        places = (f"{self.place}: {key}[{i}]" for i in range(len(rows)))
        return tuple(
            reader(Row(row, place, self.guard)) if isinstance(row, dict) else findings.UNREAD
            for row, place in zip(rows, places, strict=True)
        )
