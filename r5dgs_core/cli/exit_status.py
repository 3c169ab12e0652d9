"""Exit statuses of the command line, and the status of each kind of error (docs/reference/command_line.md)."""

from __future__ import annotations

import enum

from .. import errors


class ExitStatus(enum.IntEnum):
    """Exit status of every ``r5dgs`` command."""

    SUCCESS = 0
    NEGATIVE = 1  # the command ran; its answer is "nothing found", "faults found" or "a case fails"
    USAGE = 2  # wrong arguments; argparse exits with this status too
    ERROR = 3  # an error that the user can act on
    DEFECT = 70  # a defect of R5DGS, with a traceback; EX_SOFTWARE of sysexits.h
    INTERRUPTED = 130  # stopped by Ctrl-C or SIGTERM


def of(error: BaseException) -> ExitStatus:
    """Return the exit status that an exception leads to."""
    if isinstance(error, errors.Interrupted | KeyboardInterrupt):
        return ExitStatus.INTERRUPTED
    if isinstance(error, errors.UsageError):
        return ExitStatus.USAGE
    if isinstance(error, errors.R5dgsError | OSError):  # the system refuses a file, or the reader of a pipe is gone
        return ExitStatus.ERROR
    return ExitStatus.DEFECT
