"""Paths of what moves in the frames of a static camera: of its objects, or of the largest moving region."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import ndimage

from ..capture.calibration.lens import Lens
from ..data import masks as id_images
from .camera_source import CameraSource
from .frame_store import FrameStore

WIDTH = 240  # of the reduced frames, pixels
MOST_FRAMES = 600  # per camera, consecutive
BACKGROUND_FRAMES = 41
LEAST_PATH = 2.0  # least extent of the path of an object, px
LEAST_PIXELS = 20  # of an object's mask
_NOISE = 12  # least difference of a moving pixel from the background, of 255
_AREA = 0.0008  # least size of a moving region, as a share of the frame
_SHARE = 0.5  # largest size of a moving region, as a share of the frame


@dataclass(frozen=True)
class MotionTrack:
    """Path of a moving region.

    Attributes:
        times: Times at which it is seen, on the camera's clock, seconds. [F]
        points: Its centre in the plane at depth 1, camera axes. [F, 2]
        pixel: Size of a pixel of the full image in that plane.
        rows: Height of the centre in the image, from -0.5 at the upper edge to 0.5. [F]
    """

    times: np.ndarray
    points: np.ndarray
    pixel: float
    rows: np.ndarray


def track(source: CameraSource, lens: Lens, report: Callable[[int], None]) -> MotionTrack:
    """Follow the largest moving region of a camera.

    Args:
        source: The camera, static.
        lens: Its lens for the size of the frames.
        report: Called with the number of each decoded frame.
    """
    first = max(0, (len(source.times) - MOST_FRAMES) // 2)
    wanted = range(first, min(first + MOST_FRAMES, len(source.times)))
    step = step_of(source.width)
    found: list[int] = []
    stack = FrameStore()
    for count, (index, pixels) in enumerate(source.read(list(wanted)), 1):
        found.append(index)
        stack.append(reduce(pixels, step))
        report(count)
    if len(found) < 4:
        return MotionTrack(np.zeros(0), np.zeros((0, 2)), 1.0 / lens.fx, np.zeros(0))
    places = centers(stack)
    seen = np.isfinite(places[:, 0])
    pixels = (places[seen] + 0.5) * step
    rays = lens.unproject(pixels) if len(pixels) else np.zeros((0, 3))
    rows = pixels[:, 1] / source.height - 0.5
    good = np.isfinite(rays).all(1) & (rays[:, 2] > 1e-3)
    return MotionTrack(source.times[found][seen][good], rays[good, :2] / rays[good, 2:], 1.0 / lens.fx, rows[good])


def of_masks(
    source: CameraSource, lens: Lens, masks: Mapping[int, Path], read: Callable[[Path], np.ndarray]
) -> dict[int, MotionTrack]:
    """Follow each object of a camera by its masks, while all of it is visible.

    Args:
        source: The camera, static.
        lens: Its lens for the size of the frames.
        masks: File of each frame's mask.
        read: Returns the ids of a file. [H, W]
    """
    indices = sorted(masks)
    first = max(0, (len(indices) - MOST_FRAMES) // 2)
    seen: dict[int, list[tuple[float, float, float]]] = {}
    for index in indices[first : first + MOST_FRAMES]:
        ids = read(masks[index])
        scale = source.width / ids.shape[1]
        for key, (x, y) in _whole(ids).items():
            seen.setdefault(key, []).append((float(source.times[index]), x * scale, y * scale))
    tracks = {}
    for key, rows in seen.items():
        times, pixels = np.array(rows)[:, 0], np.array(rows)[:, 1:]
        if np.ptp(pixels, axis=0).max() >= LEAST_PATH:
            rays = lens.unproject(pixels)
            good = np.isfinite(rays).all(1) & (rays[:, 2] > 1e-3)
            points, places = rays[good, :2] / rays[good, 2:], pixels[good, 1] / source.height - 0.5
            tracks[key] = MotionTrack(times[good], points, 1.0 / lens.fx, places)
    return tracks


def _whole(ids: np.ndarray) -> dict[int, tuple[float, float]]:
    """Return the centre (x, y) of each object that neither leaves the image nor touches another one, px."""
    padded = np.pad(ids, 1, constant_values=id_images.UNKNOWN)
    centers = {}
    for key, place in enumerate(ndimage.find_objects(np.where(ids == id_images.UNKNOWN, 0, ids)), 1):
        if place is None:
            continue
        top, left = place[0].start, place[1].start
        around = padded[top : place[0].stop + 2, left : place[1].stop + 2]
        region = around == key
        border = np.asarray(ndimage.binary_dilation(region), bool) & ~region
        if region.sum() >= LEAST_PIXELS and not around[border].any():
            y, x = np.nonzero(region)
            centers[key] = left + float(x.mean()) - 0.5, top + float(y.mean()) - 0.5
    return centers


def step_of(width: int) -> int:
    """Return the number of pixels of a frame per reduced pixel."""
    return max(1, width // WIDTH)


def reduce(pixels: np.ndarray, step: int) -> np.ndarray:
    """Return the mean colour of squares of pixels. [H, W, 3] uint8 -> [H // step, W // step, 3] uint8"""
    if step == 1:
        return pixels
    height, width = pixels.shape[0] // step, pixels.shape[1] // step
    rows = np.add.reduceat(pixels[: height * step], np.arange(0, height * step, step), axis=0, dtype=np.uint32)
    cells = np.add.reduceat(rows[:, : width * step], np.arange(0, width * step, step), axis=1)
    return (cells // step**2).astype(np.uint8)


def background(stack: Sequence[np.ndarray]) -> np.ndarray:
    """Return the median of frames [h, w, 3] spread over time. [h, w, 3] int16"""
    chosen = np.unique(np.linspace(0, len(stack) - 1, BACKGROUND_FRAMES).astype(int))
    return np.median([stack[k] for k in chosen.tolist()], axis=0).astype(np.int16)


def centers(stack: Sequence[np.ndarray]) -> np.ndarray:
    """Centre (x, y) of the largest region that differs from the background, NaN if there is none. [F, 2]

    Args:
        stack: F frames. [h, w, 3] uint8 each
    """
    behind = background(stack)
    area = behind[..., 0].size
    found = np.full((len(stack), 2), np.nan)
    for k, frame in enumerate(stack):
        apart = frame.astype(np.int16) - behind
        apart -= np.median(apart, axis=(0, 1)).astype(np.int16)  # a change of exposure is no motion
        apart = np.abs(apart).max(-1)
        moving = np.asarray(ndimage.binary_opening(apart > _NOISE), bool)
        labels = np.zeros(moving.shape, np.int32)
        ndimage.label(ndimage.binary_dilation(moving, iterations=2), output=labels)
        sizes = np.bincount(labels[moving], minlength=2)
        largest = int(np.argmax(sizes[1:])) + 1
        if not _AREA * area <= sizes[largest] <= _SHARE * area:
            continue
        y, x = np.argwhere(moving & (labels == largest)).T
        edge = x.min() == 0 or y.min() == 0 or x.max() == frame.shape[1] - 1 or y.max() == frame.shape[0] - 1
        if not edge:
            weights = np.minimum(apart[y, x], 3 * _NOISE)  # pixels at the border count by their share
            found[k] = np.average(x, weights=weights), np.average(y, weights=weights)
    return found
