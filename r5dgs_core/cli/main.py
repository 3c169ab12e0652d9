"""The ``r5dgs`` command.

Modules: `commands` has a module per command, with its arguments and its function; `registry` lists them, `parser`
builds the parser, `exit_status` maps errors, and the others serve several commands.
"""

from __future__ import annotations

import argparse
import os
import sys
import traceback

from .. import terminal
from . import exit_status, parser
from .exit_status import ExitStatus


def main(arguments: list[str] | None = None) -> int:
    """Run the command line and return the exit status (`ExitStatus`)."""
    with terminal.safe_output():
        args = parser.parser().parse_args(arguments)
        try:
            return args.run_command(args) or ExitStatus.SUCCESS
        except BaseException as error:
            if isinstance(error, SystemExit | GeneratorExit):
                raise
            return _explain(error, args)


def _explain(error: BaseException, args: argparse.Namespace) -> ExitStatus:
    """Print the error for the user; returns the exit status."""
    status = exit_status.status_of(error)
    if isinstance(error, BrokenPipeError):  # stdout was closed (for example by `head`); discard further output
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    elif status == ExitStatus.DEFECT:
        traceback.print_exception(error)
        print("r5dgs: this is a defect of R5DGS; please report it with the lines above", file=sys.stderr)
    elif status == ExitStatus.USAGE:
        args.parser_of.print_usage(sys.stderr)
        print(f"{args.parser_of.prog}: error: {terminal.printable(str(error))}", file=sys.stderr)
    else:
        remedy = "; check the path, its permissions and the free disk space" if isinstance(error, OSError) else ""
        print(f"r5dgs: {terminal.printable(str(error)) or 'stopped'}{remedy}", file=sys.stderr)
    return status


if __name__ == "__main__":
    sys.exit(main())
