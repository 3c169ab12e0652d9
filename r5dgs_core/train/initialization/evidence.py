"""What the images can tell of a body's motion at each time: how much is seen of it, how it is turned, if it is there.

A body of one colour looks the same however it is turned, and one that nobody sees may be anywhere: there the tracks
should go on smoothly instead of following noise. And where masks do not show a body, it is either hidden, not yet
marked, or not there at all; in the last case it must not be drawn, or training would make it transparent.

Notation: M objects, S observed times.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from ...data import masks
from ...scene import cameras
from ..train_views import TrainView, nearest_knot, spread
from .plane_sweep import camera_key
from .triangulation import Places

TEXTURE = 0.1  # change of colour per radian (root mean square) that tells a rotation
STIFFEST = 100.0  # how much smoother a track must be where nothing is seen
CLEARER = 0.03  # mean difference of colour that noise may make
DISC = 0.6  # share of a body's radius that is looked at
HIDDEN = 0.1  # share of it behind other objects with which a view says nothing
FEWEST_FRAMES, MOST_FRAMES = 2, 15  # of a camera, for what it sees without the object


@dataclass(frozen=True)
class Evidence:
    """What is known of each body at each time.

    Attributes:
        shift_stiffness: How smooth its displacements must be, at least 1. [M, S]
        turn_stiffness: How smooth its rotations must be about each axis, world. [M, S, 3, 3]
        absent: Times at which it is not there. [M, S] bool
    """

    shift_stiffness: np.ndarray
    turn_stiffness: np.ndarray
    absent: np.ndarray


def gather(views: Sequence[TrainView], places: Places, times: np.ndarray) -> Evidence:
    """Look at all views.

    Args:
        views: Training views.
        places: Where the objects are.
        times: The observed times. [S]
    """
    stiff = shift_stiffness(places.evidence)
    return Evidence(stiff, turn_stiffness(views, places, times), absent(views, places, times))


def shift_stiffness(evidence: np.ndarray) -> np.ndarray:
    """How smooth displacements must be: 1 where a body is seen as usual, more where less of it is. [M, S]"""
    return 1 / np.maximum(evidence, 1 / STIFFEST)


def turn_stiffness(views: Sequence[TrainView], places: Places, times: np.ndarray) -> np.ndarray:
    """How smooth rotations must be about each axis: matrices in world axes, the identity where texture tells the turn.

    The change of the image as the body turns is estimated with a ball in its place, from the texture inside its mask.
    What smooth shading (a quadratic over the mask) explains is not counted: it stays as the body turns.

    Args:
        views: Training views.
        places: Where the objects are.
        times: The observed times. [S]

    Returns:
        Symmetric matrices, eigenvalues of at least 1. [M, S, 3, 3]
    """
    m, count = places.measured.shape
    change = np.zeros((m, count, 3, 3))
    pixels = np.zeros((m, count))
    for view in views:
        if view.mask is None:
            continue
        s = nearest_knot(times, view.t)
        known = np.where(view.mask == masks.UNKNOWN, 0, view.mask).astype(np.int32)
        boxes = ndimage.find_objects(known)
        for row, object_id in enumerate(places.object_ids):
            box = boxes[object_id - 1] if object_id <= len(boxes) else None
            found = None if box is None else _change_per_turn(view.image[box], view.mask[box] == object_id)
            if found is not None:
                axes = view.camera.T_cam_world[:3, :3]
                change[row, s] += axes.T @ found[0] @ axes
                pixels[row, s] += found[1]
    eye = np.eye(3)
    seen = change / np.maximum(pixels, 1)[..., None, None]
    loose = np.linalg.inv(eye + seen / TEXTURE**2)
    stiff = eye + STIFFEST * loose @ loose
    return stiff * shift_stiffness(places.evidence)[..., None, None]


def _change_per_turn(part: np.ndarray, here: np.ndarray) -> tuple[np.ndarray, int] | None:
    """Squared change of colour per radian, summed over the pixels inside a mask, camera axes [3, 3]; their number."""
    inside = np.asarray(ndimage.binary_erosion(here, iterations=2), bool)
    if inside.sum() < 12:
        return None
    rows, cols = np.nonzero(here)
    height, width = here.shape
    b, a = np.meshgrid(np.arange(height) - rows.mean(), np.arange(width) - cols.mean(), indexing="ij")
    radius2 = max((a[here] ** 2 + b[here] ** 2).max(), 1.0)
    image = part.astype(np.float64) / 255
    near = np.asarray(ndimage.binary_dilation(inside), bool)  # the gradient of a pixel looks at its neighbours
    shape = np.stack([np.ones_like(a), a, b, a * a, a * b, b * b], -1)
    smooth = shape @ np.linalg.lstsq(shape[near], image[near], rcond=None)[0]
    texture = np.where(near[..., None], image - smooth, 0.0)
    gy, gx = (g[inside] for g in np.gradient(texture, axis=(0, 1)))  # [n, 3] each
    a, b = a[inside][:, None], b[inside][:, None]
    depth = np.sqrt(np.maximum(radius2 - a * a - b * b, 0.0))  # of the ball's front, towards the camera
    # The point (a, b, -depth) moves by w x point: (-depth w_y - b w_z, depth w_x + a w_z) in the image.
    slopes = np.stack([gy * depth, -gx * depth, gy * a - gx * b], -1).reshape(-1, 3)
    return slopes.T @ slopes / 3, int(inside.sum())


def absent(views: Sequence[TrainView], places: Places, times: np.ndarray) -> np.ndarray:
    """Times at which an object is not there, though cameras look at its place and nothing hides it.

    No mask shows it then, and where it should be most views show what the camera sees there without the object (known
    from the times at which the object is marked elsewhere), and not the object's colour.

    Args:
        views: Training views.
        places: Where the objects are, or would be.
        times: The observed times. [S]

    Returns:
        True where it is absent; times that no view tells of are as the nearest unmarked one that is told. [M, S] bool
    """
    votes = np.zeros(places.measured.shape)
    asked = np.zeros(places.measured.shape)
    colors = _usual_colors(views, places)
    of_camera: dict[bytes, list[tuple[int, TrainView]]] = {}
    for view in views:
        if view.mask is not None:
            of_camera.setdefault(camera_key(view.camera), []).append((nearest_knot(times, view.t), view))
    for frames in of_camera.values():
        for s, view in frames:
            for row in np.flatnonzero(places.evidence[:, s] == 0):
                columns, rows = _disc(view, places.centers[row, s], float(places.radii[row]))
                if len(rows) == 0 or (_ids(view, rows, columns) > 0).mean() > HIDDEN:
                    continue
                marked = spread([v for k, v in frames if places.evidence[row, k] > 0], MOST_FRAMES)
                if len(marked) < FEWEST_FRAMES:
                    continue
                empty, known = _without(marked, rows, columns)
                if known.mean() < 0.5:
                    continue
                seen = view.image[rows, columns][known] / 255
                asked[row, s] += 1
                to_empty, to_object = (np.abs(seen - x).mean() for x in (empty[known], colors[row]))
                votes[row, s] += to_empty + CLEARER < 0.5 * to_object
    gone = (asked > 0) & (votes > 0.5 * asked)
    for row, unseen in enumerate(places.evidence == 0):
        first = np.flatnonzero(np.diff(unseen, prepend=False) & unseen)
        for start in first:
            run = start + np.flatnonzero(np.logical_and.accumulate(unseen[start:]))
            told = run[asked[row, run] > 0]
            if len(told):
                gone[row, run] = gone[row, told[np.abs(run[:, None] - told).argmin(1)]]
    return gone


def _without(frames: Sequence[TrainView], rows: np.ndarray, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Median colour of pixels over the frames in which no object covers them [n, 3], and which ever are free [n]."""
    colors = np.stack([v.image[rows, columns] for v in frames]) / 255
    free = np.stack([_ids(v, rows, columns) == 0 for v in frames])
    known = np.asarray(free.any(0))
    colors[~free] = np.nan
    colors[:, ~known] = 0.0
    return np.nanmedian(colors, axis=0), known


def _ids(view: TrainView, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    assert view.mask is not None
    return view.mask[rows, columns]


def _usual_colors(views: Sequence[TrainView], places: Places) -> np.ndarray:
    """Mean colour of each object over all masks. [M, 3]"""
    total, count = np.zeros((len(places.object_ids), 3)), np.zeros(len(places.object_ids))
    for view in views:
        if view.mask is not None:
            for row, object_id in enumerate(places.object_ids):
                here = view.mask == object_id
                total[row] += view.image[here].sum(0) / 255
                count[row] += here.sum()
    return total / np.maximum(count, 1)[:, None]


def _disc(view: TrainView, center: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Columns and rows of the pixels that the middle of a ball covers; none where it is cut off by the frame."""
    pixels, depth = cameras.project(view.camera, center[None])
    if not depth[0] > radius:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    reach = max(DISC * radius * view.camera.intrinsics[0, 0] / depth[0], 0.7)
    y, x = np.mgrid[: view.image.shape[0], : view.image.shape[1]] + 0.5
    rows, columns = np.nonzero((x - pixels[0, 0]) ** 2 + (y - pixels[0, 1]) ** 2 <= reach**2)
    u, v = pixels[0]
    whole = reach <= u <= view.image.shape[1] - reach and reach <= v <= view.image.shape[0] - reach
    return (columns, rows) if whole else (columns[:0], rows[:0])
