"""Embeddings of phrases that no scene file stores, computed by the worker with the text encoder of the preferences.

They are cached for the session. `fetch` blocks until the worker responds. `start` returns immediately, and a timer
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
_POLL_S = 0.1  # timer interval


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
_job_phrases: tuple[str, list[str]] = ("", [])  # folder and phrases of the job
_on_done: Callable[[str], None] | None = None


def of(phrase: str, card: EncoderCard) -> np.ndarray | None:
    """Return the cached embedding of a phrase, or None if it is missing or from another encoder than the table's."""
    found = _known.get((preferences.text_encoder(), phrase))
    return found.vector if found is not None and found.digest == card.digest else None


def has_encoder() -> bool:
    """True if the preferences name an encoder."""
    return bool(preferences.text_encoder())


def missing(phrases: Sequence[str]) -> list[str]:
    """Phrases without a cached embedding of the preferences' encoder; empty without an encoder."""
    folder = preferences.text_encoder()
    return [phrase for phrase in phrases if (folder, phrase) not in _known] if folder else []


def other_encoder(phrases: Sequence[str], card: EncoderCard) -> str:
    """Name of the preferences' encoder if it differs from the table's, otherwise ""."""
    folder = preferences.text_encoder()
    found = (_known.get((folder, phrase)) for phrase in phrases)
    return next((one.encoder for one in found if one is not None and one.digest != card.digest), "")


def fetch(phrases: Sequence[str]) -> None:
    """Embed phrases and wait for the result. Raises the same errors as `jobs.run`."""
    folder = preferences.text_encoder()
    _keep(folder, phrases, jobs.run(_steps(folder, phrases)))


def start(phrases: Sequence[str], on_done: Callable[[str], None]) -> None:
    """Embed phrases without blocking the window.

    Args:
        phrases: Phrases; they replace an earlier request that has not started.
        on_done: Callback in Blender's main thread, called with "" or an error message.
    """
    global _job, _job_phrases, _on_done
    folder = preferences.text_encoder()
    _job, _job_phrases, _on_done = jobs.submit(KEY, _steps(folder, phrases)), (folder, list(phrases)), on_done
    if not bpy.app.timers.is_registered(poll):
        bpy.app.timers.register(poll, first_interval=_POLL_S)


def poll() -> float | None:
    """Receive the worker's response if it is ready. Returns the timer interval, or None to stop."""
    global _job, _on_done
    if _job is None:
        return None
    if not _job.done:
        return _POLL_S
    (folder, phrases), job, on_done = _job_phrases, _job, _on_done
    _job, _on_done = None, None
    message = ""
    try:
        _keep(folder, phrases, job.answer())
    except errors.R5dgsError as error:
        message = str(error)
    if on_done is not None:
        on_done(message)
    return None if _job is None else _POLL_S


def forget() -> None:
    """Clear the cache and stop the timer."""
    global _job, _on_done
    _job, _on_done = None, None
    _known.clear()
    if bpy.app.timers.is_registered(poll):
        bpy.app.timers.unregister(poll)


def _steps(folder: str, phrases: Sequence[str]) -> jobs.Steps:
    return [("running the text encoder", "embed", {"encoder": folder, "texts": list(phrases)})]


def _keep(folder: str, phrases: Sequence[str], answer: jobs.Answer) -> None:
    result, arrays = answer
    card = result["encoder"]
    for phrase, vector in zip(phrases, arrays["embeddings"], strict=True):
        _known[folder, phrase] = PhraseEmbedding(card["digest"], card["name"], np.array(vector))
