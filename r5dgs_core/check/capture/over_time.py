"""Faults of one camera's images over time: exposure, white balance, blur, dropped and doubled frames."""

from __future__ import annotations

import functools
import itertools

import numpy as np
from matplotlib.figure import Figure
from scipy import ndimage

from ...color import srgb
from ...data import dataset as datasets
from ...findings import Collector
from ...prepare import motion_tracks
from ...prepare.frame_store import FrameStore
from . import pictures
from .pictures import Album
from .recording import LEAST, Recording

EXPOSURE, BALANCE = 0.15, 0.08  # allowed drift of brightness and of the ratio of two colours, stops
BLURRED, BLURRED_SHARE = 0.5, 0.15  # sharpness of a blurred image, of the usual one; share of such images for a finding
DROPPED = 1.5  # interval above which a frame is missing, in usual intervals
DOUBLED, MOVES = 0.1, 0.5  # maximum change of a repeated image, minimum change of its neighbours, in usual changes
_REGULAR = 0.8  # least share of equal intervals for a camera with a constant rate
_MOVING = 20  # difference from the background, levels
_CELLS = 6  # least number of moving cells
_BAND = 1 << 21  # values of all images that are in memory at once
_SMOOTH = 5  # number of images in the running median of the exposure


def check(one: Recording, place: str, seconds: float | None, collect: Collector, album: Album) -> None:
    """Check the images of a static camera.

    Args:
        one: The camera.
        place: The data set, for messages.
        seconds: Seconds per unit of scene time, or None.
        collect: Findings.
        album: Pictures.
    """
    check_dropped(one.name, one.times, place, seconds, collect, album)
    if len(one.views) < LEAST:
        return
    behind = motion_tracks.background(one.stack)
    _check_doubled(one, place, collect, album)
    _check_exposure(one, behind, place, collect, album)
    _check_blur(one, behind, place, collect, album)


def check_dropped(
    name: str, times: np.ndarray, place: str, seconds: float | None, collect: Collector, album: Album
) -> None:
    """Check that the times of a camera with a constant rate have no gap."""
    if len(times) < LEAST:
        return
    steps = np.diff(times)
    usual = float(np.median(steps))
    gaps = np.flatnonzero(steps > DROPPED * usual)
    if usual <= 0 or not len(gaps) or (np.abs(steps - usual) < 0.1 * usual).mean() < _REGULAR:
        return
    scale, unit = (1.0, "scene time") if seconds is None else (1e3 * seconds, "ms")
    lost = int(np.rint(steps[gaps] / usual - 1).sum())
    picture = album.write(
        f"D66_{name}",
        lambda: pictures.curves(
            times[1:], [(name, steps * scale)], "scene time", f"interval, {unit}", "Dropped frames"
        ),
    )
    collect.add(
        "D66",
        f"{place}: {name} lacks about {lost} of {len(times) + lost} frames, the first after time {times[gaps[0]]:.4g}",
        picture=picture,
    )


def _check_doubled(one: Recording, place: str, collect: Collector, album: Album) -> None:
    change = np.array([np.abs(a.astype(np.int16) - b).mean() for a, b in itertools.pairwise(one.stack)])
    usual = float(np.median(change))
    if usual <= 0.02:
        return
    still = change < DOUBLED * usual
    moves = change > MOVES * usual
    alone = np.concatenate([[False], still[1:-1] & moves[:-2] & moves[2:], [False]])
    places = np.flatnonzero(alone)
    if len(places) < 1:
        return
    k = int(places[0])
    panels = [(one.stack[k + n], one.views[k + n].image_path.name) for n in range(3)]
    picture = album.write(f"D71_{one.name}", lambda: pictures.side_by_side(panels))
    collect.add(
        "D71",
        f"{place}: {one.name} repeats {len(places)} of {len(one.views)} images, the first is "
        f"{one.views[k + 1].image_path.name}",
        picture=picture,
    )


def _apart(colors: np.ndarray, behind: np.ndarray) -> np.ndarray:
    """Return the differences of colours [..., 3] from the background, levels. [...] int16"""
    return np.abs(colors.astype(np.int16) - behind).max(-1)


def _usual_difference(stack: FrameStore, behind: np.ndarray) -> np.ndarray:
    """Return the median over time of the differences from the background, computed in bands to save memory. [h, w]"""
    rows = max(1, _BAND // (len(stack) * behind[0].size))
    tops = range(0, len(behind), rows)
    bands = [(top, min(top + rows, len(behind))) for top in tops]
    return np.concatenate([np.median(_apart(stack.rows(a, b), behind[a:b]), axis=0) for a, b in bands])


def _check_exposure(one: Recording, behind: np.ndarray, place: str, collect: Collector, album: Album) -> None:
    """Compare static parts of the images that are neither black nor white with their median over time."""
    usable = ((behind > 24) & (behind < 230)).all(-1)
    quiet = _usual_difference(one.stack, behind)
    usable &= quiet <= np.quantile(quiet[usable], 0.7) if usable.any() else usable
    if usable.sum() < 50:
        return
    base = srgb.to_linear(behind[usable] / 255.0)
    stops = np.stack(
        [np.median(np.log2(np.maximum(srgb.to_linear(p[usable] / 255.0), 1e-4) / base), axis=0) for p in one.stack]
    )  # [F, 3]
    stops = ndimage.median_filter(stops, (min(_SMOOTH, len(stops)), 1), mode="nearest")
    bright = stops.mean(1)
    balance = stops[:, [0, 2]] - stops[:, [1]]
    rows = [(color, stops[:, k]) for k, color in enumerate(("red", "green", "blue"))]
    for code, drift, limit, what in (
        ("D62", float(np.ptp(bright)), EXPOSURE, "exposure"),
        ("D63", float(np.ptp(balance, axis=0).max()), BALANCE, "white balance"),
    ):
        if drift > limit:
            title = f"{one.name}: drifting {what}"
            draw = functools.partial(pictures.curves, one.times, rows, "scene time", "stops", title)
            collect.add(
                code,
                f"{place}: the {what} of {one.name} drifts by {drift:.2f} stops, expected at most {limit:g}",
                picture=album.write(f"{code}_{one.name}", draw),
            )


def _check_blur(one: Recording, behind: np.ndarray, place: str, collect: Collector, album: Album) -> None:
    """Compare the sharpness of moving parts between images; the sharpest images show that they have edges."""
    counts, found = np.zeros(len(one.stack), int), []
    for k, picture in enumerate(one.stack):
        moving = _apart(picture, behind) > _MOVING
        counts[k] = moving.sum()
        if counts[k] >= _CELLS:
            found.append(float(np.quantile(one.edges[k][moving].astype(np.float32), 0.9)))
    seen, sharp = np.flatnonzero(counts >= _CELLS), np.array(found)
    if len(seen) < LEAST:
        return
    usual = float(np.quantile(sharp, 0.9))
    blurred = sharp < BLURRED * usual
    large = counts[seen] >= 0.5 * np.median(counts[seen])  # something that leaves the view is not blurred
    if (blurred & large).mean() < BLURRED_SHARE:
        return
    worst, best = seen[int(np.argmin(np.where(large, sharp, np.inf)))], seen[int(np.argmax(sharp))]
    crops = [(worst, "blurred"), (best, "sharp")]

    def draw() -> Figure:
        panels = [(_moving_crop(one, behind, k), f"{title}: {one.views[k].image_path.name}") for k, title in crops]
        return pictures.side_by_side(panels)

    collect.add(
        "D64",
        f"{place}: what moves in {one.name} is blurred in {int((blurred & large).sum())} of {len(seen)} images, for "
        f"example {one.views[worst].image_path.name}",
        picture=album.write(f"D64_{one.name}", draw),
    )


def _moving_crop(one: Recording, behind: np.ndarray, index: int) -> np.ndarray:
    """Return the part of a full image that moves. [h, w, 3]"""
    y, x = np.nonzero(_apart(one.stack[index], behind) > _MOVING)
    top, bottom = int(np.quantile(y, 0.02)) * one.step, (int(np.quantile(y, 0.98)) + 1) * one.step
    left, right = int(np.quantile(x, 0.02)) * one.step, (int(np.quantile(x, 0.98)) + 1) * one.step
    return datasets.load_image(one.views[index])[top:bottom, left:right]
