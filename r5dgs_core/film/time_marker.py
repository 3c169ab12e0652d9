"""Time marker on pictures: a bar of the observed and the predicted time, and the word "observed" or "predicted"."""

from __future__ import annotations

import functools

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

PAST, FUTURE = (0.298, 0.561, 0.910), (0.941, 0.596, 0.235)  # as in the player
DIMMED = 0.4  # brightness of the part of the bar that has not been played
CURSOR = (1.0, 1.0, 1.0)
PLATE = 0.086  # gray behind the word


def draw(picture: np.ndarray, t: float, t_max: float, span: tuple[float, float]) -> np.ndarray:
    """Return a picture with the marker in its lower part.

    Args:
        picture: sRGB, with or without straight alpha. [H, W, 3 or 4]
        t: Scene time of the picture.
        t_max: Last observed time.
        span: Times at the left and right end of the bar; equal for a scene of one time.
    """
    marked = picture.copy()
    height, width = picture.shape[:2]
    thick = max(height // 60, 3)
    times = np.linspace(*span, width)
    bar = np.where((times > t_max)[:, None], FUTURE, PAST) * np.where(times > t, DIMMED, 1.0)[:, None]
    length = span[1] - span[0]
    at = int(round((t - span[0]) / length * (width - 1))) if length > 0 else width - 1
    bar[max(at - thick // 3, 0) : at + thick // 3 + 1] = CURSOR
    marked[-thick:, :, :3] = bar
    later = t > t_max + 1e-9
    word = _word("predicted" if later else "observed", max(height // 24, 9))
    region = marked[max(height - thick - len(word), 0) : height - thick, : word.shape[1]]
    ink = word[: region.shape[0], : region.shape[1], None]
    region[..., :3] = PLATE * (1 - ink) + ink * np.array(FUTURE if later else PAST)
    if picture.shape[2] == 4:
        marked[-thick:, :, 3] = region[..., 3] = 1
    return marked.astype(np.float32)


@functools.cache
def _word(text: str, height: int) -> np.ndarray:
    """Return the ink of a word in letters of a height in pixels, with a margin. [h, w] in [0, 1]"""
    figure = Figure(figsize=(height * len(text) / 100, 2 * height / 100), dpi=100)
    canvas = FigureCanvasAgg(figure)
    figure.text(0, 0.5, text, fontsize=0.72 * height, fontweight="bold", va="center_baseline")
    canvas.draw()
    ink = 1 - np.asarray(canvas.buffer_rgba())[..., 0].astype(np.float32) / 255
    rows, columns = (np.flatnonzero(ink.any(axis)) for axis in (1, 0))
    return np.pad(ink[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1], max(height // 3, 2))
