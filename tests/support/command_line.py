"""Calls of the command line in tests."""

from r5dgs_core.cli import main
from r5dgs_core.cli.exit_status import ExitStatus


def complaint(capsys, *arguments, status=ExitStatus.ERROR):
    """Run a command that fails. Returns the error line, which follows the usage if arguments are wrong."""
    capsys.readouterr()
    try:
        found = main.main([str(argument) for argument in arguments])
    except SystemExit as stop:  # of argparse
        found = stop.code
    assert found == status
    *before, line = capsys.readouterr().err.splitlines()
    if status == ExitStatus.USAGE:
        assert before[0].startswith(f"usage: r5dgs {arguments[0]} ") and f"r5dgs {arguments[0]}: error: " in line
    else:
        assert line.startswith("r5dgs: ") and not any(text.startswith("r5dgs: ") for text in before)
    return line
