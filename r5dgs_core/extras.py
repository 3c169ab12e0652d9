"""Optional packages: the extras of pyproject.toml that install them, and the error if one is missing."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from . import errors


@contextlib.contextmanager
def required(user: str, extra: str, remedy: str = "", also: tuple[type[Exception], ...] = ()) -> Iterator[None]:
    """Convert an ImportError of the block to a BackendError with the command that installs the missing package.

    Args:
        user: Feature that needs the packages, for the message.
        extra: Extra that installs them.
        remedy: Further remedy, for the message.
        also: Further exception types that indicate an unusable installation.

    Raises:
        BackendError: The block raises ImportError, or one of ``also``.
    """
    try:
        yield
    except (ImportError, *also) as error:
        package = getattr(error, "name", None) or error
        raise errors.BackendError(
            f"{user}: cannot import {package}; remedy: {command(extra)}{remedy and '; ' + remedy}"
        ) from error


def command(extra: str) -> str:
    """Return the command that installs an extra."""
    return f"pip install 'r5dgs[{extra}]'"
