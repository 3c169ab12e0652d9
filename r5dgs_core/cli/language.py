"""The commands ``r5dgs lookup``, ``query`` and ``name``, as functions that Python code can call."""

from __future__ import annotations

import json
import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .. import errors, folder_lock, input_paths, strict_json, terminal, user_settings
from . import runs

if TYPE_CHECKING:
    from ..scene.lookup_table import EncoderCard
    from ..scene.scene import Scene, SceneObject
    from ..search.object_search import Match

log = logging.getLogger(__name__)


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
        threads: Threads of the kernels; see `runs.use_threads`.
        progress_kind: Form of progress output (`progress.make`).

    Returns:
        The scene with its lookup table.
    """
    if out is not None:
        input_paths.check_scene_output(out)
    encoder = encoder or user_settings.read().get("encoder")
    if encoder is None:
        raise errors.UsageError(
            "lookup: name an encoder with --encoder DIR, or once with 'r5dgs config --user set encoder DIR'"
        )
    input_paths.check_scene(path)
    from ..language import build_table
    from ..language.encoders import registry
    from ..progress import make
    from ..scene import scene_file

    runs.use_threads(threads)
    scene = scene_file.read(path)
    if captions is not None:
        scene = described(scene, _read_captions(captions), str(captions))
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
        target = scene_file.write(made.scene, out or path, exact=scene_file.is_exact(path))
        if progress_kind == "json":
            notes = {"notes": list(made.notes), "words": len(made.scene.vocabulary)}
            progress({"event": "written", "path": str(target), "encoder": opened.card.kind, **notes})
    if progress_kind != "json":
        table = made.scene.lookup
        count = 0 if table is None else sum(threshold is not None for threshold in table.thresholds)
        print(
            f"{target}: {count} objects and {len(made.scene.vocabulary)} words by {opened.card.kind} {opened.card.name}"
        )
        if not opened.card.sees:
            print("this encoder reads text only: objects are found by their names, not by their appearance")
        for note in made.notes:
            print(note)
    return made.scene


def run_query(
    path: Path, text: str, *, encoder: str | None = None, threshold: float | None = None, as_json: bool = False
) -> tuple[Scene, list[Match]]:
    """Find the objects of a scene file that a text describes, and print them.

    Args:
        path: The scene file.
        text: One or more things to find.
        encoder: Folder of the encoder that made the scene's lookup table, or "text". It embeds phrases that neither
            names nor stored words answer. Another encoder is refused even if no phrase is left. If None, the encoder
            of the user's settings is used if it made the table.
        threshold: Minimum score of a match; the default threshold if None.
        as_json: Print JSON instead of a table.

    Returns:
        The scene, and the matches, best first.
    """
    if threshold is not None and not 0 <= threshold <= 1:
        raise errors.UsageError(f"--threshold {threshold}: expected a number from 0 to 1")
    input_paths.check_scene(path)
    from ..language import query
    from ..scene import scene_file
    from ..search import object_search

    least = object_search.THRESHOLD if threshold is None else threshold
    if not object_search.wishes(text):
        raise errors.UsageError(f"query {text!r}: expected words for the objects to find, such as 'red mug'")
    scene = scene_file.read(path)
    unknown = query.unknown(scene, text)
    if encoder is None and unknown and scene.lookup is not None:
        opened = _user_encoder(scene.lookup.encoder)
    else:
        opened = _encoder_for(scene, encoder, unknown, path)
    found = query.find(scene, text, opened, least)
    if found:
        said = "\n".join(f"nothing matches {phrase!r}" for phrase in query.unanswered(scene, text, opened, least))
    elif object_search.is_nothing(object_search.labels_of(scene), text):
        said = f"{text.strip()!r} asks for no object"
    else:
        said = nothing(scene, text, unknown if encoder is None and opened is None else [])
    if as_json:
        names = {item.id: item.name for item in scene.objects}
        rows = [
            {
                "id": match.object_id,
                "name": names[match.object_id],
                "score": match.score,
                "cosine": match.cosine,
                "relevancy": match.relevancy,
                "why": match.why,
            }
            for match in found
        ]
        print(json.dumps({"query": text, "threshold": least, "matches": rows, "note": said}, indent=1))
    else:
        if found:
            _show(scene, found)
        if said:
            print(said)
    return scene, found


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
        The scene as it was written.
    """
    if name is None and not aliases and caption is None:
        raise errors.UsageError("name: expected a new name, --alias WORD or --caption TEXT")
    input_paths.check_scene(path)
    from ..scene import scene_file

    scene = scene_file.read(path)
    item = _object(scene, which, str(path))
    change: dict[str, Any] = {"aliases": [*item.aliases, *aliases]}
    change |= {} if name is None else {"name": name}
    change |= {} if caption is None else {"caption": caption}
    named = described(scene, {str(item.id): change}, str(path))
    scene_file.write(named, path, exact=scene_file.is_exact(path))
    fresh = named.object(item.id)
    print(f"{path}: object {fresh.id} is {fresh.name!r}" + (f", also {', '.join(fresh.aliases)}" * bool(fresh.aliases)))
    if named.lookup is not None and not named.lookup.encoder.sees:
        print("its lookup table still holds the old words; rebuild it: r5dgs lookup SCENE --encoder ...")
    return named


def described(scene: Scene, captions: dict[str, Any], place: str) -> Scene:
    """Return the scene with changed names, aliases and captions.

    Args:
        scene: The scene.
        captions: Maps the id or name of an object to a caption, or to a dict with ``name aliases caption``.
        place: Origin of ``captions``, for messages.

    Raises:
        ConfigError: An object is missing, a name is taken or empty, or a value has the wrong type.
    """
    changed = {item.id: item for item in scene.objects}
    for which, value in captions.items():
        item = changed[_object(scene, which, place).id]
        entry = {"caption": value} if isinstance(value, str) else value
        if not isinstance(entry, dict) or set(entry) - {"name", "aliases", "caption"}:
            raise errors.ConfigError(f"{place}: {which}: expected a caption, or name, aliases and caption")
        changed[item.id] = replace(
            item,
            name=_text(entry, "name", item.name, place, which),
            caption=_text(entry, "caption", item.caption, place, which),
            aliases=_aliases(entry, item, place, which),
        )
    owners: dict[str, int] = {}
    for item in changed.values():
        if not item.name:
            raise errors.ConfigError(f"{place}: object {item.id}: expected a name, found an empty one")
        if item.name in owners:
            raise errors.ConfigError(
                f"{place}: the name {item.name!r} is taken by object {owners[item.name]}; choose another, or add an "
                "alias, which several objects may share"
            )
        owners[item.name] = item.id
    return replace(scene, objects=tuple(changed[item.id] for item in scene.objects))


def nothing(scene: Scene, text: str, unknown: Sequence[str] = ()) -> str:
    """Return the message for a text without matches; ``unknown`` are the phrases that need an encoder."""
    from ..search import object_search

    said = object_search.explain_nothing(
        [label for label in object_search.labels_of(scene) if label.object_id > 0], text
    )
    if not unknown:
        return said
    asked = " and ".join(repr(phrase) for phrase in unknown)
    if scene.lookup is None:
        return f"{said}\nthe scene has no lookup table, only names count; make one: r5dgs lookup SCENE --encoder DIR"
    return f"{said}\n{asked} is not among the stored words; give the table's encoder for others: --encoder DIR"


def _user_encoder(card: EncoderCard) -> Any:
    """Open the encoder of the user's settings; returns None if it did not make the table."""
    found = user_settings.read().get("encoder")
    if found is None:
        return None
    from ..language import query
    from ..language.encoders import registry

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
    from ..language import query
    from ..language.encoders import registry

    if scene.lookup is None:
        raise errors.BackendError(
            f"{path}: has no lookup table; make one with this encoder: r5dgs lookup {path} --encoder {encoder}"
        )
    opened = registry.open_encoder(encoder)
    query.check(scene.lookup.encoder, opened.card, str(path))
    return opened if unknown else None


def _show(scene: Scene, found: Sequence[Match]) -> None:
    from rich.table import Table
    from rich.text import Text

    names = {item.id: item.name for item in scene.objects}
    table = Table("id", "name", "score", "cosine", "relevancy", "why")
    for match in found:
        numbers = ("-" if value is None else f"{value:.2f}" for value in (match.cosine, match.relevancy))
        cells = (str(match.object_id), names[match.object_id], f"{match.score:.2f}", *numbers, match.why)
        table.add_row(*map(Text, cells))  # as plain text, because names may contain markup brackets
    terminal.console().print(table)


def _object(scene: Scene, which: str, place: str) -> SceneObject:
    """Return the object with an id, or else with a name; ids win because a name may be the number of another object."""
    for known in ({str(item.id): item for item in scene.objects}, {item.name: item for item in scene.objects}):
        if which in known:
            return known[which]
    there = ", ".join(f"{item.id} {item.name!r}" for item in scene.objects)
    raise errors.ConfigError(f"{place}: expected an object of the scene, found {which!r}; there are {there}")


def _text(entry: dict[str, Any], key: str, before: str, place: str, which: str) -> str:
    value = entry.get(key, before)
    if not isinstance(value, str):
        raise errors.ConfigError(f"{place}: {which}: {key}: expected text, found {value!r}")
    return value.strip()


def _aliases(entry: dict[str, Any], item: SceneObject, place: str, which: str) -> tuple[str, ...]:
    aliases = entry.get("aliases", item.aliases)
    if not isinstance(aliases, list | tuple) or not all(isinstance(alias, str) for alias in aliases):
        raise errors.ConfigError(f"{place}: {which}: aliases: expected a list of words, found {aliases!r}")
    return tuple(dict.fromkeys(alias.strip() for alias in aliases if alias.strip()))


def _read_captions(path: Path) -> dict[str, Any]:
    found = strict_json.read(path, errors.ConfigError)
    if not isinstance(found, dict):
        raise errors.ConfigError(f"--captions {path}: expected a JSON object by id or name, found a list or a value")
    return found


def _read_words(path: Path) -> list[str]:
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, ValueError) as error:
        raise errors.ConfigError(f"--words {path}: expected text that can be read: {error}") from error
    return [line.strip() for line in lines if line.strip()]
