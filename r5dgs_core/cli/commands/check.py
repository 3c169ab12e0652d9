"""The command ``r5dgs check``: print all faults of a file or folder."""

from __future__ import annotations

import argparse
import dataclasses
import json
from pathlib import Path

from ... import terminal
from ...check import check
from ...findings import ERROR
from ..exit_status import ExitStatus

NAME = "check"
SHORT = "list all faults of a data set, scene file or run"
LONG = (
    "List all faults of a data set, run folder, .r5dgs, .ply or .toml file, each with its remedy, errors first.\n"
    "The exit status is 1 if there are errors."
)
EXAMPLE = "DATA"
PAGE = "reference/check.md"


def add_arguments(p: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    p.add_argument("target", type=Path, metavar="DATA|RUN|FILE", help="data set, run folder or file to check")
    pictures = "folder for pictures of faults of a capture (default: DATA/check, if DATA was made by 'r5dgs prepare')"
    p.add_argument("--pictures", type=Path, metavar="FOLDER", help=pictures)
    p.add_argument("--json", action="store_true", help="print JSON instead of text")


def run(args: argparse.Namespace) -> ExitStatus | None:
    """Run the command."""
    return None if run_check(args.target, as_json=args.json, pictures=args.pictures) else ExitStatus.NEGATIVE


def run_check(path: Path, *, as_json: bool = False, pictures: Path | None = None) -> bool:
    """Print all faults and their counts; returns False if any fault is an error."""
    found = check(path, pictures)
    failed = sum(finding.severity == ERROR for finding in found)
    if as_json:
        rows = [dataclasses.asdict(finding) for finding in found]
        print(json.dumps({"errors": failed, "warnings": len(found) - failed, "findings": rows}, indent=2))
    else:
        terminal.print_lines(map(str, found))
        print(f"{_count(failed, 'error')}, {_count(len(found) - failed, 'warning')}")
    return failed == 0


def _count(count: int, noun: str) -> str:
    return f"{count} {noun}{'' if count == 1 else 's'}"
