"""The command ``r5dgs check``: print all faults of a file or folder."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

from ..check import check
from ..findings import ERROR
from ..terminal import printable


def run_check(path: Path, *, as_json: bool = False) -> bool:
    """Print all faults and their counts; returns False if any fault is an error."""
    found = check(path)
    failed = sum(finding.severity == ERROR for finding in found)
    if as_json:
        rows = [dataclasses.asdict(finding) for finding in found]
        print(json.dumps({"errors": failed, "warnings": len(found) - failed, "findings": rows}, indent=2))
    else:
        for finding in found:
            print(printable(str(finding)))
        print(f"{_count(failed, 'error')}, {_count(len(found) - failed, 'warning')}")
    return failed == 0


def _count(count: int, noun: str) -> str:
    return f"{count} {noun}{'' if count == 1 else 's'}"
