"""The commands of ``r5dgs``, in the order of its help."""

from __future__ import annotations

import argparse
import importlib
from typing import Protocol

from .exit_status import ExitStatus

MODULES = (  # modules of `commands`
    *("demo", "prepare", "train", "masks", "associate", "bake", "import_run", "evaluate", "report", "bench", "batch"),
    *(
        "extrapolate",
        "export",
        "render",
        "view",
        "info",
        "check",
        "objects",
        "lookup",
        "query",
        "name",
        "config",
        "warm_up",
    ),
)


class Command(Protocol):
    """Module of a command. It imports only the standard library and modules that do the same.

    `run` imports numpy, torch and the rest, after checking the arguments.

    Attributes:
        NAME: Name on the command line.
        SHORT: Description in the list of commands.
        LONG: Description in its own help.
        EXAMPLE: Arguments of an example.
        PAGE: Page about it, below ``docs/``.
    """

    NAME: str
    SHORT: str
    LONG: str
    EXAMPLE: str
    PAGE: str

    def add_arguments(self, p: argparse.ArgumentParser) -> None:
        """Add the arguments of the command."""
        ...

    def run(self, args: argparse.Namespace) -> ExitStatus | None:
        """Run the command; None stands for success.

        Raises:
            R5dgsError: An error that the user can resolve; `exit_status.status_of` has its status.
        """
        ...


def commands() -> list[Command]:
    """Return all commands."""
    return [importlib.import_module(f".commands.{name}", __package__) for name in MODULES]  # type: ignore[misc]
