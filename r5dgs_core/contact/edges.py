"""Edges of supports, such as tables, over which bodies fall to the ground below.

Places are proven empty by rays: a pixel that shows something below the plane shows that the plane has a hole where the
ray passes through it.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from scipy import ndimage, spatial

from ..motion import rotations
from ..scene import splats
from ..scene.scene import Scene
from . import held_out, scene_bodies, support, world
from .scene_bodies import SceneBody
from .world import Body, Edge, Plane

_TIMES = 16  # at which a path is tested
_UNDER = 0.4  # horizontal distance in sizes up to which a surface carries a body
_DEEP = 0.3  # points farther below a plane, in sizes, show that it is empty above them
_LAYER = 0.1  # points nearer to a plane, in sizes, are part of it
_CELL = 0.15  # edge length of a cell, in sizes
_REACH = 12.0  # distance up to which a support is searched, in sizes
_STRIP = 0.75  # half width of the part of a surface, in sizes, that shows its border at a path
_HOLES = 0.15  # share of empty cells above which a support is not convex
_SEEN = 0.3  # opacity of a Gaussian that may carry a body
_PROOF = 3  # weight of an empty place, as depths at the border of a surface are blurred outwards


@dataclass(frozen=True)
class Leave:
    """A body that moves off its support.

    Attributes:
        number: Number of the body.
        plane: The plane of the support.
        edge: Its edge.
    """

    number: int
    plane: Plane
    edge: Edge


def first(scene: Scene, bodies: list[SceneBody], numbers: list[int], end: float, up: np.ndarray) -> Leave | None:
    """Return the first of some bodies that moves off its support up to the scene time ``end``, or None."""
    if not numbers:
        return None
    ground = _Ground.of(scene, up)
    for number in numbers:
        body = bodies[number]
        size = body.solid.size
        paths = [path for path in _paths(scene, body, end) if ground.is_left(path, size)]
        if not paths:  # decided without drawing pictures
            continue
        plane = _plane(scene, body, up)
        if plane is None or not held_out.in_contact(scene, body, plane):
            continue
        for path in paths:
            edge = _find(scene, plane, path, size)
            if edge is not None:
                return Leave(number, plane, edge)
    return None


def _paths(scene: Scene, body: SceneBody, end: float) -> list[np.ndarray]:
    """Paths on which a body may move off its support, at equal steps of time. [T, 3] each

    The first is that of its law. A driven body also has a straight path with its velocity, because a drift in the
    poses of a rolling ball looks like a force.
    """
    path = scene_bodies.predicted(body, np.linspace(0, max(end - scene.t_max, 0.0), _TIMES))[1]
    straight = path[0] + np.arange(_TIMES)[:, None] * (path[1] - path[0])
    return [path, straight] if body.reason else [path]


def _plane(scene: Scene, body: SceneBody, up: np.ndarray) -> Plane | None:
    """Plane below a body: that of the pictures, or a level one if the body's heights fit it better."""
    track, size = scene_bodies.track(scene, body), body.solid.size
    tilted = support.find(scene, up, track.places[-3:], size, _UNDER * size)
    if tilted is None:
        return None
    place = track.places[-1]
    below = place - (place @ tilted.normal - tilted.height) / (up @ tilted.normal) * up
    planes = tilted, Plane(up, float(below @ up))
    return min(planes, key=lambda one: float(world.gaps(Body(body.solid), one, track.places, track.quats).std()))


@dataclass(frozen=True)
class _Ground:
    """Gaussians of the background that may carry bodies.

    Attributes:
        up: Unit vector against gravity. [3]
        means: Their centres. [N, 3]
        upwards: Standard deviations along the up axis. [N]
        largest: Standard deviations along their longest axes. [N]
    """

    up: np.ndarray
    means: np.ndarray
    upwards: np.ndarray
    largest: np.ndarray

    @classmethod
    def of(cls, scene: Scene, up: np.ndarray) -> _Ground:
        """Return the opaque, resting Gaussians of the background of a scene."""
        found = scene.gaussians
        rows = (found.object_ids == 0) & (found.motion_ids == 0) & (splats.to_opacities(found.opacity_logits) > _SEEN)
        axes = (
            rotations.quats_to_rotmats(found.quats[rows].astype(np.float64)) * np.exp(found.log_scales[rows])[:, None]
        )
        lengths = np.linalg.norm(axes, axis=2)
        return cls(up, found.means[rows], lengths @ np.abs(up), lengths.max(axis=1))

    def is_left(self, path: np.ndarray, size: float) -> bool:
        """Return True if a body is carried at the start of a path and not everywhere on it. [T, 3]"""
        carried = [self.carries(place, size) for place in path]
        return carried[0] and not all(carried)

    def carries(self, place: np.ndarray, size: float) -> bool:
        """Return True if a Gaussian is under a body of the given size with its centre at a place [3]."""
        apart = place - self.means
        heights = apart @ self.up
        across = np.linalg.norm(apart - heights[:, None] * self.up, axis=-1)
        return bool(((across < _UNDER * size + self.largest) & (np.abs(heights) < size + self.upwards)).any())


def _find(scene: Scene, plane: Plane, path: np.ndarray, size: float) -> Edge | None:
    """Edge of the convex part of a plane on which a path begins; None unless the path leads to an empty part of it."""
    normal = plane.normal
    flat = np.linalg.svd(normal[None])[2][1:].T  # world to coordinates in the plane
    surface, origins = support.surface(scene)
    heights, above = surface @ normal - plane.height, origins @ normal - plane.height
    near = np.linalg.norm((surface - path[0]) @ flat, axis=1) < _REACH * size
    on = near & (np.abs(heights) < _LAYER * size)
    through = (heights < -_DEEP * size) & (above > 0)
    share = (above / np.maximum(above - heights, 1e-12))[through, None]
    empty = (origins[through] + share * (surface - origins)[through]) @ flat
    track, carried = path @ flat, surface[on] @ flat
    corners = _part(carried, empty, track[0], size)
    if corners is None:
        return None
    hull = spatial.ConvexHull(corners)
    outside = (track @ hull.equations[:, :2].T + hull.equations[:, 2]).max(axis=1)
    beyond = np.flatnonzero(outside > 0.5 * _UNDER * size)
    if outside[0] > 0 or not len(beyond):
        return None
    place = track[beyond[0]]
    holes, solid = (np.count_nonzero(np.linalg.norm(x - place, axis=1) < _UNDER * size) for x in (empty, carried))
    if holes < max(2 * solid, 4):
        return None
    side = hull.equations[np.argmax(place @ hull.equations[:, :2].T + hull.equations[:, 2]), :2]
    shape = _trimmed(corners[hull.vertices], side, track[[0, beyond[0]]], carried, empty, size)
    outline = shape @ flat.T + plane.height * normal
    low = surface[near & (heights < -_DEEP * size)]
    return Edge(outline, support.level(low, normal, size))


def _trimmed(
    corners: np.ndarray, out: np.ndarray, path: np.ndarray, carried: np.ndarray, empty: np.ndarray, size: float
) -> np.ndarray:
    """Cut a convex outline back where a path leaves it, as noise widens it. [V, 2] -> [V', 2]

    Args:
        corners: Corners of the outline, in order.
        out: Outward unit normal of its side there. [2]
        path: Start of the path, and its first place that is clearly beyond that side. [2, 2]
        carried, empty: Points of the surface, and points where nothing is. [P, 2] each
        size: Size of the body.
    """
    start, place = path
    points = np.concatenate([carried, empty]) - place
    close = (np.abs(points @ [-out[1], out[0]]) < _STRIP * size) & (np.abs(points @ out) < size)
    across = points[close] @ out
    order = np.argsort(across)
    signs = np.repeat([1, -_PROOF], [len(carried), len(empty)])[close][order]
    # Beyond the border, at least a quarter of the points are empty.
    border = max(across[order][np.argmax(np.cumsum(signs))], (start - place) @ out)
    reach = (corners - place) @ out - border
    cut = [corners[reach <= 0]]
    for a, b in itertools.pairwise([*range(len(corners)), 0]):
        if reach[a] * reach[b] < 0:
            cut.append(corners[a : a + 1] + reach[a] / (reach[a] - reach[b]) * (corners[b] - corners[a]))
    left = np.concatenate(cut)
    return left[spatial.ConvexHull(left).vertices]


def _part(carried: np.ndarray, empty: np.ndarray, start: np.ndarray, size: float) -> np.ndarray | None:
    """Points of a surface that are connected with a place and fill a convex part of the plane, or None. [P, 2]"""
    half, cell = int(_REACH / _CELL) + 1, _CELL * size
    bins = [start[k] + cell * (np.arange(2 * half + 2) - half - 0.5) for k in range(2)]
    counts = [np.histogram2d(*points.T, bins=bins)[0] for points in (carried, empty)]
    solid = counts[0] > counts[1]
    labels = np.zeros(solid.shape, np.int32)
    ndimage.label(solid, np.ones((3, 3)), output=labels)
    middle = labels[half - 2 : half + 3, half - 2 : half + 3]
    if not middle.any():
        return None
    part = labels == np.bincount(middle[middle > 0]).argmax()
    cells = [np.clip(np.digitize(carried[:, k], bins[k]) - 1, 0, 2 * half) for k in range(2)]
    points = carried[part[cells[0], cells[1]]]
    if len(points) < support.LEAST:
        return None
    centers = np.stack(np.meshgrid(*[0.5 * (x[1:] + x[:-1]) for x in bins], indexing="ij"), -1)
    inside = spatial.Delaunay(points[spatial.ConvexHull(points).vertices]).find_simplex(centers) >= 0
    holes = inside & (counts[1] > counts[0])
    return None if holes.sum() > _HOLES * inside.sum() else points
