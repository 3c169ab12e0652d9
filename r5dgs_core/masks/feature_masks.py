"""Masks of the rigid bodies that move, from image features.

The bodies are found at some of the times (`feature_bodies.py`). Their points are drawn at all times, with interpolated
poses, and gaps between them are closed. Masks are unknown at times without a pose nearby. Long before its first pose
and long after its last one, a body counts as absent.
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage
from scipy.spatial import KDTree

from .. import errors
from ..data import dataset as datasets
from ..data import mask_notes, masks
from ..data.views import View
from ..motion import rotations
from ..scene import cameras
from ..scene.cameras import Camera
from ..scene.sampling import spacing, spread
from . import feature_bodies, feature_points, videos
from .feature_points import Points, features, triangulate
from .videos import Video

VERSION = 1  # of the method; masks of another version are not continued
SEED = 0
SEARCH = 0.8  # share of the search in the progress of the first video
EXTRACTION = 0.7  # share of the features in the progress of the search
MAX_TIMES, MAX_CAMERAS = 64, 8  # that are searched
DENSE = 0.2  # minimum number of neighbours of a point relative to the median; stray points have few
NEIGHBOURHOOD = 0.05  # their maximum distance, relative to the size of the body
CLOSED = 0.12  # radius of closed gaps, relative to the size of the body
BEYOND = 2.0  # searched times before its first pose and after its last one at which a body may be present
NEAR = 1.01  # largest distance from a pose, in searched times, at which a pose is interpolated
MAX_SIDE = 512  # pixels of the masks that are drawn, before they are enlarged


_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class _Track:
    """A body as it is drawn.

    Attributes:
        places: Its points about their mean. [P, 3]
        size: Its size.
        times: Times of its poses. [K]
        quats: Rotations. [K, 4]
        centers: Positions of the mean. [K, 3]
        step: Time between two searched times. A pose that is farther than this from all others is a guess.
    """

    places: np.ndarray
    size: float
    times: np.ndarray
    quats: np.ndarray
    centers: np.ndarray
    step: float

    def is_present(self, t: float) -> bool:
        """True unless a time is long before the first pose or long after the last one."""
        margin = BEYOND * self.step
        return self.times[0] - margin <= t <= self.times[-1] + margin

    def is_guessed(self, t: float) -> bool:
        """True if the body is present but no pose is near."""
        return self.is_present(t) and float(np.abs(self.times - t).min()) > NEAR * self.step

    def at(self, t: float) -> np.ndarray:
        """Return the positions of the points at a time. [P, 3]"""
        t = float(np.clip(t, self.times[0], self.times[-1]))
        k = int(np.clip(np.searchsorted(self.times, t) - 1, 0, max(len(self.times) - 2, 0)))
        share = (t - self.times[k]) / (self.times[k + 1] - self.times[k])
        quat = rotations.interpolate(self.quats[k], self.quats[k + 1], share)
        return rotations.rotate(quat[None], self.places) + (1 - share) * self.centers[k] + share * self.centers[k + 1]


class FeatureMasks:
    """Mask backend that finds the rigid bodies that move, by image features.

    Args:
        views: All training views.

    Raises:
        BackendError: OpenCV is not installed.
    """

    name, numbering = "features", mask_notes.SCENE

    def __init__(self, views: Sequence[View]):
        feature_points.require()
        self._views = tuple(views)
        self._tracks: list[_Track] | None = None
        self.made_with: dict[str, Any] = {"version": VERSION, "views": _digest(views)}
        self.own_names: Path | Mapping[int, str] | None = {}  # its ids are not those of the data set

    def label(self, video: Video, room: Path, report: Callable[[float], None]) -> Iterator[np.ndarray | None]:
        """Implement `make_masks.MaskBackend.label`.

        Raises:
            DatasetError: No body is found.
        """
        if self._tracks is None:
            self._tracks = find(self._views, lambda share: report(SEARCH * share))
        for count, view in enumerate(video.views, 1):
            yield _drawn(self._tracks, view.camera, view.t)
            report(SEARCH + (1 - SEARCH) * count / len(video.views))


def find(views: Sequence[View], report: Callable[[float], None]) -> list[_Track]:
    """Find the rigid bodies that move in the images of several cameras.

    Args:
        views: The views.
        report: Called with the searched share of the images.

    Raises:
        DatasetError: No body is found.
    """
    times, groups = _moments(views)
    total, found = sum(len(group) for group in groups), []
    for group in groups:
        found.append(triangulate([features(datasets.load_image_8bit(view), view.camera) for view in group]))
        report(EXTRACTION * sum(len(one.cameras) for one in found) / total)
    bodies = feature_bodies.find(
        found, np.random.default_rng(SEED), lambda share: report(EXTRACTION + (1 - EXTRACTION) * share)
    )
    made = [_track(body, found, times) for body in bodies]
    report(1.0)
    if not made:
        count = round(float(np.median([len(one.places) for one in found]))) if found else 0
        raise errors.DatasetError(
            f"no rigid body moves: {len(times)} times at which several cameras record have {count} points in common "
            "in the median. Remedy: the search needs two or more cameras that record together, sharp images of some "
            "hundred lines and objects with texture; for other objects use --backend sam2"
        )
    _log.info("%d rigid bodies, found at %s of %d times", len(made), [len(one.times) for one in made], len(times))
    return made


def _digest(views: Sequence[View]) -> str:
    """Return a digest of what the search depends on; ids of another set of views differ."""
    hasher = hashlib.sha256()
    for view in views:
        camera = view.camera
        hasher.update(f"{view.name} {view.t!r} {camera.width} {camera.height}".encode())
        hasher.update(camera.T_cam_world.tobytes() + camera.intrinsics.tobytes())
    return hasher.hexdigest()[:16]


def _moments(views: Sequence[View]) -> tuple[np.ndarray, list[list[View]]]:
    """Return times at which several cameras record, and the views of each. [S]

    The times are those of the camera with the most images; others belong to the nearest of them within half a step.
    """
    recorded = videos.of(views)
    every = np.unique([view.t for view in max(recorded, key=lambda video: len(video.views)).views])
    reach = 0.5 * spacing(every)
    groups: list[list[View]] = [[] for _ in every]
    for video in recorded:
        nearest: dict[int, View] = {}
        for view in video.views:
            k = int(np.argmin(np.abs(every - view.t)))
            off = abs(view.t - every[k])
            if off < reach and (k not in nearest or off < abs(nearest[k].t - every[k])):
                nearest[k] = view
        for k, view in nearest.items():
            groups[k].append(view)
    chosen = spread([k for k, group in enumerate(groups) if len(group) > 1], MAX_TIMES)
    return every[chosen], [spread(groups[k], MAX_CAMERAS) for k in chosen]


def _track(body: feature_bodies.Body, found: Sequence[Points], times: np.ndarray) -> _Track:
    places = body.places(found)
    low, high = np.percentile(places, [5, 95], axis=0)
    size = float(np.linalg.norm(high - low))
    tree = KDTree(places)
    counts = np.array([len(near) for near in tree.query_ball_point(places, NEIGHBOURHOOD * size)])
    places = places[counts >= DENSE * np.median(counts)]
    known = sorted(body.poses)
    poses, center = np.array([body.poses[k] for k in known]), places.mean(0)
    quats = rotations.make_continuous(rotations.rotmats_to_quats(poses[:, :, :3]))
    centers = poses[:, :, :3] @ center + poses[:, :, 3]
    return _Track(places - center, size, times[known], quats, centers, spacing(times))


def _drawn(tracks: Sequence[_Track], camera: Camera, t: float) -> np.ndarray:
    """Draw the masks of the bodies at a time, near ones over far ones; unknown if a pose is guessed. [H, W]"""
    import cv2

    if any(track.is_guessed(t) for track in tracks):
        return np.full((camera.height, camera.width), masks.UNKNOWN, np.uint16)
    small = cameras.reduced(camera, MAX_SIDE)
    layers = []
    for number, track in enumerate(tracks, 1):
        if not track.is_present(t):
            continue
        pixels, depths = cameras.project(small, track.at(t))
        seen = np.isfinite(pixels[:, 0])
        if seen.mean() < 0.5:
            continue
        depth = float(np.median(depths[seen]))
        radius = max(1, round(CLOSED * track.size * float(small.intrinsics[0, 0]) / depth))
        layers.append((depth, number, _closed(pixels[seen], small, min(radius, MAX_SIDE // 4))))
    mask = np.zeros((small.height, small.width), np.uint8)
    for _, number, region in sorted(layers, key=lambda layer: -layer[0]):
        mask[region] = number
    return cv2.resize(mask, (camera.width, camera.height), interpolation=cv2.INTER_NEAREST)


def _closed(pixels: np.ndarray, camera: Camera, radius: int) -> np.ndarray:
    """Draw points [P, 2], close the gaps between them up to a radius, and fill holes. [H, W] bool"""
    import cv2

    border = 2 * radius
    canvas = np.zeros((camera.height + 2 * border, camera.width + 2 * border), np.uint8)
    x, y = np.floor(pixels + border).T
    inside = (x >= 0) & (y >= 0) & (x < canvas.shape[1]) & (y < canvas.shape[0])
    canvas[y[inside].astype(int), x[inside].astype(int)] = 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    closed = cv2.erode(cv2.dilate(canvas, disc), disc)
    filled = np.zeros(closed.shape, bool)
    ndimage.binary_fill_holes(closed, output=filled)
    return filled[border:-border, border:-border]
