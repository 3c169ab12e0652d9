"""Dispatch of benchmark packages to the module that the first argument names."""

from __future__ import annotations

import importlib
import re
import sys


def run(package: str | None, usage: str | None) -> None:
    """Run the main function of a command's module with the remaining arguments.

    Args:
        package: Package of the command modules.
        usage: Text with one indented line per command, printed if the command is missing or unknown.
    """
    known = re.findall(r"^ {4}(\w+)  ", usage or "", re.MULTILINE)
    name = sys.argv[1] if len(sys.argv) > 1 else ""
    if name not in known:
        print(usage)
        raise SystemExit(0 if name in ("-h", "--help") else 2)
    sys.argv = [f"python -m {package} {name}", *sys.argv[2:]]
    importlib.import_module(f"{package}.{name}").main()
