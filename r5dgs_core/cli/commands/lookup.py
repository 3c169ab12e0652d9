"""The command ``r5dgs lookup``: store word embeddings in a scene file."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ... import errors, folder_lock, input_paths, strict_json, user_settings
from .. import object_captions, options

if TYPE_CHECKING:
    from ...language.build_table import SceneWithTable
    from ...language.encoders.encoder_base import Encoder
    from ...scene.scene import Scene

NAME = "lookup"
SHORT = "store word embeddings in a scene, for search by text"
LONG = "Embed the objects and common nouns with an encoder, and store the embeddings in the scene file."
EXAMPLE = "scene.r5dgs --encoder CLIP_FOLDER"
PAGE = "user/words.md"


def add_arguments(p: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    p.add_argument("file", type=Path, metavar="SCENE", help=".r5dgs file; changed in place without --out")
    encoder = "folder of the encoder, or 'text' for a small one (default: encoder of 'r5dgs config --user')"
    p.add_argument("--encoder", metavar="DIR|text", help=encoder)
    p.add_argument("--out", type=Path, metavar="FILE.r5dgs", help="scene file to write instead of SCENE")
    captions = "JSON file of captions, names and aliases by object id or name"
    p.add_argument("--captions", type=Path, metavar="FILE.json", help=captions)
    words = "text file of additional words to store, one per line"
    p.add_argument("--words", type=Path, metavar="FILE.txt", help=words)
    options.add_threads(p)
    options.add_progress(p)


def run(args: argparse.Namespace) -> None:
    """Run the command."""
    given = {"out": args.out, "captions": args.captions, "words": args.words, "threads": args.threads}
    run_lookup(args.file, args.encoder, **given, progress_kind=args.progress)


@folder_lock.writes("out", "path")
def run_lookup(
    path: Path,
    encoder: str | None,
    *,
    out: Path | None = None,
    captions: Path | None = None,
    words: Path | None = None,
    threads: int | None = None,
    progress_kind: str = "none",
) -> Scene:
    """Compute the lookup table of a scene file and write it into the file.

    Args:
        path: The scene file.
        encoder: Folder of the encoder, or "text"; the encoder of the user's settings if None.
        out: Scene file to write instead of ``path``.
        captions: JSON file that maps object ids or names to a caption, or to an object with ``name aliases caption``.
        words: Text file of additional words to store, one per line.
        threads: Threads of the kernels; see `options.use_threads`.
        progress_kind: Form of progress output (`progress.make`).

    Returns:
        The scene with its lookup table.
    """
    if out is not None:
        input_paths.check_scene_output(out)
    encoder = _chosen_encoder(encoder)
    input_paths.check_scene(path)
    from ...language import build_table
    from ...language.encoders import registry
    from ...progress import make
    from ...scene import scene_file

    options.use_threads(threads)
    scene = scene_file.read(path)
    if captions is not None:
        scene = object_captions.apply(scene, _read_captions(captions), str(captions))
    extra = [] if words is None else _read_words(words)
    with make(progress_kind) as progress:
        progress({"event": "prepare", "text": f"encoder {encoder}"})
        opened = registry.open_encoder(encoder)
        made = build_table.make(
            scene,
            opened,
            extra,
            progress=lambda what, done, total: progress(
                {"event": f"look up {what}", "done": done, "total": total, "unit": what}
            ),
        )
        target = scene_file.write(made.scene, out or path, precision=scene_file.precision_of(path))
        if progress_kind == "json":
            notes = {"notes": list(made.notes), "words": len(made.scene.vocabulary)}
            progress({"event": "written", "path": str(target), "encoder": opened.card.kind, **notes})
    if progress_kind != "json":
        _print_summary(made, target, opened)
    return made.scene


def _chosen_encoder(given: str | None) -> str:
    """Return the given encoder, or else that of the user's settings."""
    encoder = given or user_settings.read().get("encoder")
    if encoder is None:
        raise errors.UsageError(
            "lookup: name an encoder with --encoder DIR, or once with 'r5dgs config --user set encoder DIR'"
        )
    return encoder


def _print_summary(made: SceneWithTable, path: Path, encoder: Encoder) -> None:
    table, card = made.scene.lookup, encoder.card
    count = 0 if table is None else sum(threshold is not None for threshold in table.thresholds)
    print(f"{path}: {count} objects and {len(made.scene.vocabulary)} words by {card.kind} {card.name}")
    if not card.sees:
        print("this encoder reads text only: objects are found by their names, not by their appearance")
    for note in made.notes:
        print(note)


def _read_captions(path: Path) -> dict[str, Any]:
    found = strict_json.read(path, errors.ConfigError)
    if not isinstance(found, dict):
        raise errors.ConfigError(f"--captions {path}: expected a JSON object by id or name, found a list or a value")
    return found


def _read_words(path: Path) -> list[str]:
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, ValueError) as error:
        raise errors.ConfigError(f"--words {path}: cannot be read as text: {error}") from error
    return [line.strip() for line in lines if line.strip()]
