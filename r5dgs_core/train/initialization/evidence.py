"""Evidence of the images on each body at each time: visibility, observability of rotation, and absence.

Rotation of a body of uniform colour and motion of a hidden body cannot be observed; their tracks should be smooth
instead of following noise. A body without a mask at some time is either hidden, not labelled, or absent. If it is
absent, it must not be rendered, as training would make it transparent.

Notation: M objects, S observed times.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from ...data import masks
from ...scene import cameras
from ...scene.sampling import spread
from ..train_views import IMAGE, MASK, MAX_SAMPLE, TrainView, by_camera, in_turn, nearest_knot
from .triangulation import ObjectPositions

TEXTURE = 0.1  # change of colour per radian (root mean square) that makes rotation observable
STIFFEST = 100.0  # factor on the smoothness of a track if nothing is visible
CLEARER = 0.03  # maximum mean colour difference due to noise
DISC = 0.6  # radius of the compared disc / radius of the body
HIDDEN = 0.1  # share of the disc covered by other objects above which a view is ignored
MIN_FRAMES, MAX_FRAMES = 2, 15  # frames of a camera for the colours without the object
ENOUGH = 5  # images of a body at one time that show its texture, in captures of more than `MAX_SAMPLE` images


@dataclass(frozen=True)
class BodyEvidence:
    """Evidence on each body at each time.

    Attributes:
        shift_stiffness: Factor on the smoothness of displacements, at least 1. [M, S]
        turn_stiffness: Factor on the smoothness of rotations about each axis, world. [M, S, 3, 3]
        absent: Times at which the body is absent. [M, S] bool
    """

    shift_stiffness: np.ndarray
    turn_stiffness: np.ndarray
    absent: np.ndarray


def gather(views: Sequence[TrainView], places: ObjectPositions, times: np.ndarray) -> BodyEvidence:
    """Gather the evidence from all views.

    Args:
        views: Training views.
        places: Positions of the objects.
        times: The observed times. [S]
    """
    stiff = shift_stiffness(places.evidence)
    return BodyEvidence(stiff, turn_stiffness(views, places, times), absent(views, places, times))


def shift_stiffness(evidence: np.ndarray) -> np.ndarray:
    """Return the smoothness of displacements: 1 at usual visibility, more if less of a body is visible. [M, S]"""
    return 1 / np.maximum(evidence, 1 / STIFFEST)


def turn_stiffness(views: Sequence[TrainView], places: ObjectPositions, times: np.ndarray) -> np.ndarray:
    """Return the smoothness of rotations about each axis, in world axes: the identity if texture determines rotation.

    The change of the image with rotation is estimated for a ball in the body's place, with the texture inside its mask.
    Smooth shading (a quadratic over the mask) is removed first, as it does not turn with the body. Of captures with
    more than `MAX_SAMPLE` images, each time reads only as many images as show each visible body `ENOUGH` times.

    Args:
        views: Training views.
        places: Positions of the objects.
        times: The observed times. [S]

    Returns:
        Symmetric matrices with eigenvalues of at least 1. [M, S, 3, 3]
    """
    m, count = places.measured.shape
    change = np.zeros((m, count, 3, 3))
    pixels = np.zeros((m, count))
    masked = [view for view in views if view.has_mask]
    long = len(masked) > MAX_SAMPLE
    for s, group in _by_knot(masked, times).items():
        shown = np.zeros(m, int)
        for view in in_turn(_apart(group) if long else group, IMAGE, MASK):
            for row, turned, size in _textures(view, places.object_ids):
                change[row, s] += turned
                pixels[row, s] += size
                shown[row] += 1
            if long and (shown >= ENOUGH)[places.evidence[:, s] > 0].all():
                break
    eye = np.eye(3)
    seen = change / np.maximum(pixels, 1)[..., None, None]
    loose = np.linalg.inv(eye + seen / TEXTURE**2)
    stiff = eye + STIFFEST * loose @ loose
    return stiff * shift_stiffness(places.evidence)[..., None, None]


def _by_knot(views: Sequence[TrainView], times: np.ndarray) -> dict[int, list[TrainView]]:
    """Group views by their nearest knot, in their order."""
    groups: dict[int, list[TrainView]] = {}
    for view in views:
        groups.setdefault(nearest_knot(times, view.t), []).append(view)
    return groups


def _apart(views: Sequence[TrainView]) -> list[TrainView]:
    """Return the views in an order in which successive ones are far apart: multiples of the golden ratio, modulo 1."""
    return [views[k] for k in np.argsort(np.arange(len(views)) * (math.sqrt(5) - 1) / 2 % 1)]


def _textures(view: TrainView, object_ids: np.ndarray) -> Iterator[tuple[int, np.ndarray, int]]:
    """Yield the row, the squared colour change per radian, world axes [3, 3], and the pixels of each body shown."""
    image, mask = view.image, view.mask
    assert mask is not None
    boxes = ndimage.find_objects(np.where(mask == masks.UNKNOWN, 0, mask).astype(np.int32))
    axes = view.camera.T_cam_world[:3, :3]
    for row, object_id in enumerate(object_ids):
        box = boxes[object_id - 1] if object_id <= len(boxes) else None
        found = None if box is None else _change_per_turn(image[box], mask[box] == object_id)
        if found is not None:
            yield row, axes.T @ found[0] @ axes, found[1]


def _change_per_turn(part: np.ndarray, here: np.ndarray) -> tuple[np.ndarray, int] | None:
    """Return the squared colour change per radian, summed over a mask, camera axes [3, 3], and the number of pixels."""
    inside = np.asarray(ndimage.binary_erosion(here, iterations=2), bool)
    if inside.sum() < 12:
        return None
    rows, cols = np.nonzero(here)
    height, width = here.shape
    b, a = np.meshgrid(np.arange(height) - rows.mean(), np.arange(width) - cols.mean(), indexing="ij")
    radius2 = max((a[here] ** 2 + b[here] ** 2).max(), 1.0)
    image = part.astype(np.float64) / 255
    near = np.asarray(ndimage.binary_dilation(inside), bool)  # the gradient of a pixel needs its neighbours
    shape = np.stack([np.ones_like(a), a, b, a * a, a * b, b * b], -1)
    smooth = shape @ np.linalg.lstsq(shape[near], image[near], rcond=None)[0]
    texture = np.where(near[..., None], image - smooth, 0.0)
    gy, gx = (g[inside] for g in np.gradient(texture, axis=(0, 1)))  # [n, 3] each
    a, b = a[inside][:, None], b[inside][:, None]
    depth = np.sqrt(np.maximum(radius2 - a * a - b * b, 0.0))  # depth of the ball's front surface, towards the camera
    # The point (a, b, -depth) moves by w x point: (-depth w_y - b w_z, depth w_x + a w_z) in the image.
    slopes = np.stack([gy * depth, -gx * depth, gy * a - gx * b], -1).reshape(-1, 3)
    return slopes.T @ slopes / 3, int(inside.sum())


def absent(views: Sequence[TrainView], places: ObjectPositions, times: np.ndarray) -> np.ndarray:
    """Find the times at which an object is absent although cameras see its place and nothing hides it.

    At such a time no mask shows the object. In most views, the pixels at its expected place have the colours that the
    camera sees there without the object (known from times at which its mask is elsewhere), and not the object's colour.

    Args:
        views: Training views.
        places: Positions of the objects, interpolated at times at which they are not visible.
        times: The observed times. [S]

    Returns:
        True if absent. Times without evidence take the value of the nearest time with evidence in the same gap between
        masks. [M, S] bool
    """
    if (places.evidence > 0).all():  # no image has to be read
        return np.zeros(places.measured.shape, bool)
    votes = np.zeros(places.measured.shape)
    asked = np.zeros(places.measured.shape)
    colors = _usual_colors(views, places)
    for group in by_camera([view for view in views if view.has_mask]):
        frames = [(nearest_knot(times, view.t), view) for view in group]
        for s, view in frames:
            for row in np.flatnonzero(places.evidence[:, s] == 0):
                columns, rows = _disc(view, places.centers[row, s], float(places.radii[row]))
                if len(rows) == 0 or (_ids(view, rows, columns) > 0).mean() > HIDDEN:
                    continue
                marked = spread([v for k, v in frames if places.evidence[row, k] > 0], MAX_FRAMES)
                if len(marked) < MIN_FRAMES:
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
    """Return the median colour of pixels over frames without an object there [n, 3], and a mask of known colours."""
    colors = np.stack([v.image[rows, columns] for v in frames]) / 255
    free = np.stack([_ids(v, rows, columns) == 0 for v in frames])
    known = np.asarray(free.any(0))
    colors[~free] = np.nan
    colors[:, ~known] = 0.0
    return np.nanmedian(colors, axis=0), known


def _ids(view: TrainView, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    mask = view.mask
    assert mask is not None
    return mask[rows, columns]


def _usual_colors(views: Sequence[TrainView], places: ObjectPositions) -> np.ndarray:
    """Return the mean colour of each object over all masks, or over `MAX_SAMPLE` of them. [M, 3]"""
    total, count = np.zeros((len(places.object_ids), 3)), np.zeros(len(places.object_ids))
    for view in in_turn(spread([view for view in views if view.has_mask], MAX_SAMPLE), IMAGE, MASK):
        image, mask = view.image, view.mask
        for row, object_id in enumerate(places.object_ids):
            here = mask == object_id
            total[row] += image[here].sum(0) / 255
            count[row] += here.sum()
    return total / np.maximum(count, 1)[:, None]


def _disc(view: TrainView, center: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Return columns and rows of the pixels in the centre of a projected ball; empty if the frame's border cuts it."""
    pixels, depth = cameras.project(view.camera, center[None])
    if not depth[0] > radius:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    reach = max(DISC * radius * view.camera.intrinsics[0, 0] / depth[0], 0.7)
    height, width = view.camera.height, view.camera.width
    y, x = np.mgrid[:height, :width] + 0.5
    rows, columns = np.nonzero((x - pixels[0, 0]) ** 2 + (y - pixels[0, 1]) ** 2 <= reach**2)
    u, v = pixels[0]
    whole = reach <= u <= width - reach and reach <= v <= height - reach
    return (columns, rows) if whole else (columns[:0], rows[:0])
