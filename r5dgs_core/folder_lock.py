"""Locks of run folders and of single files: only one process at a time writes into a folder.

The system releases a lock when its process ends in any way. Readers take no lock.
"""

from __future__ import annotations

import contextlib
import datetime
import functools
import inspect
import json
import logging
import os
import shlex
import socket
import stat
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import ParamSpec, TypeVar

from . import input_paths, strict_json
from .errors import CheckpointError

log = logging.getLogger(__name__)
P = ParamSpec("P")
T = TypeVar("T")

LOCK_FILE = ".lock"
_PLACE = 1 << 30  # offset of the locked byte, past the description: Windows blocks reads of a locked range
_MAX_BYTES = 1 << 16  # maximum size of the holder's description


@contextlib.contextmanager
def hold(folder: Path) -> Iterator[bool]:
    """Lock a folder for the block; creates a missing folder.

    Yields:
        False if the file system does not support locks; a warning then names the folder.

    Raises:
        CheckpointError: Another process, named in the message, holds the lock, or the folder cannot be written.
    """
    path = Path(folder) / LOCK_FILE
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        descriptor, locked = _open(path)
    except BlockingIOError as error:
        raise CheckpointError(
            f"{folder}: in use by {_holder(path)}; wait until that ends or stop it, or use another folder"
        ) from error
    except OSError as error:
        raise CheckpointError(f"{folder}: cannot be created or written: {error}; choose another --out") from error
    try:
        yield locked
    finally:
        _release(path, descriptor, locked)


@contextlib.contextmanager
def try_file(path: Path) -> Iterator[bool]:
    """Lock a file for the block if no other process has locked it; the file is removed afterwards.

    Yields:
        False if another process holds the lock.

    Raises:
        CheckpointError: The file cannot be created.
    """
    try:
        descriptor, locked = _open(path)
    except BlockingIOError:
        yield False
        return
    except OSError as error:
        reason = error.strerror or error
        raise CheckpointError(f"{path.parent}: no file can be created: {reason}; choose another folder") from error
    try:
        yield True
    finally:
        _release(path, descriptor, locked)


def hold_run_around(path: Path) -> contextlib.AbstractContextManager[object]:
    """Lock the run folder that contains an output path; does nothing if the path is in no run folder.

    Raises:
        CheckpointError: See `hold`.
    """
    path = Path(path).absolute()
    run = next((folder for folder in (path, *path.parents) if _is_run(folder)), None)
    return contextlib.nullcontext() if run is None else hold(run)


def _is_run(folder: Path) -> bool:
    """Return True if ``run.json`` is ours or damaged; other programs write files of that name too."""
    path = folder / input_paths.RUN_FILE
    if not path.is_file():
        return False
    try:
        content = strict_json.read(path, CheckpointError)
    except CheckpointError:
        return True
    return isinstance(content, dict) and {"format_version", "dataset"} <= content.keys()


def writes(*names: str) -> Callable[[Callable[P, T]], Callable[P, T]]:
    """Return a decorator that locks the run folder around the output of a function; see `hold_run_around`.

    Args:
        names: Names of arguments that may hold the output path; the first that is not None is used.
    """

    def decorate(function: Callable[P, T]) -> Callable[P, T]:
        signature = inspect.signature(function)

        @functools.wraps(function)
        def locked(*args: P.args, **kwargs: P.kwargs) -> T:
            given = signature.bind(*args, **kwargs).arguments
            with hold_run_around(next(given[name] for name in names if given.get(name) is not None)):
                return function(*args, **kwargs)

        return locked

    return decorate


def _open(path: Path) -> tuple[int, bool]:
    """Open and lock the file at a path, and write a description of this process into it.

    Raises:
        BlockingIOError: Another process holds the lock.
        OSError: The file cannot be opened.
    """
    while True:
        # Symbolic links are refused, because their target would be overwritten.
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o666)
        try:
            if not stat.S_ISREG(os.fstat(descriptor).st_mode):
                raise OSError(f"{path} is not a regular file")
            locked = _lock(descriptor, path)
            if locked and not _is_at(path, descriptor):  # the previous holder removed the file meanwhile
                os.close(descriptor)
                continue
            with contextlib.suppress(OSError):  # the lock holds even if a full disk prevents the description
                os.ftruncate(descriptor, 0)
                os.lseek(descriptor, 0, os.SEEK_SET)
                os.write(descriptor, json.dumps(_description()).encode())
        except BaseException:
            os.close(descriptor)
            raise
        return descriptor, locked


def _release(path: Path, descriptor: int, locked: bool) -> None:
    """Remove and close a file of `_open`."""
    if locked and os.name == "posix":
        path.unlink(missing_ok=True)  # before the release, so that the next process creates its own file
    os.close(descriptor)
    if os.name != "posix":
        with contextlib.suppress(OSError):  # Windows cannot remove a file that another process has open
            path.unlink(missing_ok=True)


def _lock(descriptor: int, path: Path) -> bool:
    """Lock an open file; returns False if its file system does not support locks."""
    try:
        if sys.platform == "win32":
            import msvcrt

            os.lseek(descriptor, _PLACE, os.SEEK_SET)
            try:
                msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
            except PermissionError as error:
                raise BlockingIOError(*error.args) from error
        else:
            import fcntl

            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise
    except OSError as error:
        log.warning(
            "%s: its file system has no locks (%s); make sure that no other process writes there",
            path.parent,
            error.strerror,
        )
        return False
    return True


def _is_at(path: Path, descriptor: int) -> bool:
    try:
        return os.path.samestat(os.stat(path), os.fstat(descriptor))
    except FileNotFoundError:
        return False


def _description() -> dict[str, str | int]:
    return {
        "pid": os.getpid(),
        "host": socket.gethostname(),
        "since": datetime.datetime.now().astimezone().isoformat(sep=" ", timespec="seconds"),
        "command": shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]])[:1000],
    }


def _holder(path: Path) -> str:
    """Return a description of the process that holds a lock; "another process" if the lock file cannot be read."""
    try:
        with open(path, "rb") as stream:
            found = strict_json.parse(stream.read(_MAX_BYTES), str(path), CheckpointError)
        return f"process {found['pid']} on {found['host']} since {found['since']} ({found['command']})"
    except (OSError, CheckpointError, KeyError, TypeError):
        return "another process"
