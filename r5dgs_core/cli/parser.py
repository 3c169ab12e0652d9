"""Parser of the command line: the commands of `registry`, each with a description, an example and a page."""

from __future__ import annotations

import argparse

from .. import __version__
from . import registry


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line.

    Its result has the function of the command as ``run_command`` and the parser of the command as ``parser_of``.
    """
    top = argparse.ArgumentParser(
        prog="r5dgs",
        description="Train semantic 4D Gaussians from multi-view video, bake them into a scene for Blender, and "
        "evaluate it. Training runs on a CPU or an NVIDIA GPU.",
        epilog=_epilog("r5dgs demo", "README.md and docs/reference/command_line.md"),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    top.add_argument("--version", action="version", version=f"r5dgs {__version__}")
    commands = top.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for command in registry.commands():
        p = commands.add_parser(
            command.NAME,
            help=command.SHORT,
            description=command.LONG,
            epilog=_epilog(f"r5dgs {command.NAME} {command.EXAMPLE}".rstrip(), f"docs/{command.PAGE}"),
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        command.add_arguments(p)
        p.set_defaults(parser_of=p, run_command=command.run)
    return top


def _epilog(example: str, page: str) -> str:
    return f"example:\n  {example}\n\nread more: {page}"
