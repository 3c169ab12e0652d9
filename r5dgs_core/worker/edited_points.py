"""Point edits of the worker's scenes: decoding of ``points`` requests, and scenes extended by the edited points."""

from __future__ import annotations

import base64
import binascii
import dataclasses
import operator
from typing import Any

import numpy as np

from .. import errors
from ..editing import point_edits
from ..editing.point_edits import Place, PointEdit
from ..protocol import fields
from ..protocol.messages import RenderRequest
from ..scene.instance import Instance
from ..scene.scene import Scene

Places = dict[tuple[int, str], Place]  # by scene number and edit key
_WIDTHS = {"means": 3, "quats": 4, "scales": 3, "base": 4}  # columns of each array; "sh" has any multiple of 3


class EditedPoints:
    """Point edits by key, and the scenes extended by the edits that a picture shows."""

    def __init__(self) -> None:
        self._edits: dict[str, PointEdit] = {}
        self._shown: tuple[list[Scene], list[tuple[int, str]]] = [], []  # scenes and edits of the last extension
        self._extended: tuple[list[Scene], Places] = [], {}

    def keep(self, request: dict[str, Any]) -> None:
        """Keep the edits with the keys in ``keep``, and drop all others.

        ``new`` holds the edits that the worker does not have yet. It maps a key to an object of base64 strings:
        ``rows`` (int32) and any of ``means quats scales base sh`` (float32).

        Raises:
            ConfigError: A key is neither kept nor new, or an edit cannot be decoded.
        """
        keys, new = fields.need(request, "keep", list), fields.need(request, "new", dict)
        decoded = {key: _edit_of(value) for key, value in new.items()}
        missing = [key for key in keys if not isinstance(key, str) or key not in decoded and key not in self._edits]
        if missing:
            raise errors.ConfigError(f"worker: 'points' refers to unknown edits {missing!r}")
        self._edits = {key: decoded[key] if key in decoded else self._edits[key] for key in keys}

    def extend(self, scenes: list[Scene], wanted: list[tuple[int, str]]) -> tuple[list[Scene], Places]:
        """Return the scenes extended by the edits that a picture shows; cached until scenes or edits change.

        Args:
            scenes: The loaded scenes.
            wanted: Scene number and key of each edit, without duplicates.

        Returns:
            The extended scenes (the same list object while nothing changes), and the place of each edit.

        Raises:
            ConfigError: An edit is missing, or does not fit its scene.
        """
        lost = [key for _, key in wanted if key not in self._edits]
        if lost:
            raise errors.ConfigError(f"worker: unknown point edits {lost!r}; send 'points' first")
        before, edits = self._shown
        if edits == wanted and len(before) == len(scenes) and all(map(operator.is_, before, scenes)):
            return self._extended
        self._shown = [], []
        extended, places = list(scenes), {}
        for number, scene in enumerate(scenes):
            keys = [key for other, key in wanted if other == number]
            try:
                extended[number], found = point_edits.extend(scene, [self._edits[key] for key in keys])
            except ValueError as error:
                raise errors.ConfigError(f"worker: {error}") from error
            places |= {(number, key): place for key, place in zip(keys, found, strict=True)}
        self._shown, self._extended = (list(scenes), list(wanted)), (extended, places)
        return self._extended


def wanted(request: RenderRequest) -> list[tuple[int, str]]:
    """Return scene number and key of each edit of a picture, without duplicates."""
    entries = zip(request.instances, request.edits, strict=True)
    return list(dict.fromkeys((one.scene, key) for one, key in entries if key is not None))


def placed(request: RenderRequest, places: Places) -> list[Instance]:
    """Return the instances of a picture, with the rows of edited ones."""
    return [
        one if key is None else _at(one, places[one.scene, key])
        for one, key in zip(request.instances, request.edits, strict=True)
    ]


def _at(instance: Instance, place: Place) -> Instance:
    return dataclasses.replace(instance, start=place.start, count=place.count, matrix=instance.matrix @ place.matrix)


def _edit_of(value: Any) -> PointEdit:
    if not isinstance(value, dict) or "rows" not in value or set(value) - {"rows", "sh", *_WIDTHS}:
        raise errors.ConfigError(f"worker: edited points need 'rows' and any of {', '.join(_WIDTHS)} and sh")
    rows = _array(value, "rows", "<i4")
    arrays = {name: _array(value, name, "<f4", width) for name, width in _WIDTHS.items() if name in value}
    if "sh" in value and len(rows):
        coefficients = _array(value, "sh", "<f4", 3)
        if len(coefficients) % len(rows):
            raise errors.ConfigError("worker: edited points have harmonics of another number of points")
        arrays["sh"] = coefficients.reshape(len(rows), -1, 3)
    return PointEdit(rows, **arrays)


def _array(value: dict[str, Any], name: str, dtype: str, width: int = 1) -> np.ndarray:
    """Decode an array of a request. [n] or [n, width]"""
    try:
        found = np.frombuffer(base64.b64decode(value[name], validate=True), dtype)
        return found.reshape(-1, width) if width > 1 else found
    except (TypeError, ValueError, binascii.Error):
        raise errors.ConfigError(f"worker: '{name}' of edited points has to be base64 of {dtype}") from None
