"""Folder for the machine code of kernels, one per state of their shared sources, kept between processes."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import logging
import os
import re
import shutil
import stat
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator
from pathlib import Path

import numba

log = logging.getLogger(__name__)

_SHARED = ("raster/**/*.py", "scene/spherical_harmonics.py", "motion/rotations.py")  # sources that any kernel may use
_OURS = re.compile("r5dgs-[0-9a-f]{12}")
_KEPT_S = 28 * 24 * 3600.0
_SYSTEM_USERS = (0, 65534)  # root, and the owner that root's files have inside a user's container


def cache_folder() -> Path | None:
    """Folder of the machine code of this version, or None if no candidate is writable."""
    folder = folder_of(numba.config.CACHE_DIR)  # type: ignore[attr-defined]
    return None if folder is None else Path(folder)


@functools.cache
def folder_of(chosen: str) -> str | None:
    """Folder for machine code below the user's choice, or "" for none; None if no candidate is writable.

    numba checks only the modification time and size of the kernel's own file, not of the files of its helpers and
    constants, hence the digest.
    """
    digest = digest_of(shared_sources())
    tried = []
    for base in _bases(chosen):
        folder = base / f"r5dgs-{digest}"
        is_new = not folder.exists()
        try:
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            reason = _why_unsafe(folder)
            if reason is None:
                tempfile.TemporaryFile(dir=folder).close()
        except OSError as error:
            tried.append(f"{base} ({error.strerror})")
            continue
        if reason is not None:  # never load machine code that other users can replace
            log.warning("rasterizer: compiled code is not cached in %s, as %s; remedy: remove it", folder, reason)
            tried.append(f"{base} (others can write there)")
            continue
        with contextlib.suppress(OSError):
            os.utime(folder)  # marks the folder as in use, see `_remove_old`
        if is_new:
            _remove_old(base)
        return str(folder)
    log.warning(
        "rasterizer: no place to keep compiled code, so every process compiles again; tried %s; "
        "remedy: set NUMBA_CACHE_DIR to a folder that can be written",
        ", ".join(tried) or "none",
    )
    return None


def _why_unsafe(folder: Path) -> str | None:
    """Return the reason why other users can put code into a folder, or None if they cannot."""
    if not hasattr(os, "getuid"):  # Windows: folders inherit the permissions of the user's profile
        return None
    status = folder.lstat()
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.getuid():
        return "it is a link or belongs to another user"
    if status.st_mode & 0o022:
        return "others can write there"
    for parent in folder.resolve().parents:  # a user who can rename a parent folder can replace this one
        status = parent.stat()
        if status.st_uid not in (os.getuid(), *_SYSTEM_USERS):
            return f"{parent} belongs to another user"
        if status.st_mode & stat.S_IWOTH and not status.st_mode & stat.S_ISVTX:
            return f"others can write in {parent}"
    return None


def shared_sources() -> list[Path]:
    """Source files that any kernel may use besides its own: helpers and frozen constants."""
    core = Path(__file__).parents[1]
    return sorted(path for pattern in _SHARED for path in core.glob(pattern))


def digest_of(sources: Iterable[Path]) -> str:
    """First 12 hexadecimal digits of the SHA-256 of the files' contents."""
    digest = hashlib.sha256()
    for source in sources:
        digest.update(source.read_bytes())
    return digest.hexdigest()[:12]


def _remove_old(base: Path) -> None:
    """Remove machine code of other versions that was not used for four weeks; ignore folders that cannot be removed."""
    for folder in base.glob("r5dgs-*"):
        with contextlib.suppress(OSError):
            status = folder.lstat()
            unused_s = time.time() - status.st_mtime
            if _OURS.fullmatch(folder.name) and stat.S_ISDIR(status.st_mode) and unused_s > _KEPT_S:
                shutil.rmtree(folder, ignore_errors=True)


def _bases(chosen: str) -> Iterator[Path]:
    """Yield candidate folders for machine code, best first: the user's choice, the user's cache, a temporary one."""
    if chosen:
        yield Path(chosen)
    user_cache = _user_cache()
    if user_cache is not None:
        yield user_cache
    temporary = _own_temporary()
    if temporary is not None:
        yield temporary


def _user_cache() -> Path | None:
    try:
        if sys.platform == "win32":
            base = os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local"
        elif sys.platform == "darwin":
            base = Path.home() / "Library" / "Caches"
        else:
            base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    except RuntimeError:  # no HOME, and no entry in the user database
        return None
    return Path(base) / "r5dgs" / "numba"


def _own_temporary() -> Path | None:
    """Temporary folder that only this user can write, or None."""
    try:
        if not hasattr(os, "getuid"):  # Windows: the temporary folder is private
            return Path(tempfile.gettempdir()) / "r5dgs"
        folder = Path(tempfile.gettempdir()) / f"r5dgs-{os.getuid()}"
        folder.mkdir(mode=0o700, exist_ok=True)
        return None if _why_unsafe(folder) else folder
    except OSError:
        return None
