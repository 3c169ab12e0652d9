"""The command ``r5dgs query``: find the objects that a text describes."""

from __future__ import annotations

import argparse
import json
import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ... import errors, input_paths, terminal, user_settings
from .. import inputs, options, pictures
from ..exit_status import ExitStatus

if TYPE_CHECKING:
    from ...scene.lookup_table import EncoderCard
    from ...scene.scene import Scene
    from ...search.object_search import Match

log = logging.getLogger(__name__)

NAME = "query"
SHORT = "find the objects that a text describes"
LONG = "Find the objects of a scene that a text describes. The exit status is 1 if nothing is found."
EXAMPLE = 'scene.r5dgs "red mug"'
PAGE = "user/words.md"


def add_arguments(p: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    p.add_argument("file", type=Path, metavar="SCENE", help=".r5dgs file")
    p.add_argument("text", help="one or more things to find: 'red mug', 'mugs and lemon'")
    encoder = (
        "encoder that made the lookup table, for words not stored in it (default: encoder of 'r5dgs config --user')"
    )
    p.add_argument("--encoder", metavar="DIR|text", help=encoder)
    p.add_argument("--threshold", type=float, metavar="SCORE", help="minimum score of a match, 0 to 1 (default: 0.5)")
    p.add_argument("--json", action="store_true", help="print JSON instead of the table")
    render = "write a picture of the objects found, on a transparent background"
    p.add_argument("--render", type=Path, metavar="FILE.png", help=render)
    context = "show the rest of the scene dimmed in the picture of --render"
    p.add_argument("--context", action="store_true", help=context)
    pictures.add_arguments(p)


def run(args: argparse.Namespace) -> ExitStatus | None:
    """Run the command."""
    given = {"encoder": args.encoder, "threshold": args.threshold, "as_json": args.json}
    given |= {"render": args.render, "context": args.context}
    return None if run_query(args.file, args.text, **given, **pictures.values_of(args)) else ExitStatus.NEGATIVE


def run_query(
    path: Path,
    text: str,
    *,
    encoder: str | None = None,
    threshold: float | None = None,
    as_json: bool = False,
    render: Path | None = None,
    context: bool = False,
    threads: int | None = None,
    **picture: Any,
) -> list[Match]:
    """Find the objects of a scene file that a text describes, print them and optionally draw them.

    Args:
        path: The scene file.
        text: One or more things to find.
        encoder: Folder of the encoder that made the scene's lookup table, or "text". It embeds phrases that match
            neither a name nor a stored word. Any other encoder is an error, even if no phrase needs one. If None, the
            encoder of the user's settings is used if it made the table.
        threshold: Minimum score of a match; the default threshold if None.
        as_json: Print JSON instead of a table.
        render: PNG file of the picture, or None.
        context: Show the rest of the scene dimmed.
        threads: Threads of the kernels; see `options.use_threads`.
        **picture: ``camera``, ``t``, ``mode`` and ``size`` of `pictures.draw`.

    Returns:
        The matches, best first. No picture is drawn if there are none.
    """
    if render is None and context:
        raise errors.UsageError("--context: requires a picture; add --render FILE.png")
    pictures.check("--render", render, picture.get("camera"), picture.get("t"), picture.get("size"))
    inputs.check_mode(picture.get("mode", "rigid"))
    if threshold is not None and not 0 <= threshold <= 1:
        raise errors.UsageError(f"--threshold {threshold}: expected a number from 0 to 1")
    input_paths.check_scene(path)
    scene, found = _find(path, text, encoder, threshold, as_json)
    if render is None or not found:
        return found
    options.use_threads(threads)
    viewpoint = pictures.draw(scene, [match.object_id for match in found], render, context=context, **picture)
    if not as_json:
        print(f"written: {render} (camera {viewpoint.camera.name}, t = {viewpoint.t:g})")
    return found


def _find(
    path: Path, text: str, encoder: str | None, threshold: float | None, as_json: bool
) -> tuple[Scene, list[Match]]:
    """Find objects and print them; returns the scene and the matches, best first."""
    from ...language import query
    from ...scene import scene_file
    from ...search import object_search

    least = object_search.THRESHOLD if threshold is None else threshold
    if not object_search.phrases_of(text):
        raise errors.UsageError(f"query {text!r}: expected words for the objects to find, such as 'red mug'")
    scene = scene_file.read(path)
    unknown = query.unknown(scene, text)
    if encoder is None and unknown and scene.lookup is not None:
        opened = _user_encoder(scene.lookup.encoder)
    else:
        opened = _encoder_for(scene, encoder, unknown, path)
    found = query.find(scene, text, opened, least)
    if found:
        note = "\n".join(f"nothing matches {phrase!r}" for phrase in query.unanswered(scene, text, opened, least))
    elif object_search.is_nothing(object_search.labels_of(scene), text):
        note = f"{text.strip()!r} selects no objects"
    else:
        note = _explain_nothing(scene, text, unknown if encoder is None and opened is None else [])
    names = {item.id: item.name for item in scene.objects}
    if as_json:
        rows = [_row(match, names[match.object_id]) for match in found]
        print(json.dumps({"query": text, "threshold": least, "matches": rows, "note": note}, indent=1))
    else:
        if found:
            _show(found, names)
        if note:
            print(note)
    return scene, found


def _row(match: Match, name: str) -> dict[str, Any]:
    """Return a match as printed by ``--json``."""
    return {
        "id": match.object_id,
        "name": name,
        "score": match.score,
        "cosine": match.cosine,
        "relevancy": match.relevancy,
        "why": match.why,
    }


def _explain_nothing(scene: Scene, text: str, unknown: Sequence[str]) -> str:
    """Return the message for a text without matches; ``unknown`` are the phrases that need an encoder."""
    from ...search import object_search

    reason = object_search.explain_nothing(
        [label for label in object_search.labels_of(scene) if label.object_id > 0], text
    )
    if not unknown:
        return reason
    phrases = " and ".join(repr(phrase) for phrase in unknown)
    if scene.lookup is None:
        return f"{reason}\nonly names are searched without a lookup table; make one: r5dgs lookup SCENE --encoder DIR"
    return f"{reason}\nnot among the stored words: {phrases}; give the table's encoder for other words: --encoder DIR"


def _user_encoder(card: EncoderCard) -> Any:
    """Open the encoder of the user's settings; returns None if it did not make the table."""
    found = user_settings.read().get("encoder")
    if found is None:
        return None
    from ...language import query
    from ...language.encoders import registry

    opened = registry.open_encoder(found)
    try:
        query.check(card, opened.card, found)
    except errors.BackendError as error:
        log.warning("the encoder of the user's settings is not used: %s", error)
        return None
    return opened


def _encoder_for(scene: Scene, encoder: str | None, unknown: Sequence[str], path: Path) -> Any:
    """Open ``encoder`` and check that it made the table; returns None if no phrase needs it."""
    if encoder is None:
        return None
    from ...language import query
    from ...language.encoders import registry

    if scene.lookup is None:
        raise errors.BackendError(
            f"{path}: has no lookup table; make one with this encoder: r5dgs lookup {path} --encoder {encoder}"
        )
    opened = registry.open_encoder(encoder)
    query.check(scene.lookup.encoder, opened.card, str(path))
    return opened if unknown else None


def _show(found: Sequence[Match], names: Mapping[int, str]) -> None:
    from rich.table import Table
    from rich.text import Text

    table = Table("id", "name", "score", "cosine", "relevancy", "why")
    for match in found:
        numbers = ("-" if value is None else f"{value:.2f}" for value in (match.cosine, match.relevancy))
        cells = (str(match.object_id), names[match.object_id], f"{match.score:.2f}", *numbers, match.why)
        table.add_row(*map(Text, cells))  # as plain text, because names may contain markup brackets
    terminal.console().print(table)
