"""Words to objects, by the table that the .blend keeps and by the embeddings that the scene file stores.

Names and aliases need neither the scene file nor torch. Embeddings of words are read from the file when it is first
asked, and kept until it changes. Words that the file does not know are left to the encoder of the preferences, which
the worker opens (`phrase_embeddings`); its answers join the others.
"""

import functools
from dataclasses import dataclass, replace

import bpy

from ...r5dgs_core import errors
from ...r5dgs_core.scene import scene_file
from ...r5dgs_core.search import object_search
from ..engine import render_request
from ..scene import file_cache, loaded_scenes, object_names, selection
from ..ui import status_bar
from . import phrase_embeddings

HISTORY = 12  # prompts kept
ASKING = "Asking the text encoder for "  # begins a note: there may be more matches soon
STRANGER = "{}: made by the encoder {!r}; the preferences' {!r} cannot be asked: make its table again with that one"
_meanings: file_cache.Remembered[object_search.Meanings | None] = file_cache.Remembered(scene_file.read_meanings)


@dataclass(frozen=True)
class Match:
    """One answer: an object of a loaded scene, how well it matches (at most 1), and what matched."""

    scene: bpy.types.Collection
    object_id: int
    name: str
    score: float
    why: str


@dataclass(frozen=True)
class Answer:
    """What there is to say to a prompt.

    Attributes:
        matches: Best first.
        meant: Names that may have been meant where nothing matches.
        notes: Sentences: matches that were deleted, files that were not found.
        missing: Phrases that the encoder of the preferences could answer, and was not asked for yet.
        error: Why the prompt cannot be answered; else empty.
        nothing: True for a prompt that asks for no object, such as "none".
    """

    matches: list[Match]
    meant: list[str]
    notes: list[str]
    missing: tuple[str, ...] = ()
    error: str = ""
    nothing: bool = False

    @property
    def objects(self) -> list[selection.Wanted]:
        """The objects that match, best first."""
        return [(match.scene, match.object_id) for match in self.matches]


def search(loaded: list[bpy.types.Collection], text: str, threshold: float = object_search.THRESHOLD) -> Answer:
    """Objects of loaded scenes that words name.

    Args:
        loaded: The scenes to search.
        text: One or several names: "red mug", "mugs and lemon".
        threshold: Least score of a match.

    Returns:
        The answer; equal scores are in the order of ``loaded``.
    """
    try:
        return _search(loaded, text, threshold)
    except errors.ConfigError as error:
        return Answer([], [], [str(error)], error=str(error))


def _search(loaded: list[bpy.types.Collection], text: str, threshold: float) -> Answer:
    matches, deleted, notes, known, missing, lost = [], [], [], [], [], []
    left: list[list[str]] = []
    kept: list[list[str]] = []  # phrases that were to be left out and match nothing
    for collection in loaded:
        labels = object_names.labels(collection)
        there = object_names.present(collection)
        names = {label.object_id: label.name for label in labels}
        known += [label for label in labels if label.object_id in there]
        meanings, note = _stored_meanings(collection)
        notes += [note] if note else []
        embed = None
        if meanings is not None and meanings.table is not None:
            card, unknown = meanings.table.encoder, object_search.unknown(labels, text, meanings)
            missing += phrase_embeddings.missing(unknown)
            lost += [] if phrase_embeddings.is_there() else unknown
            other = phrase_embeddings.stranger(unknown, card)
            notes += [STRANGER.format(collection.name, card.name, other)] if other else []
            embed = functools.partial(phrase_embeddings.of, card=card)
        left.append(object_search.unanswered(labels, text, threshold, meanings, embed))
        kept.append(object_search.not_excluded(labels, text, threshold, meanings, embed))
        for found in object_search.search_labels(labels, text, threshold, meanings, embed):
            if found.object_id in there:
                matches.append(Match(collection, found.object_id, names[found.object_id], found.score, found.why))
            elif not found.why.startswith(object_search.EVERYTHING):
                deleted.append(names[found.object_id])
    unfit = [phrase for phrase in kept[0] if all(phrase in each for each in kept)] if kept else []
    if unfit:  # until the encoder has been asked, nobody knows what is left out
        matches = []
        object_search.check_exclusions(known, text, [phrase for phrase in unfit if phrase not in missing])
    if lost and not matches:
        asked = " and ".join(repr(phrase) for phrase in dict.fromkeys(lost))
        notes.append(f"{asked}: no stored word; name the scene's encoder under Text Encoder in the preferences")
    if matches:  # of several wishes some may have found nothing
        void = [phrase for phrase in left[0] if phrase not in missing and all(phrase in each for each in left)]
        notes += [f"Nothing matches {' and '.join(map(repr, void))}"] if void else []
    if deleted:
        notes.insert(0, f"Deleted: {', '.join(deleted)}")
    notes += _instances({match.scene for match in matches})
    matches.sort(key=lambda match: -round(match.score, 6))
    meant = [] if matches or not text.strip() else list(dict.fromkeys(object_search.suggest(known, text)))
    nothing = bool(loaded) and all(object_search.is_nothing(object_names.labels(each), text) for each in loaded)
    return Answer(matches, meant, notes, tuple(dict.fromkeys(missing)), nothing=nothing)


def _instances(found: set[bpy.types.Collection]) -> list[str]:
    """Notes on scenes that are instanced: their objects are found, and cannot be selected one by one."""
    instanced = {
        one: empties for one, empties in loaded_scenes.shown(bpy.context.scene).items() if one in found and empties
    }
    return [
        f"{one.name} is an instance: Select takes {' and '.join(empty.name for empty in empties)} as a whole"
        for one, empties in instanced.items()
    ]


def explain_nothing(loaded: list[bpy.types.Collection], text: str, answer: Answer) -> str:
    """A sentence for the user when nothing matched."""
    there = [(object_names.labels(each), object_names.present(each)) for each in loaded]
    labels = [label for own, ids in there for label in own if label.object_id in ids]
    said = object_search.explain_nothing(labels, text)
    return ". ".join([said[0].upper() + said[1:], *answer.notes])


def ask(context: bpy.types.Context, text: str) -> Answer:
    """Search as the sidebar's settings say, show the answer there, and remember a prompt that found something.

    Words that only an encoder knows are waited for where there is no window; in one, the answer without them is shown,
    and theirs when it comes.
    """
    text = text.strip()
    answer = _answer(context, text)
    if answer.missing:
        answer = _with_encoder(context, text, answer)
    return _told(context, text, answer)


def _answer(context: bpy.types.Context, text: str) -> Answer:
    return search(scope(context), text, context.scene.r5dgs_words.threshold) if text else Answer([], [], [])


def _with_encoder(context: bpy.types.Context, text: str, answer: Answer) -> Answer:
    """The answer once the encoder has said its part, or with a note that it is being asked, or why it cannot be."""
    asked = " and ".join(repr(phrase) for phrase in answer.missing)
    if _has_window():
        phrase_embeddings.begin(answer.missing, functools.partial(_join, text))
        return replace(answer, notes=[*answer.notes, f"{ASKING}{asked}"])
    try:
        phrase_embeddings.fetch(answer.missing)
    except errors.R5dgsError as error:
        return replace(answer, notes=[*answer.notes, f"Text encoder: {error}"])
    return _answer(context, text)


def _has_window() -> bool:
    """Whether somebody looks at a window, which must not wait."""
    return not bpy.app.background and bool(bpy.context.window_manager.windows)


def _join(text: str, wrong: str) -> None:
    """Show the answer again, now that the encoder has said its part."""
    there = bpy.context.window_manager.windows
    if not there or bpy.context.window_manager.r5dgs_words.asked != text:
        return
    with bpy.context.temp_override(window=there[0]):
        answer = _answer(bpy.context, text)
        _told(bpy.context, text, replace(answer, notes=[*answer.notes, f"Text encoder: {wrong}"]) if wrong else answer)
    status_bar.redraw()


def _told(context: bpy.types.Context, text: str, answer: Answer) -> Answer:
    """The answer, shown and remembered."""
    settings = context.scene.r5dgs_words
    _show(context.window_manager.r5dgs_words, text, answer)
    if answer.matches:
        _keep(settings.history, text)
    return answer


def scope(context: bpy.types.Context) -> list[bpy.types.Collection]:
    """The scenes to search: the active one, or all where the user wants that."""
    loaded = selection.scenes(context)
    return loaded if context.scene.r5dgs_words.all_scenes else loaded[:1]


def forget() -> None:
    """Drop what was read from scene files."""
    _meanings.clear()


def _stored_meanings(collection: bpy.types.Collection) -> tuple[object_search.Meanings | None, str]:
    """The embeddings of a scene's file, or none and why the user should know."""
    if not collection.r5dgs_named.meanings:
        return None, ""
    try:
        return _meanings.get(render_request.scene_path(collection)), ""
    except errors.SceneFileError as error:
        return None, f"{collection.name}: searched by names alone, as its scene file cannot be read: {error}"


def _show(session: bpy.types.PropertyGroup, text: str, answer: Answer) -> None:
    session.asked = text  # first: the field asks where it differs
    session.prompt = text
    session.matches.clear()
    for match in answer.matches:
        item = session.matches.add()
        item.name, item.scene, item.object_id = match.name, match.scene.name, match.object_id
        item.score, item.why = match.score, match.why
    for items, texts in ((session.meant, answer.meant), (session.notes, answer.notes)):
        items.clear()
        for line in texts:
            items.add().name = line


def _keep(history: bpy.types.bpy_prop_collection, text: str) -> None:
    """Put a prompt first, once."""
    known = [item.name for item in history]
    wanted = [text, *(item for item in known if item != text)][:HISTORY]
    if wanted == known:
        return
    history.clear()
    for item in wanted:
        history.add().name = item
