"""Cache of files that were read, and of errors in reading them, until a file changes."""

from collections.abc import Callable
from pathlib import Path
from typing import Generic, TypeVar

from ...r5dgs_core import errors

T = TypeVar("T")


class Remembered(Generic[T]):
    """Reads each file once for each state of it; a file that cannot be read is not read again either.

    Args:
        read: Reads a file; raises SceneFileError.
    """

    def __init__(self, read: Callable[[Path], T]):
        self._read = read
        self._known: dict[Path, tuple[tuple[int, int], T | errors.SceneFileError]] = {}

    def get(self, path: Path, again: bool = False) -> T:
        """The content of a file.

        Args:
            path: The file.
            again: Try a file anew that could not be read before, as the user asks for it.

        Raises:
            SceneFileError: It cannot be read.
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
                if isinstance(error.__cause__, PermissionError):  # may pass without a change of the file
                    raise
                known = stamp, error
            self._known[path] = known
        if isinstance(known[1], errors.SceneFileError):
            raise errors.SceneFileError(str(known[1]))
        return known[1]

    def clear(self) -> None:
        """Forget everything."""
        self._known.clear()
