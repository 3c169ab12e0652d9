"""The command ``r5dgs name``: change the name of an object of a scene."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ... import errors, folder_lock, input_paths
from .. import object_captions

if TYPE_CHECKING:
    from ...scene.scene import Scene

NAME = "name"
SHORT = "change the name of an object of a scene"
LONG = "Change the name, aliases or caption of an object in a scene file."
EXAMPLE = 'scene.r5dgs 3 "glazed donut" --alias pastry'
PAGE = "user/words.md"


def add_arguments(p: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    p.add_argument("file", type=Path, metavar="SCENE", help=".r5dgs file; changed in place")
    p.add_argument("object", help="id or name of the object")
    p.add_argument("name", nargs="?", help="new name")
    alias = "additional word for the object; may be repeated"
    p.add_argument("--alias", action="append", default=[], metavar="WORD", help=alias)
    p.add_argument("--caption", metavar="TEXT", help="sentence that describes the object")


def run(args: argparse.Namespace) -> None:
    """Run the command."""
    run_name(args.file, args.object, args.name, aliases=args.alias, caption=args.caption)


@folder_lock.writes("path")
def run_name(
    path: Path, which: str, name: str | None, *, aliases: Sequence[str] = (), caption: str | None = None
) -> Scene:
    """Change the name, aliases or caption of an object in a scene file.

    Args:
        path: The scene file; the write is atomic.
        which: Id or name of the object.
        name: New name; None keeps the old one.
        aliases: Words to add to its aliases.
        caption: New caption; None keeps the old one.

    Returns:
        The scene as written.
    """
    if name is None and not aliases and caption is None:
        raise errors.UsageError("name: expected a new name, --alias WORD or --caption TEXT")
    input_paths.check_scene(path)
    from ...scene import scene_file

    scene = scene_file.read(path)
    item = object_captions.find(scene, which, str(path))
    change: dict[str, Any] = {"aliases": [*item.aliases, *aliases]}
    change |= {} if name is None else {"name": name}
    change |= {} if caption is None else {"caption": caption}
    named = object_captions.apply(scene, {str(item.id): change}, str(path))
    scene_file.write(named, path, precision=scene_file.precision_of(path))
    fresh = named.object(item.id)
    print(f"{path}: object {fresh.id} is {fresh.name!r}" + (f", also {', '.join(fresh.aliases)}" * bool(fresh.aliases)))
    if named.lookup is not None and not named.lookup.encoder.sees:
        print("its lookup table still holds the old words; rebuild it: r5dgs lookup SCENE --encoder ...")
    return named
