"""Exit statuses of the command line, and the status for each kind of error (docs/reference/command_line.md)."""

from __future__ import annotations

import enum

from .. import errors


class ExitStatus(enum.IntEnum):
    """Exit status of every ``r5dgs`` command."""

    SUCCESS = 0
    NEGATIVE = 1  # negative result: nothing found, faults found, or a case failed
    USAGE = 2  # wrong arguments; same status as argparse
    ERROR = 3  # an error that the user can resolve
    DEFECT = 70  # a defect of R5DGS, with a traceback; EX_SOFTWARE in sysexits.h
    INTERRUPTED = 130  # stopped by Ctrl-C or SIGTERM


def status_of(error: BaseException) -> ExitStatus:
    """Return the exit status for an exception."""
    if isinstance(error, errors.Interrupted | KeyboardInterrupt):
        return ExitStatus.INTERRUPTED
    if isinstance(error, errors.UsageError):
        return ExitStatus.USAGE
    if isinstance(error, errors.R5dgsError | OSError):  # OSError: a file is refused, or the output pipe is closed
        return ExitStatus.ERROR
    return ExitStatus.DEFECT
