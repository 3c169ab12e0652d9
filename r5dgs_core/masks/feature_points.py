"""Image features of one time, matched between the cameras and triangulated.

Notation: F features of an image, V cameras of a time, P points, D descriptors of the points.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph

from .. import extras
from ..scene import cameras
from ..scene.cameras import Camera

MAX_SIDE = 1000  # pixels; larger images are reduced
FEATURES = 2000  # per image
CONTRAST = 0.015  # threshold of SIFT; the default of 0.04 misses weak texture
RATIO = 0.8  # maximum distance of the best match relative to that of the second best
EPIPOLAR = 1.5  # maximum distance of a match from its epipolar line, and of a point from its pixels, pixels
PARALLAX = 0.03  # minimum angle between two rays of a point, rad
BLOCK = 512  # descriptors that are compared with all others at once, which bounds the memory


@dataclass(frozen=True)
class Features:
    """Features of an image.

    Attributes:
        camera: Its camera, at the resolution of the pixels.
        pixels: Places. [F, 2]
        descriptors: Square roots of SIFT descriptors of sum 1 (RootSIFT), whose scalar product is 1 if they are equal.
            [F, 128] float32
    """

    camera: Camera
    pixels: np.ndarray
    descriptors: np.ndarray


@dataclass(frozen=True)
class Points:
    """Points that several cameras show at one time.

    Attributes:
        cameras: The cameras. [V]
        places: Positions in the world. [P, 3]
        pixels: Pixels in each camera, NaN in cameras without a match. [P, V, 2]
        owners: Point of each descriptor. [D]
        descriptors: Descriptors of all cameras. [D, 128] float32
    """

    cameras: Sequence[Camera]
    places: np.ndarray
    pixels: np.ndarray
    owners: np.ndarray
    descriptors: np.ndarray

    def reprojection_errors(self, places: np.ndarray, rows: np.ndarray | slice = slice(None)) -> np.ndarray:
        """Return the largest distance between projections of points and their pixels, over the cameras.

        Args:
            places: Positions of the points in the world. [..., C, 3]
            rows: The points whose pixels are compared. [C]

        Returns:
            Distances in pixels, infinite behind a camera. [..., C]
        """
        worst = np.zeros(places.shape[:-1])
        for v, camera in enumerate(self.cameras):
            seen = self.pixels[rows, v]
            off = np.linalg.norm(cameras.project(camera, places)[0] - seen, axis=-1)
            off = np.where(np.isfinite(off), off, np.inf)
            worst = np.where(np.isfinite(seen[:, 0]), np.maximum(worst, off), worst)
        return worst


def require() -> None:
    """Raise BackendError if OpenCV is not installed."""
    with extras.required("--backend features", "prepare"):
        import cv2  # noqa: F401


def features(image: np.ndarray, camera: Camera) -> Features:
    """Find the features of an image [H, W, 3] uint8."""
    import cv2

    camera = cameras.reduced(camera, MAX_SIDE)
    if image.shape[:2] != (camera.height, camera.width):
        image = cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    sift = cv2.SIFT.create(FEATURES, contrastThreshold=CONTRAST)
    grey = cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY)
    keypoints, descriptors = sift.detectAndCompute(grey, None)  # pyright: ignore[reportCallIssue, reportArgumentType]
    if descriptors is None:
        return Features(camera, np.zeros((0, 2)), np.zeros((0, 128), np.float32))
    pixels = np.array([one.pt for one in keypoints]) + 0.5
    return Features(camera, pixels, np.sqrt(descriptors / np.maximum(descriptors.sum(1, keepdims=True), 1e-9)))


def triangulate(found: Sequence[Features]) -> Points:
    """Match the features of the images of one time, and triangulate them.

    Features that are connected by matches are one point, unless a camera would show it twice. Points with small
    parallax, and those that their pixels do not agree on, are dropped.
    """
    labels, of_camera = _connected(found)
    _, labels, counts = np.unique(labels, return_inverse=True, return_counts=True)
    per_camera = np.zeros((len(counts), len(found)), np.int64)
    np.add.at(per_camera, (labels, of_camera), 1)
    owners = _ranks((counts > 1) & (per_camera.max(1, initial=0) == 1))[labels]
    rows = np.flatnonzero(owners >= 0)
    pixels = np.full((owners.max(initial=-1) + 1, len(found), 2), np.nan)
    pixels[owners[rows], of_camera[rows]] = np.concatenate([one.pixels for one in found])[rows]
    seen = [one.camera for one in found]
    places, angles = _nearest_to_rays(seen, pixels)
    points = Points(seen, places, pixels, owners[rows], np.concatenate([one.descriptors for one in found])[rows])
    sound = (points.reprojection_errors(places) < EPIPOLAR) & (angles > PARALLAX)
    kept = sound[points.owners]
    return Points(seen, places[sound], pixels[sound], _ranks(sound)[points.owners[kept]], points.descriptors[kept])


def matches(one: Points, other: Points) -> tuple[np.ndarray, np.ndarray]:
    """Match the points of two times by their descriptors. Returns the matching rows of both. [C], [C]"""
    starts = range(0, len(one.descriptors), BLOCK)
    blocks = (one.descriptors[start : start + BLOCK] @ other.descriptors.T for start in starts)
    rows, columns = _mutual(blocks, other.owners)
    pairs = np.unique(np.stack([one.owners[rows], other.owners[columns]], 1), axis=0)
    return pairs[:, 0], pairs[:, 1]


def _connected(found: Sequence[Features]) -> tuple[np.ndarray, np.ndarray]:
    """Label the features of all images by connection. Returns the labels and the cameras of the features. [F], [F]"""
    starts = np.cumsum([0, *(len(one.pixels) for one in found)])
    links = [np.zeros((0, 2), np.int64)]
    for a, b in itertools.combinations(range(len(found)), 2):
        likeness = found[a].descriptors @ found[b].descriptors.T
        likeness[_epipolar_distances(found[a], found[b]) > EPIPOLAR] = -1
        rows, columns = _mutual([likeness], np.arange(likeness.shape[1]))
        links.append(np.stack([starts[a] + rows, starts[b] + columns], 1))
    a, b = np.concatenate(links).T
    graph = sparse.coo_matrix((np.ones(len(a)), (a, b)), shape=(starts[-1], starts[-1]))
    return csgraph.connected_components(graph, directed=False)[1], np.repeat(np.arange(len(found)), np.diff(starts))


def _epipolar_distances(one: Features, other: Features) -> np.ndarray:
    """Return the distances of the features of an image from the epipolar lines of those of another one, pixels."""
    matrix = cameras.fundamental(one.camera, other.camera)
    lines = np.c_[one.pixels, np.ones(len(one.pixels))] @ matrix.T
    across = np.abs(lines @ np.c_[other.pixels, np.ones(len(other.pixels))].T)
    return across / np.maximum(np.linalg.norm(lines[:, :2], axis=1, keepdims=True), 1e-12)


def _mutual(blocks: Iterable[np.ndarray], owners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return rows and columns that are most alike, if the row is clearly less like all columns of other owners.

    Args:
        blocks: Likeness of successive rows to all columns. [B, C] each
        owners: Owner of each column. [C]
    """
    if not len(owners):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    best, good, count = [np.zeros(0, np.int64)], [np.zeros(0, bool)], 0
    highest, row_of = np.full(len(owners), -np.inf), np.full(len(owners), -1)  # of each column, so far
    for likeness in blocks:
        mine, tops = likeness.argmax(1), likeness.argmax(0)
        first = np.take_along_axis(likeness, mine[:, None], 1)[:, 0]
        second = np.where(owners[None, :] == owners[mine][:, None], -1, likeness).max(1)
        nearer = np.sqrt(np.maximum(2 - 2 * first, 0)) < RATIO * np.sqrt(np.maximum(2 - 2 * second, 0))
        best.append(mine)
        good.append((first > 0) & nearer)
        values = np.take_along_axis(likeness, tops[None], 0)[0]
        row_of = np.where(values > highest, count + tops, row_of)
        highest = np.maximum(highest, values)
        count += len(likeness)
    columns = np.concatenate(best)
    rows = np.flatnonzero(np.concatenate(good) & (row_of[columns] == np.arange(count)))
    return rows, columns[rows]


def _ranks(good: np.ndarray) -> np.ndarray:
    """Number the rows that are good; -1 for the others."""
    return np.where(good, np.cumsum(good) - 1, -1)


def _nearest_to_rays(seen: Sequence[Camera], pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the points nearest to the rays of pixels [P, V, 2], and the largest angle of two rays, rad. [P, 3], [P]"""
    normal, right = np.zeros((len(pixels), 3, 3)), np.zeros((len(pixels), 3))
    rays = np.full((len(pixels), len(seen), 3), np.nan)
    for v, camera in enumerate(seen):
        rows = np.flatnonzero(np.isfinite(pixels[:, v, 0]))
        local = np.c_[pixels[rows, v], np.ones(len(rows))] @ np.linalg.inv(camera.intrinsics).T
        ray = local / np.linalg.norm(local, axis=1, keepdims=True) @ camera.T_cam_world[:3, :3]
        across = np.eye(3) - ray[:, :, None] * ray[:, None, :]
        rays[rows, v] = ray
        normal[rows] += across
        right[rows] += across @ camera.center
    cosines = np.nan_to_num(np.einsum("pvi,pwi->pvw", rays, rays), nan=1.0)
    places = np.linalg.solve(normal + 1e-12 * np.eye(3), right[..., None])[..., 0]
    return places, np.arccos(np.clip(cosines.min((1, 2)), -1, 1))
