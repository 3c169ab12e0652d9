"""Search for objects by words, using the .blend's object table and the embeddings of the scene file.

Names and aliases need neither the scene file nor torch. Embeddings are read from the file on first use and cached until
it changes. Words without stored embeddings are embedded by the encoder of the preferences in the worker
(`phrase_embeddings`), and the matches are merged.
"""

import functools
from dataclasses import dataclass, replace

import bpy

from ...r5dgs_core import errors
from ...r5dgs_core.scene import scene_file, stored_embeddings
from ...r5dgs_core.search import object_search
from ..engine import render_request
from ..scene import file_cache, loaded_scenes, object_names, selection
from ..ui import status_bar
from . import phrase_embeddings

HISTORY = 12  # maximum number of stored prompts
ASKING = "Running the text encoder for "  # prefix of the note shown while the encoder runs
OTHER_ENCODER = (
    "{0}: its table was made by the encoder {1!r}, but the preferences name {2!r}; choose {1!r} there, or make the "
    "table again with {2!r}"
)
_embeddings: file_cache.Remembered[stored_embeddings.StoredEmbeddings | None] = file_cache.Remembered(
    scene_file.read_embeddings
)


@dataclass(frozen=True)
class Match:
    """Match of a prompt: object of a loaded scene, score (at most 1), and the reason."""

    scene: bpy.types.Collection
    object_id: int
    name: str
    score: float
    why: str


@dataclass(frozen=True)
class Answer:
    """Result of a prompt.

    Attributes:
        matches: Matches, best first.
        suggestions: Suggested names if nothing matches.
        notes: Messages, for example about deleted objects or missing files.
        missing: Phrases that the encoder of the preferences could embed but has not yet.
        error: Reason why the prompt is invalid, or "".
        asks_for_nothing: True if the prompt asks for no object, such as "none".
    """

    matches: list[Match]
    suggestions: list[str]
    notes: list[str]
    missing: tuple[str, ...] = ()
    error: str = ""
    asks_for_nothing: bool = False

    @property
    def objects(self) -> list[selection.Wanted]:
        """Matching objects, best first."""
        return [(match.scene, match.object_id) for match in self.matches]


def search(loaded: list[bpy.types.Collection], text: str, threshold: float = object_search.THRESHOLD) -> Answer:
    """Search objects of loaded scenes by words.

    Args:
        loaded: Scenes to search.
        text: One or several names: "red mug", "mugs and lemon".
        threshold: Minimum score of a match.

    Returns:
        The result; equal scores are in the order of ``loaded``.
    """
    try:
        return _search(loaded, text, threshold)
    except errors.ConfigError as error:
        return Answer([], [], [str(error)], error=str(error))


def _search(loaded: list[bpy.types.Collection], text: str, threshold: float) -> Answer:
    matches, deleted, notes, known, missing, without_encoder = [], [], [], [], [], []
    unanswered: list[list[str]] = []
    not_excluded: list[list[str]] = []  # excluded phrases that match nothing
    for collection in loaded:
        labels = object_names.labels(collection)
        there = object_names.present(collection)
        names = {label.object_id: label.name for label in labels}
        known += [label for label in labels if label.object_id in there]
        embeddings, note = _stored_embeddings(collection)
        notes += [note] if note else []
        embed = None
        if embeddings is not None and embeddings.table is not None:
            card, unknown = embeddings.table.encoder, object_search.unknown(labels, text, embeddings)
            missing += phrase_embeddings.missing(unknown)
            without_encoder += [] if phrase_embeddings.has_encoder() else unknown
            other = phrase_embeddings.other_encoder(unknown, card)
            notes += [OTHER_ENCODER.format(collection.name, card.name, other)] if other else []
            embed = functools.partial(phrase_embeddings.of, card=card)
        unanswered.append(object_search.unanswered(labels, text, threshold, embeddings, embed))
        not_excluded.append(object_search.not_excluded(labels, text, threshold, embeddings, embed))
        for found in object_search.search_labels(labels, text, threshold, embeddings, embed):
            if found.object_id in there:
                matches.append(Match(collection, found.object_id, names[found.object_id], found.score, found.why))
            elif not found.why.startswith(object_search.EVERYTHING):
                deleted.append(names[found.object_id])
    unfit = (
        [phrase for phrase in not_excluded[0] if all(phrase in each for each in not_excluded)] if not_excluded else []
    )
    if unfit:  # until the encoder responds, the exclusions are unknown
        matches = []
        object_search.check_exclusions(known, text, [phrase for phrase in unfit if phrase not in missing])
    if without_encoder and not matches:
        asked = " and ".join(repr(phrase) for phrase in dict.fromkeys(without_encoder))
        notes.append(f"{asked}: no stored word; name the scene's encoder under Text Encoder in the preferences")
    if matches:  # one of several phrases may have no match
        void = [
            phrase for phrase in unanswered[0] if phrase not in missing and all(phrase in each for each in unanswered)
        ]
        notes += [f"Nothing matches {' and '.join(map(repr, void))}"] if void else []
    if deleted:
        notes.insert(0, f"Deleted: {', '.join(deleted)}")
    notes += _instances({match.scene for match in matches})
    matches.sort(key=lambda match: -round(match.score, 6))
    suggestions = [] if matches or not text.strip() else list(dict.fromkeys(object_search.suggest(known, text)))
    asks_for_nothing = bool(loaded) and all(
        object_search.is_nothing(object_names.labels(each), text) for each in loaded
    )
    return Answer(matches, suggestions, notes, tuple(dict.fromkeys(missing)), asks_for_nothing=asks_for_nothing)


def _instances(found: set[bpy.types.Collection]) -> list[str]:
    """Notes about instanced scenes, whose objects cannot be selected individually."""
    instanced = {
        one: empties for one, empties in loaded_scenes.shown(bpy.context.scene).items() if one in found and empties
    }
    return [
        f"{one.name} is instanced by {' and '.join(empty.name for empty in empties)}; its objects cannot be selected "
        "one by one"
        for one, empties in instanced.items()
    ]


def explain_nothing(loaded: list[bpy.types.Collection], text: str, answer: Answer) -> str:
    """Message for the user if nothing matched."""
    there = [(object_names.labels(each), object_names.present(each)) for each in loaded]
    labels = [label for own, ids in there for label in own if label.object_id in ids]
    said = object_search.explain_nothing(labels, text)
    return ". ".join([said[0].upper() + said[1:], *answer.notes])


def ask(context: bpy.types.Context, text: str) -> Answer:
    """Search with the sidebar's settings, show the result there, and store a prompt with matches in the history.

    Without a window, this waits for the encoder. With a window, the result is shown without the words that need the
    encoder, and updated when it responds.
    """
    text = text.strip()
    answer = _answer(context, text)
    if answer.missing:
        answer = _with_encoder(context, text, answer)
    return _show_and_store(context, text, answer)


def _answer(context: bpy.types.Context, text: str) -> Answer:
    return search(scope(context), text, context.scene.r5dgs_words.threshold) if text else Answer([], [], [])


def _with_encoder(context: bpy.types.Context, text: str, answer: Answer) -> Answer:
    """Result including the encoder's matches, or with a note that it is running or why it failed."""
    asked = " and ".join(repr(phrase) for phrase in answer.missing)
    if _has_window():
        phrase_embeddings.start(answer.missing, functools.partial(_show_again, text))
        return replace(answer, notes=[*answer.notes, f"{ASKING}{asked}"])
    try:
        phrase_embeddings.fetch(answer.missing)
    except errors.R5dgsError as error:
        return replace(answer, notes=[*answer.notes, f"Text encoder: {error}"])
    return _answer(context, text)


def _has_window() -> bool:
    """True if there is a window, which must not be blocked."""
    return not bpy.app.background and bool(bpy.context.window_manager.windows)


def _show_again(text: str, wrong: str) -> None:
    """Show the result again with the encoder's matches."""
    there = bpy.context.window_manager.windows
    if not there or bpy.context.window_manager.r5dgs_words.asked != text:
        return
    with bpy.context.temp_override(window=there[0]):
        answer = _answer(bpy.context, text)
        _show_and_store(
            bpy.context, text, replace(answer, notes=[*answer.notes, f"Text encoder: {wrong}"]) if wrong else answer
        )
    status_bar.redraw()


def _show_and_store(context: bpy.types.Context, text: str, answer: Answer) -> Answer:
    """Show the result and store the prompt. Returns the result."""
    settings = context.scene.r5dgs_words
    _show(context.window_manager.r5dgs_words, text, answer)
    if answer.matches:
        _keep(settings.history, text)
    return answer


def scope(context: bpy.types.Context) -> list[bpy.types.Collection]:
    """Scenes to search: the active one, or all if *All Scenes* is on."""
    loaded = selection.scenes(context)
    return loaded if context.scene.r5dgs_words.all_scenes else loaded[:1]


def forget() -> None:
    """Clear the cache of scene file embeddings."""
    _embeddings.clear()


def _stored_embeddings(collection: bpy.types.Collection) -> tuple[stored_embeddings.StoredEmbeddings | None, str]:
    """Embeddings of a scene's file, or None and a message for the user."""
    if not collection.r5dgs_named.meanings:
        return None, ""
    try:
        return _embeddings.get(render_request.scene_path(collection)), ""
    except errors.SceneFileError as error:
        return None, f"{collection.name}: searched by names only, because its scene file cannot be read: {error}"


def _show(session: bpy.types.PropertyGroup, text: str, answer: Answer) -> None:
    session.asked = text  # set first, because the update callback compares it
    session.prompt = text
    session.matches.clear()
    for match in answer.matches:
        item = session.matches.add()
        item.name, item.scene, item.object_id = match.name, match.scene.name, match.object_id
        item.score, item.why = match.score, match.why
    for items, texts in ((session.meant, answer.suggestions), (session.notes, answer.notes)):
        items.clear()
        for line in texts:
            items.add().name = line


def _keep(history: bpy.types.bpy_prop_collection, text: str) -> None:
    """Move a prompt to the front of the history."""
    known = [item.name for item in history]
    wanted = [text, *(item for item in known if item != text)][:HISTORY]
    if wanted == known:
        return
    history.clear()
    for item in wanted:
        history.add().name = item
