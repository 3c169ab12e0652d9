"""Cache of file contents and read errors, valid until the file changes."""

from collections.abc import Callable
from pathlib import Path
from typing import Generic, TypeVar

from ...r5dgs_core import errors

T = TypeVar("T")


class Remembered(Generic[T]):
    """Cache that reads each version of a file once. Failed reads are cached, too.

    Args:
        read: Function that reads a file; raises SceneFileError.
    """

    def __init__(self, read: Callable[[Path], T]):
        self._read = read
        self._known: dict[Path, tuple[tuple[int, int], T | errors.SceneFileError]] = {}

    def get(self, path: Path, again: bool = False) -> T:
        """Return the content of a file.

        Args:
            again: True to retry a read that failed before, for explicit requests of the user.

        Raises:
            SceneFileError: The file cannot be read.
        """
        try:
            status = path.stat()
        except OSError as error:
            raise errors.SceneFileError(f"{path}: cannot be read ({error.strerror or error})") from error
        stamp = (status.st_mtime_ns, status.st_size)
        known = self._known.get(path)
        failed = known is not None and isinstance(known[1], errors.SceneFileError)
        if known is None or known[0] != stamp or (failed and again):
            try:
                known = stamp, self._read(path)
            except errors.SceneFileError as error:
                if isinstance(error.__cause__, PermissionError):  # permissions change without a new timestamp
                    raise
                known = stamp, error
            self._known[path] = known
        if isinstance(known[1], errors.SceneFileError):
            raise errors.SceneFileError(str(known[1]))
        return known[1]

    def put(self, path: Path, content: T) -> None:
        """Store the content of a file that the caller has just read."""
        status = path.stat()
        self._known[path] = (status.st_mtime_ns, status.st_size), content

    def clear(self) -> None:
        """Clear the cache."""
        self._known.clear()
