"""Checkpoint files: ``torch.save`` archives with a digest of all preceding bytes as the archive's comment.

The digest is necessary because ``torch.load`` does not verify the CRCs of the members.
"""

from __future__ import annotations

import hashlib
import io
import struct
import zipfile
from pathlib import Path
from typing import Any

import torch

from .. import atomic_files

_MARK = b"sha256:"
_COMMENT_SIZE = len(_MARK) + hashlib.sha256().digest_size * 2
_DIRECTORY = 0x10  # of the MS-DOS attributes of a member
_LENGTH = struct.Struct("<H")  # length of the comment, in front of it at the end of a zip archive


class DamagedError(Exception):
    """File with other bytes than were written; the message gives the reason."""


def write(path: Path, content: dict[str, Any], previous: Path) -> None:
    """Replace a checkpoint file atomically.

    Args:
        path: The file.
        content: Tensors and plain values.
        previous: New place of the old file.

    Raises:
        OSError: The file cannot be written; the old file is kept.
    """
    buffer = io.BytesIO()
    torch.save(content, buffer)
    buffer.seek(-_LENGTH.size, io.SEEK_END)
    buffer.write(_LENGTH.pack(_COMMENT_SIZE))
    with atomic_files.replacing(path, previous) as stream:
        stream.write(buffer.getbuffer())
        stream.write(_MARK + hashlib.sha256(buffer.getbuffer()).hexdigest().encode())


def read(path: Path) -> Any:
    """Read and verify a checkpoint file.

    Files of earlier versions have no digest; the CRCs of their members are verified instead.

    Raises:
        DamagedError: A byte differs, or the content is more than tensors and plain values.
        OSError: The file cannot be read.
    """
    data = path.read_bytes()
    try:
        _check(data)
        return torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
    except DamagedError:
        raise
    except Exception as error:  # zipfile and torch raise many kinds of errors for damaged files
        raise DamagedError(f"{type(error).__name__}: {str(error).partition(chr(10))[0]}") from error


def _check(data: bytes) -> None:
    """Verify an archive by its digest, or by its CRCs if it has no digest."""
    body, comment = memoryview(data)[:-_COMMENT_SIZE], data[-_COMMENT_SIZE:]
    sealed = comment.startswith(_MARK)
    if sealed and comment != _MARK + hashlib.sha256(body).hexdigest().encode():
        raise DamagedError("its content does not match its digest")
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = archive.infolist()
        if archive.comment != (comment if sealed else b""):
            raise DamagedError("its digest is incomplete")
        if any(member.compress_type != zipfile.ZIP_STORED for member in members):
            raise DamagedError("a member is compressed, which torch.save never does")
        if any(member.external_attr & _DIRECTORY for member in members):
            raise DamagedError("a member is marked as a folder, whose content torch does not read")
        if len({member.filename for member in members}) < len(members):
            raise DamagedError("two members have the same name")
        broken = None if sealed else archive.testzip()
        if broken is not None:
            raise DamagedError(f"the CRC of {broken} is wrong")
