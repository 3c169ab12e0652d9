"""Embeddings of phrases that no scene file stores: the worker makes them with the encoder that the preferences name.

They are kept for the session. `fetch` waits for the worker; `begin` lets it work beside the window, and a timer takes
its answer, unless Blender opens another file: that ends the timer.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import bpy
import numpy as np

from ...r5dgs_core import errors
from ...r5dgs_core.scene.lookup_table import EncoderCard
from .. import preferences
from ..worker import jobs

KEY = "phrases"  # what `jobs.busy` knows its jobs by
_LOOK_S = 0.1  # between two looks at the job


@dataclass(frozen=True)
class Embedded:
    """A phrase as an encoder sees it.

    Attributes:
        digest: SHA-256 of the encoder's weights.
        encoder: Its name.
        vector: Unit. [D]
    """

    digest: str
    encoder: str
    vector: np.ndarray


_known: dict[tuple[str, str], Embedded] = {}  # by the encoder's folder and phrase
_job: jobs.Job | None = None
_asked: tuple[str, list[str]] = ("", [])  # what the job was asked for: folder and phrases
_then: Callable[[str], None] | None = None


def of(phrase: str, card: EncoderCard) -> np.ndarray | None:
    """The embedding of a phrase by the encoder of a table; None where it is not known, or known by another encoder."""
    found = _known.get((preferences.text_encoder(), phrase))
    return found.vector if found is not None and found.digest == card.digest else None


def is_there() -> bool:
    """Whether the preferences name an encoder."""
    return bool(preferences.text_encoder())


def missing(asked: Sequence[str]) -> list[str]:
    """The phrases that the encoder of the preferences has not been asked for yet; none where there is no encoder."""
    where = preferences.text_encoder()
    return [phrase for phrase in asked if (where, phrase) not in _known] if where else []


def stranger(asked: Sequence[str], card: EncoderCard) -> str:
    """Name of the encoder in the preferences, where it is another one than that of a table; else empty."""
    where = preferences.text_encoder()
    found = (_known.get((where, phrase)) for phrase in asked)
    return next((one.encoder for one in found if one is not None and one.digest != card.digest), "")


def fetch(asked: Sequence[str]) -> None:
    """Have phrases embedded, and wait for it. Raises as `jobs.run`."""
    where = preferences.text_encoder()
    _keep(where, asked, jobs.run(_steps(where, asked)))


def begin(asked: Sequence[str], then: Callable[[str], None]) -> None:
    """Have phrases embedded beside the window.

    Args:
        asked: The phrases; what was asked for before and has not begun is dropped.
        then: Called in Blender's main thread when they are known, with "", or with what went wrong.
    """
    global _job, _asked, _then
    where = preferences.text_encoder()
    _job, _asked, _then = jobs.submit(KEY, _steps(where, asked)), (where, list(asked)), then
    if not bpy.app.timers.is_registered(look):
        bpy.app.timers.register(look, first_interval=_LOOK_S)


def look() -> float | None:
    """Take the worker's answer where it is there. Returns seconds to the next look, None for no more."""
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
    """Drop what is known, and wait for nothing."""
    global _job, _then
    _job, _then = None, None
    _known.clear()
    if bpy.app.timers.is_registered(look):
        bpy.app.timers.unregister(look)


def _steps(where: str, asked: Sequence[str]) -> jobs.Steps:
    return [("asking the text encoder", "embed", {"encoder": where, "texts": list(asked)})]


def _keep(where: str, asked: Sequence[str], answer: jobs.Answer) -> None:
    result, arrays = answer
    card = result["encoder"]
    for phrase, vector in zip(asked, arrays["embeddings"], strict=True):
        _known[where, phrase] = Embedded(card["digest"], card["name"], np.array(vector))
