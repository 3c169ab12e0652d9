"""Bounded reading of a zip of `.npy` arrays: sizes are checked before anything is decompressed or allocated.

Notation: a file of F bytes may declare at most `ALLOWANCE` + `RATIO` F bytes of content. The declared sizes are
binding: a member that inflates to more or less is an error.
"""

from __future__ import annotations

import copy
import io
import math
import re
import struct
import zipfile
import zlib
from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from .. import input_paths
from ..errors import SceneFileError

ALLOWANCE = 32 << 20
RATIO = 64
_BLOCK = 1 << 20  # maximum size of a single read and of the zip directory, bytes
_MAX_DIMENSIONS = 8
_MAGIC = b"\x93NUMPY\x01\x00"
_HEADER = re.compile(
    rb"\{'descr': '([<>|=]?[A-Za-z][0-9]*)', 'fortran_order': (True|False), 'shape': \(([0-9, ]*)\), \} *\n"
)
_DIMENSION = re.compile(r"(?:[0-9]{1,18}(?:, ?[0-9]{1,18})*,?)?")
# Exceptions of zipfile and zlib on damaged bytes; encryption raises RuntimeError, odd names ValueError.
_BROKEN = (
    zipfile.BadZipFile,
    zlib.error,
    struct.error,
    EOFError,
    NotImplementedError,
    RuntimeError,
    OSError,
    ValueError,
)


def max_content_bytes(size: int) -> int:
    """Largest allowed content, in bytes, of a file of a given size."""
    return ALLOWANCE + RATIO * size


@dataclass(frozen=True)
class Header:
    """Header of an array in C order.

    Attributes:
        dtype: Dtype code, such as "<f4".
        shape: Shape of the array.
    """

    dtype: str
    shape: tuple[int, ...]


class Archive:
    """A zip open for reading. Every fault raises `SceneFileError`.

    Args:
        path: The file.

    Raises:
        SceneFileError: The file is missing, not a zip, damaged, or declares more content than its size allows.
    """

    def __init__(self, path: Path):
        self.place = str(path)
        input_paths.check_scene(path)
        try:
            self._stream: BinaryIO = _Bounded(io.FileIO(path))
        except OSError as error:
            raise SceneFileError(f"{path}: cannot be read: {error}; check its read permission") from error
        try:
            self._zip = zipfile.ZipFile(self._stream)
            self._members = self._checked(path.stat().st_size)
        except _BROKEN as error:
            self._stream.close()
            raise SceneFileError(
                f"{path}: expected a .r5dgs file (a zip), found a truncated or foreign file ({error}); "
                "bake or copy it again"
            ) from error
        except SceneFileError:
            self._stream.close()
            raise

    def __enter__(self) -> Archive:
        return self

    def __exit__(self, *_: object) -> None:
        self._zip.close()
        self._stream.close()

    def __contains__(self, member: str) -> bool:
        return member in self._members

    def size(self, member: str) -> int:
        """Declared size of a member in bytes."""
        return self._members[member].file_size

    def compressed_size(self, member: str) -> int:
        """Compressed size of a member in bytes."""
        return self._members[member].compress_size

    def read(self, member: str) -> bytes:
        """Content of a member, exactly of its declared size."""
        with self._reading(member) as stream:
            return _read_exactly(stream, bytearray(self.size(member)))

    def header(self, member: str, dtypes: Collection[str]) -> Header:
        """Header of an array with one of the given dtypes. Its shape must match the declared size of the member."""
        with self._reading(member) as stream:
            return self._header(stream, member, dtypes)

    def array(self, member: str, dtypes: Collection[str]) -> np.ndarray:
        """Array with one of the given dtypes."""
        with self._reading(member) as stream:
            header = self._header(stream, member, dtypes)
            result = np.empty(header.shape, header.dtype)
            _read_exactly(stream, result.reshape(-1).view(np.uint8).data if result.size else bytearray())
            return result

    def _checked(self, size: int) -> dict[str, zipfile.ZipInfo]:
        """Members by name, with their sizes checked against that of the file."""
        found = self._zip.infolist()
        members = {info.filename: info for info in found}
        if len(members) < len(found):
            twice = Counter(info.filename for info in found).most_common(1)[0][0]
            raise SceneFileError(f"{self.place}: expected each member once, found {twice[:60]!r} twice")
        if sum(info.compress_size for info in found) > size:
            raise SceneFileError(f"{self.place}: expected members that do not overlap, found overlapping ones")
        declared, most = sum(info.file_size for info in found), max_content_bytes(size)
        if declared > most:
            raise SceneFileError(
                f"{self.place}: expected at most {most >> 20} MiB of content in a file of {size / 2**20:.1f} MiB, "
                f"found {declared >> 20} MiB declared; scenes do not compress so well, so the file was not read. "
                "Get the file from a trusted source"
            )
        return members

    @contextmanager
    def _reading(self, member: str) -> Iterator[BinaryIO]:
        # Read one byte more than declared, to detect a member that exceeds its size.
        info = copy.copy(self._members[member])
        info.file_size += 1
        if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):  # other methods inflate without bound
            raise SceneFileError(f"{self.place}: {member}: expected a stored or deflated member, found another kind")
        try:
            with self._zip.open(info) as stream:
                yield stream  # type: ignore[misc]
        except _BROKEN as error:
            raise SceneFileError(
                f"{self.place}: {member}: found damaged data ({error}); bake or copy the file again"
            ) from error

    def _header(self, stream: BinaryIO, member: str, dtypes: Collection[str]) -> Header:
        start = stream.read(len(_MAGIC) + 2)
        if start[:-2] != _MAGIC or len(start) < len(_MAGIC) + 2:
            raise ValueError(f"expected an array in npy version 1.0, found {start!r}")
        text = stream.read(int.from_bytes(start[-2:], "little"))
        match = _HEADER.fullmatch(text)
        if match is None or not _DIMENSION.fullmatch(match[3].decode()):
            raise ValueError(f"expected the header of an array, found {text[:80]!r}")
        dtype, fortran = match[1].decode(), match[2] == b"True"
        if dtype not in dtypes or fortran:
            raise SceneFileError(
                f"{self.place}: {member}: expected dtype {' or '.join(sorted(dtypes))} in C order, "
                f"found {dtype}{' in Fortran order' if fortran else ''}"
            )
        shape = tuple(int(n) for n in match[3].decode().split(",") if n.strip())
        size, found = math.prod(shape) * np.dtype(dtype).itemsize, self.size(member) - len(start) - len(text)
        if size != found or len(shape) > _MAX_DIMENSIONS:
            raise ValueError(f"expected {size} bytes for shape {shape}, found {found}")
        return Header(dtype, shape)


class _Bounded(io.BufferedReader):
    """File reader limited to `_BLOCK` bytes per read, which also bounds a zip's directory, as it is read whole."""

    def read(self, size: int | None = -1, /) -> bytes:
        if size is not None and size > _BLOCK:
            raise zipfile.BadZipFile(f"a directory or piece of {size} bytes, more than {_BLOCK}")
        return super().read(size)


def _read_exactly(stream: BinaryIO, target: bytearray | memoryview) -> bytes:
    """Fill the target completely and check that no data follows."""
    view, at = memoryview(target), 0
    while at < len(view):
        piece = stream.read(min(_BLOCK, len(view) - at))
        if not piece:
            raise ValueError(f"the data ends after {at} of {len(view)} bytes")
        view[at : at + len(piece)] = piece
        at += len(piece)
    if stream.read(1):
        raise ValueError(f"the data continues after the declared {len(view)} bytes")
    return bytes(target) if isinstance(target, bytearray) else b""
