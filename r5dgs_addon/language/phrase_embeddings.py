"""Embeddings of phrases that no scene file stores, computed by the worker with the text encoder of the preferences.

They are cached for the session. `fetch` blocks until the worker responds. `begin` returns immediately, and a timer
receives the response, unless Blender opens another file, which ends the timer.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import bpy
import numpy as np

from ...r5dgs_core import errors
from ...r5dgs_core.scene.lookup_table import EncoderCard
from .. import preferences
from ..worker import jobs

KEY = "phrases"  # job key for `jobs.busy`
_LOOK_S = 0.1  # timer interval


@dataclass(frozen=True)
class PhraseEmbedding:
    """Embedding of a phrase.

    Attributes:
        digest: SHA-256 of the encoder's weights.
        encoder: Name of the encoder.
        vector: Unit vector. [D]
    """

    digest: str
    encoder: str
    vector: np.ndarray


_known: dict[tuple[str, str], PhraseEmbedding] = {}  # by encoder folder and phrase
_job: jobs.Job | None = None
_asked: tuple[str, list[str]] = ("", [])  # folder and phrases of the job
_then: Callable[[str], None] | None = None


def of(phrase: str, card: EncoderCard) -> np.ndarray | None:
    """Return the cached embedding of a phrase, or None if it is missing or from another encoder than the table's."""
    found = _known.get((preferences.text_encoder(), phrase))
    return found.vector if found is not None and found.digest == card.digest else None


def is_there() -> bool:
    """True if the preferences name an encoder."""
    return bool(preferences.text_encoder())


def missing(asked: Sequence[str]) -> list[str]:
    """Phrases without a cached embedding of the preferences' encoder; empty without an encoder."""
    where = preferences.text_encoder()
    return [phrase for phrase in asked if (where, phrase) not in _known] if where else []


def stranger(asked: Sequence[str], card: EncoderCard) -> str:
    """Name of the preferences' encoder if it differs from the table's, otherwise ""."""
    where = preferences.text_encoder()
    found = (_known.get((where, phrase)) for phrase in asked)
    return next((one.encoder for one in found if one is not None and one.digest != card.digest), "")


def fetch(asked: Sequence[str]) -> None:
    """Embed phrases and wait for the result. Raises the same errors as `jobs.run`."""
    where = preferences.text_encoder()
    _keep(where, asked, jobs.run(_steps(where, asked)))


def begin(asked: Sequence[str], then: Callable[[str], None]) -> None:
    """Embed phrases without blocking the window.

    Args:
        asked: Phrases; they replace an earlier request that has not started.
        then: Callback in Blender's main thread, called with "" or an error message.
    """
    global _job, _asked, _then
    where = preferences.text_encoder()
    _job, _asked, _then = jobs.submit(KEY, _steps(where, asked)), (where, list(asked)), then
    if not bpy.app.timers.is_registered(look):
        bpy.app.timers.register(look, first_interval=_LOOK_S)


def look() -> float | None:
    """Receive the worker's response if it is ready. Returns the timer interval, or None to stop."""
    global _job, _then
    if _job is None:
        return None
    if not _job.done:
        return _LOOK_S
    (where, asked), job, then = _asked, _job, _then
    _job, _then = None, None
    wrong = ""
    try:
        _keep(where, asked, job.answer())
    except errors.R5dgsError as error:
        wrong = str(error)
    if then is not None:
        then(wrong)
    return None if _job is None else _LOOK_S


def forget() -> None:
    """Clear the cache and stop the timer."""
    global _job, _then
    _job, _then = None, None
    _known.clear()
    if bpy.app.timers.is_registered(look):
        bpy.app.timers.unregister(look)


def _steps(where: str, asked: Sequence[str]) -> jobs.Steps:
    return [("running the text encoder", "embed", {"encoder": where, "texts": list(asked)})]


def _keep(where: str, asked: Sequence[str], answer: jobs.Answer) -> None:
    result, arrays = answer
    card = result["encoder"]
    for phrase, vector in zip(asked, arrays["embeddings"], strict=True):
        _known[where, phrase] = PhraseEmbedding(card["digest"], card["name"], np.array(vector))
