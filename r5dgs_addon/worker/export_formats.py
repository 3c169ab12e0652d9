"""Export formats that Blender's own Python or the worker's can write."""

from ...r5dgs_core import errors
from ...r5dgs_core.formats import registry
from . import jobs


def why_unavailable(format: registry.Format) -> str | None:
    """Return the reason and the remedy if neither Python can write a format, else None.

    The packages of the worker are known once it has answered; until then it is asked to write the format.
    """
    reason, written = format.why_unavailable(), jobs.formats()
    if reason is None or written is None or format.name in written:
        return None
    return f"{reason}, in the Python of the worker" if format.packages else reason


def usable(name: str) -> registry.Format:
    """Return a format that Blender or the worker may be able to write. Raises BackendError if neither can."""
    found = registry.get(name)
    if (reason := why_unavailable(found)) is not None:
        raise errors.BackendError(reason)
    return found
