"""The command ``r5dgs info``: print a summary of a scene file."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from ... import input_paths, terminal

NAME = "info"
SHORT = "summarise a scene file"
LONG = "Print duration, frames per second, extent, moving objects and quality of a scene file."
EXAMPLE = "scene.r5dgs"
PAGE = "reference/command_line.md"


def add_arguments(p: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    p.add_argument("file", type=Path, help=".r5dgs file")
    p.add_argument("--needs", action="store_true", help="also print the table of the scene's needs")
    p.add_argument("--json", action="store_true", help="print all data as JSON")


def run(args: argparse.Namespace) -> None:
    """Run the command."""
    run_info(args.file, with_needs=args.needs, as_json=args.json)


def run_info(path: Path, *, with_needs: bool = False, as_json: bool = False) -> None:
    """Print a summary of a scene file.

    Args:
        path: The scene file.
        with_needs: Also print the table of the scene's needs.
        as_json: Print all data of the scene as JSON instead.
    """
    input_paths.check_scene(path)
    from ...playback import scene_info
    from ...scene import scene_file

    scene = scene_file.read(path)
    if as_json:
        print(json.dumps(scene_info.info(scene), indent=2))
        return
    from ...evaluation import scene_summary

    print(scene_summary.summary(scene, path))
    if with_needs:
        from ...evaluation import evaluation_table

        terminal.console().print(evaluation_table.needs(scene.needs))
