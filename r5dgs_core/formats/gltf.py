"""Binary glTF 2.0 files (`.glb`): arrays in a buffer, and the JSON that refers to them."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from .. import errors, strict_json

SUFFIX = ".glb"
_MAGIC, _VERSION, _JSON, _BIN = 0x46546C67, 2, 0x4E4F534A, 0x004E4942
_HEADER, _CHUNK = 12, 8  # bytes
_VERTICES = 34962  # target of buffer views of vertex attributes
_INDICES = 34963  # of buffer views of indices
_COMPONENTS = {"f4": 5126, "u1": 5121, "u4": 5125}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_ALIGNMENT = 4
MAX_SIZE = (1 << 32) - 1  # sizes in the header have 32 bits


@dataclass
class Arrays:
    """Arrays of a file in the making, one buffer view and accessor each.

    Attributes:
        blobs: Content of the buffer.
        views: JSON of the buffer views.
        accessors: JSON of the accessors.
        size: Bytes of the buffer.
    """

    blobs: list[bytes] = field(default_factory=list)
    views: list[dict[str, int]] = field(default_factory=list)
    accessors: list[dict[str, Any]] = field(default_factory=list)
    size: int = 0

    def add(self, values: np.ndarray, *, vertices: bool = False, bounds: bool = False) -> int:
        """Add an array and return the number of its accessor.

        Args:
            values: Numbers or vectors, float or uint8 (normalised), or indices, uint32. [N] or [N, 2..4]
            vertices: True for a vertex attribute.
            bounds: True to state minimum and maximum.
        """
        kind = {np.dtype(np.uint8): "u1", np.dtype(np.uint32): "u4"}.get(values.dtype, "f4")
        stored = np.ascontiguousarray(values, f"<{kind}")
        blob = stored.tobytes()
        view = {"buffer": 0, "byteOffset": self.size, "byteLength": len(blob)}
        target = _VERTICES if vertices else _INDICES if kind == "u4" else None
        self.views.append(view if target is None else view | {"target": target})
        self.blobs.append(blob + bytes(-len(blob) % _ALIGNMENT))
        self.size += len(self.blobs[-1])
        width = 1 if stored.ndim == 1 else stored.shape[1]
        entry: dict[str, Any] = {
            "bufferView": len(self.views) - 1,
            "componentType": _COMPONENTS[kind],
            "count": len(stored),
            "type": next(name for name, size in _WIDTHS.items() if size == width),
        }
        if kind == "u1":
            entry["normalized"] = True
        if bounds:
            entry["min"], entry["max"] = (np.atleast_1d(end(stored, axis=0)).tolist() for end in (np.min, np.max))
        self.accessors.append(entry)
        return len(self.accessors) - 1


def write(stream: BinaryIO, content: Mapping[str, Any], arrays: Arrays) -> None:
    """Write a file.

    Args:
        stream: Target.
        content: JSON without buffers, buffer views and accessors; finite numbers.
        arrays: The arrays.

    Raises:
        SceneFileError: The file would be larger than 4 GiB.
    """
    tree = dict(content)
    if arrays.views:
        tree |= {"accessors": arrays.accessors, "bufferViews": arrays.views, "buffers": [{"byteLength": arrays.size}]}
    text = json.dumps(tree, separators=(",", ":"), allow_nan=False, ensure_ascii=False).encode()
    text += b" " * (-len(text) % _ALIGNMENT)
    size = _HEADER + _CHUNK + len(text) + (_CHUNK + arrays.size if arrays.views else 0)
    if size > MAX_SIZE:
        raise errors.SceneFileError(f"the file would need {size / 2**30:.1f} GiB; glTF files have at most 4")
    stream.write(struct.pack("<III", _MAGIC, _VERSION, size))
    stream.write(struct.pack("<II", len(text), _JSON) + text)
    if arrays.views:
        stream.write(struct.pack("<II", arrays.size, _BIN))
        for blob in arrays.blobs:
            stream.write(blob)


@dataclass(frozen=True)
class Content:
    """Content of a file.

    Attributes:
        place: Path, for messages.
        tree: The JSON.
        buffer: The binary chunk.
    """

    place: str
    tree: dict[str, Any]
    buffer: bytes

    def error(self, message: str) -> errors.SceneFileError:
        """Error about a place in the file."""
        return errors.SceneFileError(f"{self.place}: {message}")

    def items(self, key: str) -> list[dict[str, Any]]:
        """Objects of a list at the top of the JSON; empty if it is missing. Raises `SceneFileError`."""
        found = self.tree.get(key, [])
        if not isinstance(found, list) or not all(isinstance(item, dict) for item in found):
            raise self.error(f"{key}: expected a list of objects, found {found!r:.60}")
        return found

    def item(self, key: str, number: Any, user: str) -> dict[str, Any]:
        """Object of a list at the top by its number. Raises `SceneFileError` that names its user."""
        found = self.items(key)
        if not isinstance(number, int) or isinstance(number, bool) or not 0 <= number < len(found):
            wanted = f"expected a number below {len(found)} of {key}"
            raise self.error(f"{user}: {wanted}, found {number!r:.60}")
        return found[number]

    def floats(self, number: Any, width: int, user: str) -> np.ndarray:
        """Finite numbers of an accessor, tightly packed float32. [N] for a width of 1, else [N, width]

        Raises:
            SceneFileError: The accessor has another layout, or exceeds the buffer.
        """
        entry = self.item("accessors", number, user)
        kind = next(name for name, size in _WIDTHS.items() if size == width)
        found = (entry.get("componentType"), entry.get("type"))
        if found != (_COMPONENTS["f4"], kind) or "sparse" in entry:
            raise self.error(f"{user}: expected float32 of type {kind}, found {found!r:.60}")
        view = self.item("bufferViews", entry.get("bufferView"), user)
        numbers = [entry.get("count"), entry.get("byteOffset", 0), view.get("byteOffset", 0), view.get("byteLength")]
        if not all(type(value) is int and value >= 0 for value in numbers) or view.get("buffer") != 0:
            raise self.error(f"{user}: expected sizes and offsets >= 0, found {numbers!r:.80}")
        count, inside, start, length = numbers
        needed = 4 * width * count
        if view.get("byteStride", 4 * width) != 4 * width or inside + needed > length or inside % 4:
            raise self.error(f"{user}: expected {needed} packed bytes in its buffer view")
        if start + length > len(self.buffer):
            raise self.error(
                f"{user}: expected {start + length} bytes of data, found {len(self.buffer)}; the file is truncated"
            )
        values = np.frombuffer(self.buffer, "<f4", width * count, start + inside)
        if not np.isfinite(values).all():
            raise self.error(f"{user}: expected finite numbers, found NaN or infinity")
        return values if width == 1 else values.reshape(count, width)


def read(path: str | Path) -> Content:
    """Read a file. Raises `SceneFileError` if it is of another kind, or damaged."""
    place = str(path)
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        raise errors.SceneFileError(f"{place}: cannot be read: {error}") from error
    if len(data) < _HEADER + _CHUNK or struct.unpack_from("<II", data) != (_MAGIC, _VERSION):
        raise errors.SceneFileError(f"{place}: expected a binary glTF 2.0 file, found another kind")
    length, kind = struct.unpack_from("<II", data, _HEADER)
    body = _HEADER + _CHUNK + length
    if struct.unpack_from("<I", data, 8)[0] != len(data) or kind != _JSON or body > len(data):
        raise errors.SceneFileError(f"{place}: expected a file of the length in its header; it is truncated")
    text = data[_HEADER + _CHUNK : body].rstrip(b" ")
    tree = strict_json.parse(text, f"{place}: JSON", errors.SceneFileError, "export the scene again")
    if not isinstance(tree, dict):
        raise errors.SceneFileError(f"{place}: JSON: expected an object, found {tree!r:.60}")
    return Content(place, tree, _binary(data, body, place))


def _binary(data: bytes, start: int, place: str) -> bytes:
    """Content of the binary chunk, which is optional."""
    if start == len(data):
        return b""
    if start + _CHUNK > len(data):
        raise errors.SceneFileError(f"{place}: expected a second chunk; the file is truncated")
    length, kind = struct.unpack_from("<II", data, start)
    if kind != _BIN or start + _CHUNK + length > len(data):
        raise errors.SceneFileError(f"{place}: expected a binary chunk of {length} bytes; the file is damaged")
    return data[start + _CHUNK : start + _CHUNK + length]
