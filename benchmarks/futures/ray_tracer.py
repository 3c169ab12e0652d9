"""Ray tracer for small scenes of textured solids on a textured floor under one light, in numpy.

Solids are signed distance functions, found by sphere tracing. Nothing here is shared with the rasterizer of the
package. Notation: N rays or points.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from r5dgs_core.capture.calibration.lens import Lens
from r5dgs_core.scene.cameras import Camera

SUPERSAMPLES = 2  # per side of a pixel
_STEPS, _CLOSE = 48, 2e-3
_AMBIENT, _DARK = 0.55, 0.6  # share of light that has no direction; brightness of the floor in a shadow
_LIGHT = np.array([0.45, -0.3, 0.84]) / np.linalg.norm([0.45, -0.3, 0.84])
_SKY = np.array([0.62, 0.74, 0.9])

Distance = Callable[[np.ndarray], np.ndarray]  # points in the solid's frame [N, 3] -> signed distances [N]
Texture = Callable[[np.ndarray], np.ndarray]  # the same points -> sRGB colours [N, 3]


@dataclass(frozen=True)
class Solid:
    """A textured solid in a pose.

    Attributes:
        object_id: Id in the masks; 0 for the background.
        distance: Signed distance function.
        texture: Colours of its surface.
        bound: Radius about its origin that holds it.
        place: Origin in the world. [3]
        turn: Rotation from the solid's frame to the world.
    """

    object_id: int
    distance: Distance
    texture: Texture
    bound: float
    place: np.ndarray
    turn: Rotation


def ball(radius: float) -> Distance:
    """Signed distance to a ball."""
    return lambda p: np.linalg.norm(p, axis=-1) - radius


def box(half: Sequence[float]) -> Distance:
    """Signed distance to a box with slightly rounded edges."""
    size = np.array(half) - 0.02

    def distance(p: np.ndarray) -> np.ndarray:
        q = np.abs(p) - size
        return np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(-1), 0) - 0.02

    return distance


def ring(radius: float, thickness: float) -> Distance:
    """Signed distance to a torus about the z axis."""
    return lambda p: np.hypot(np.hypot(p[:, 0], p[:, 1]) - radius, p[:, 2]) - thickness


def drum(radius: float, half_height: float) -> Distance:
    """Signed distance to a cylinder about the z axis."""

    def distance(p: np.ndarray) -> np.ndarray:
        q = np.stack([np.hypot(p[:, 0], p[:, 1]) - radius, np.abs(p[:, 2]) - half_height], -1)
        return np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(-1), 0)

    return distance


def patches(rng: np.random.Generator, count: int) -> Texture:
    """Patches of random colours on a solid of radius 0.3 or so, the cells of random points."""
    seeds, colors = rng.uniform(-0.35, 0.35, (count, 3)), rng.uniform(0.05, 0.95, (count, 3))
    return lambda p: colors[(p @ seeds.T - 0.5 * (seeds**2).sum(1)).argmax(1)]


def sectors(rng: np.random.Generator, count: int) -> Texture:
    """Equal sectors about the z axis in two colours, of which one sector and the upper side are marked."""
    colors = rng.uniform(0.1, 0.9, (2, 3))

    def texture(p: np.ndarray) -> np.ndarray:
        sector = np.floor((np.arctan2(p[:, 1], p[:, 0]) / (2 * np.pi) + 0.5) * count).astype(int)
        found = colors[sector % 2].copy()
        found[sector == 1] = (0.95, 0.9, 0.2)
        found[p[:, 2] > 0] *= 0.8
        return found

    return texture


def plain(rng: np.random.Generator) -> Texture:
    """One colour."""
    color = rng.uniform(0.2, 0.9, 3)
    return lambda p: np.tile(color, (len(p), 1))


def floor(rng: np.random.Generator) -> Texture:
    """Patches of muted colours on the plane z = 0."""
    seeds, colors = rng.uniform(-7, 7, (250, 2)), rng.uniform(0.4, 0.65, (250, 3))
    tree = KDTree(seeds)
    return lambda p: colors[tree.query(p[:, :2])[1]]


def render(
    camera: Camera, solids: Sequence[Solid], ground: Texture, lens: Lens | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Render an image.

    Args:
        camera: The camera.
        solids: The solids.
        ground: Texture of the floor.
        lens: Lens of the camera; that of its camera matrix if None.

    Returns:
        The image, sRGB in [0, 1] [H, W, 3], and its object ids, by vote of the samples of a pixel [H, W].
    """
    fine, k = (camera.height * SUPERSAMPLES, camera.width * SUPERSAMPLES), camera.intrinsics
    v, u = ((np.indices(fine) + 0.5) / SUPERSAMPLES).reshape(2, -1)
    if lens is None:
        ways = np.stack([(u - k[0, 2]) / k[0, 0], (v - k[1, 2]) / k[1, 1], np.ones_like(u)], -1)
    else:
        ways = lens.unproject(np.stack([u, v], -1))
    ways = ways / np.linalg.norm(ways, axis=1, keepdims=True) @ camera.T_cam_world[:3, :3]
    start = np.broadcast_to(camera.center, ways.shape)
    depth, hit = _nearest(start, ways, solids)
    down = np.where(ways[:, 2] < 0, -start[:, 2] / np.minimum(ways[:, 2], -1e-9), np.inf)
    on_floor = (down < depth) & (down < 30)
    colors = np.tile(_SKY, (len(ways), 1))
    for row, solid in enumerate(solids):
        mine = (hit == row) & ~on_floor
        local = solid.turn.inv().apply(start[mine] + depth[mine, None] * ways[mine] - solid.place)
        if len(local):
            shade = _AMBIENT + (1 - _AMBIENT) * np.maximum(solid.turn.apply(_normals(solid, local)) @ _LIGHT, 0)
            colors[mine] = solid.texture(local) * shade[:, None]
    spots = start[on_floor] + down[on_floor, None] * ways[on_floor]
    blocked = _nearest(spots, np.broadcast_to(_LIGHT, spots.shape), solids)[1] >= 0
    colors[on_floor] = ground(spots) * np.where(blocked, _DARK, 1.0)[:, None]
    ids = np.where(on_floor | (hit < 0), 0, np.array([*(s.object_id for s in solids), 0])[hit])
    votes = _pixels((ids[:, None] == np.arange(ids.max() + 1)).astype(float), camera)
    return _pixels(colors, camera).clip(0, 1), votes.argmax(-1).astype(np.uint8)


def _pixels(samples: np.ndarray, camera: Camera) -> np.ndarray:
    """Means of the samples of each pixel. [N, C] -> [H, W, C]"""
    shape = (camera.height, SUPERSAMPLES, camera.width, SUPERSAMPLES, -1)
    return samples.reshape(shape).mean((1, 3))


def _nearest(start: np.ndarray, ways: np.ndarray, solids: Sequence[Solid]) -> tuple[np.ndarray, np.ndarray]:
    """Distance to the nearest solid on each ray, infinite if none [N], and its index or -1 [N]."""
    depth, hit = np.full(len(start), np.inf), np.full(len(start), -1)
    for row, solid in enumerate(solids):
        arm = solid.place - start
        along = (arm * ways).sum(-1)
        squared = (arm**2).sum(-1) - along**2
        near = np.flatnonzero((squared < solid.bound**2) & (along > 0))
        back = solid.turn.inv()
        origin, way = back.apply(start[near] - solid.place), back.apply(ways[near])
        t = np.maximum(along[near] - np.sqrt(solid.bound**2 - squared[near]), 1e-3)
        for _ in range(_STEPS if len(near) else 0):
            t = t + solid.distance(origin + t[:, None] * way)
        found = solid.distance(origin + t[:, None] * way) < _CLOSE if len(near) else np.zeros(0, bool)
        better = near[found & (t < depth[near])]
        depth[better] = t[found & (t < depth[near])]
        hit[better] = row
    return depth, hit


def _normals(solid: Solid, points: np.ndarray) -> np.ndarray:
    """Outward unit normals in the solid's frame. [N, 3]"""
    step = 1e-3 * np.eye(3)
    slopes = np.stack([solid.distance(points + h) - solid.distance(points - h) for h in step], -1)
    return slopes / np.maximum(np.linalg.norm(slopes, axis=1, keepdims=True), 1e-9)
