"""Plane sweep that places the initial static background.

Each camera has one image without objects (`background_images`). For a grid of its rays, a range of depths is compared;
at a good depth the other cameras show the same colour. Rays on which infinity is as good as any depth show sky and
place no points; the learned background represents them.

Notation: B background images, [h, w] a grid of rays, D depths.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from numpy.lib.stride_tricks import sliding_window_view
from scipy import ndimage
from scipy.spatial import ConvexHull, KDTree

from ...scene import cameras
from . import sky
from .background_images import BackgroundImage

MAX_NEIGHBOURS = 8
COST_VALUES = 1 << 22  # colour differences per compared band
NEAREST, FARTHEST = 0.4, 60.0  # normalised units; the cameras' focus is at about 4
INFINITE = 1e5
PLANE_REACH = 12.0  # maximum depth of rays that extend the plane beyond its region, normalised units
SAME = 0.012  # maximum insignificant colour difference
GOOD = 0.12  # maximum colour difference of a match
CONFIRMATIONS = 2  # other cameras that must agree on a depth


@dataclass(frozen=True)
class BackgroundPoints:
    """Background points [P, 3], their colours [P, 3], and coefficients of the sky [9, 3] or None."""

    points: np.ndarray
    colors: np.ndarray
    sky: np.ndarray | None


@dataclass(frozen=True)
class Rays:
    """Result of the sweep along the rays of one background image.

    Attributes:
        image: Index of the background image.
        directions: Ray directions scaled to depth 1, world. [h, w, 3]
        colors: Colour of each ray. [h, w, 3]
        depths: Best depth of each ray. [h, w]
        costs: Colour difference to the other cameras at that depth, infinite if not comparable. [h, w]
        flat: True if most depths are about as good, as on sky and on uniform surfaces. [h, w] bool
        sky: True if infinity is about as good. [h, w] bool
        known: True if the colour is known. [h, w] bool
        neighbours: Background images that it was compared with.
    """

    image: int
    directions: np.ndarray
    colors: np.ndarray
    depths: np.ndarray
    costs: np.ndarray
    flat: np.ndarray
    sky: np.ndarray
    known: np.ndarray
    neighbours: tuple[int, ...]


class Sweep:
    """Plane sweep over all background images.

    Args:
        backgrounds: Background image of each camera.
        count: Number of points that will be placed; determines the number of rays.
        depths: Depths per ray, evenly spaced in inverse depth.
    """

    def __init__(self, backgrounds: Sequence[BackgroundImage], count: int, depths: int):
        self.backgrounds = backgrounds
        self._images = [
            torch.from_numpy(ndimage.gaussian_filter(b.image, (0.7, 0.7, 0))).permute(2, 0, 1)[None]
            for b in backgrounds
        ]
        self._known = [torch.from_numpy(b.known.astype(np.float32))[None, None] for b in backgrounds]
        inverse = np.linspace(1 / NEAREST, 1 / FARTHEST, depths)
        self._step = float(inverse[0] - inverse[-1]) / max(1, depths - 1)
        z = np.append(1 / inverse, INFINITE)
        each = max(256, 5 * count // max(1, len(backgrounds)))
        self.rays = [r for i in range(len(backgrounds)) if (r := self._sweep(i, z, each)) is not None]

    def _sweep(self, i: int, z: np.ndarray, rays_each: int) -> Rays | None:
        reference = self.backgrounds[i]
        centers = np.stack([b.camera.center for b in self.backgrounds])
        ahead = np.stack([b.camera.forward for b in self.backgrounds]) @ reference.camera.forward
        order = np.argsort(np.linalg.norm(centers - centers[i], axis=1) - 2 * ahead)
        neighbours = tuple(int(j) for j in order if j != i and ahead[j] > -0.2)[:MAX_NEIGHBOURS]
        if not neighbours:
            return None
        height, width = reference.image.shape[:2]
        stride = max(1, int(np.sqrt(height * width / rays_each)))
        rows, cols = np.meshgrid(
            np.arange(stride // 2, height, stride), np.arange(stride // 2, width, stride), indexing="ij"
        )
        directions = cameras.pixel_rays(reference.camera)[rows, cols]
        directions = directions / (directions @ reference.camera.forward)[..., None]
        colors = reference.image[rows, cols]
        cost = _smooth(self._compare(i, directions, z, colors, neighbours))
        best, at = cost[..., :-1].min(-1)
        low = cost <= best[..., None] + SAME
        comparable = torch.isfinite(cost[..., :-1]).sum(-1)
        flat = low[..., :-1].sum(-1) > 0.5 * comparable
        known = reference.known[rows, cols]
        costs = np.where(known, best.numpy(), np.inf)
        return Rays(i, directions, colors, z[at.numpy()], costs, flat.numpy(), low[..., -1].numpy(), known, neighbours)

    def _compare(
        self, i: int, directions: np.ndarray, depths: np.ndarray, colors: np.ndarray, neighbours: Sequence[int]
    ) -> torch.Tensor:
        """Colour difference of rays [h, w, 3] at depths [D] or [h, w, D] to the neighbours, in bands. [h, w, D]"""
        others = [(self.backgrounds[j].camera, self._images[j], self._known[j]) for j in neighbours]
        height, width = directions.shape[:2]
        rows = max(1, COST_VALUES // (width * depths.shape[-1] * max(1, len(others))))
        bands = []
        for top in range(0, height, rows):
            band = slice(top, top + rows)
            z = depths if depths.ndim == 1 else depths[band]
            world = self.backgrounds[i].camera.center + directions[band][:, :, None] * z[..., None]
            bands.append(_cost(torch.from_numpy(world).float(), torch.from_numpy(colors[band]), others))
        return torch.cat(bands)

    def distinct_points(self) -> np.ndarray:
        """Return points on rays with one distinct depth, for fitting planes. [P, 3]"""
        found = [
            self.backgrounds[r.image].camera.center + (r.directions * r.depths[..., None])[good]
            for r in self.rays
            if (good := (r.costs < GOOD) & ~r.flat & ~r.sky).any()
        ]
        return np.concatenate(found) if found else np.zeros((0, 3))

    def place(
        self, count: int, plane: tuple[np.ndarray, float] | None, find_sky: bool, rng: np.random.Generator
    ) -> BackgroundPoints:
        """Draw background points and fit the sky.

        Rays on which the supporting plane is as good as the best depth are placed on the plane: within the region in
        which it was found and, if the sky is known, on all near rays that do not show sky. Rays of the sky and rays
        without a distinct depth place no points. The others are placed at their best depth if other cameras confirm it.

        Args:
            count: Number of points.
            plane: Unit normal and offset of the supporting plane, or None.
            find_sky: True if there may be sky; False if the background's colour is fixed.
            rng: Random generator.

        Returns:
            At most ``count`` points; none without parallax or if everything is sky.
        """
        if not self.rays:
            return BackgroundPoints(np.zeros((0, 3)), np.zeros((0, 3)), None)
        eyes = [np.broadcast_to(self.backgrounds[r.image].camera.center, r.directions.shape) for r in self.rays]
        origin = _flatten(eyes)
        direction, color = _flatten([r.directions for r in self.rays]), _flatten([r.colors for r in self.rays])
        depth, cost = _flatten([r.depths for r in self.rays]), _flatten([r.costs for r in self.rays])
        clear = (cost < GOOD) & ~_flatten([r.flat | r.sky for r in self.rays])
        plane_depth, plane_cost = np.ones(len(cost)), np.full(len(cost), np.inf)
        supported = np.zeros(len(cost), bool)
        if plane is not None:
            hits = [self._on_plane(r, plane) for r in self.rays]
            plane_depth, plane_cost = (_flatten([hit[k] for hit in hits]) for k in (0, 1))
            support = _Support(self.distinct_points(), plane)
            supported = np.isfinite(plane_cost) & support(origin + direction * plane_depth[:, None])
        candidates = _flatten([r.known for r in self.rays]) & ~supported & find_sky
        unit = direction / np.linalg.norm(direction, axis=1, keepdims=True)
        found = sky.fit(unit, color, candidates, self._up())
        is_sky = found[1] if found is not None else np.zeros(len(cost), bool)
        as_good = (plane_cost <= np.minimum(cost + 2 * SAME, GOOD)) & np.isfinite(cost)
        on_plane = as_good & (supported | ((plane_depth < PLANE_REACH) & (found is not None)))
        depth = np.where(on_plane, plane_depth, depth)
        points = origin + direction * depth[:, None]
        usable = (on_plane | (clear & self._confirmed(points, depth))) & ~is_sky
        points = points[usable]
        coefficients = found[0] if found is not None else None
        if len(points) == 0:
            return BackgroundPoints(np.zeros((0, 3)), np.zeros((0, 3)), coefficients)
        weights = 1 / (0.02 + cost[usable])
        chosen = rng.choice(len(points), min(count, len(points)), replace=False, p=weights / weights.sum())
        return BackgroundPoints(points[chosen], color[usable][chosen], coefficients)

    def matches(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return points that cameras see at one distinct depth.

        Returns:
            Points [P, 3], the background image of each [P], and a mask of the other background images that confirm it
            [B, P].
        """
        eyes = [np.broadcast_to(self.backgrounds[r.image].camera.center, r.directions.shape) for r in self.rays]
        if not self.rays:
            return np.zeros((0, 3)), np.zeros(0, int), np.zeros((len(self.backgrounds), 0), bool)
        depth = _flatten([r.depths for r in self.rays])
        points = _flatten(eyes) + _flatten([r.directions for r in self.rays]) * depth[:, None]
        agreed = self._agreed(points, depth)
        clear = _flatten([(r.costs < GOOD) & ~r.flat & ~r.sky for r in self.rays])
        clear &= agreed.sum(0) >= min(CONFIRMATIONS, len(self.rays) - 1)
        seen = np.zeros((len(self.backgrounds), len(points)), bool)
        seen[[r.image for r in self.rays]] = agreed
        owners = np.concatenate([np.full(r.depths.size, r.image) for r in self.rays])
        return points[clear], owners[clear], seen[:, clear]

    def _confirmed(self, points: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """Mask of points at whose depth other cameras found a surface, too. [P] bool

        Matches between repeated or smooth patterns give depths that do not agree with the best matches of other
        cameras. This is the geometric consistency check of multi-view stereo: at least `CONFIRMATIONS` other cameras
        (one, if there are only two cameras) have a depth within one step of the sweep next to the point's pixel.

        Args:
            points: Points on all rays, in the order of the rays. [P, 3]
            depth: Depth of each in its own camera. [P]
        """
        return self._agreed(points, depth).sum(0) >= min(CONFIRMATIONS, len(self.rays) - 1)

    def _agreed(self, points: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """Mask of the other cameras with rays that found a surface at each point. Arguments of `_confirmed`. [K, P]"""
        owner = np.concatenate([np.full(r.depths.size, k) for k, r in enumerate(self.rays)])
        maps = np.split(depth, np.cumsum([r.depths.size for r in self.rays])[:-1])
        agreed = np.zeros((len(self.rays), len(points)), bool)
        for k, (rays, values) in enumerate(zip(self.rays, maps, strict=True)):
            camera = self.backgrounds[rays.image].camera
            height, width = rays.depths.shape
            pixels, z = cameras.project(camera, points)
            column, row = pixels[:, 0] / camera.width * width, pixels[:, 1] / camera.height * height
            visible = (z > NEAREST) & (column >= 0) & (column < width) & (row >= 0) & (row < height) & (owner != k)
            row, column = row[visible].astype(int), column[visible].astype(int)
            inverse = np.pad(1 / values.reshape(height, width), 1, mode="edge")
            beside = sliding_window_view(inverse, (3, 3)).reshape(height, width, 9)[row, column]
            agreed[k, visible] = (np.abs(beside - 1 / z[visible, None]) <= self._step).any(1)
        return agreed

    def _up(self) -> np.ndarray:
        """Mean upward direction of the cameras, unit. [3]"""
        up = -np.stack([b.camera.T_cam_world[1, :3] for b in self.backgrounds]).mean(0)
        return up / max(float(np.linalg.norm(up)), 1e-9)

    def _on_plane(self, rays: Rays, plane: tuple[np.ndarray, float]) -> tuple[np.ndarray, np.ndarray]:
        """Return the depth at which each ray meets a plane, and the colour difference there (infinite if it misses)."""
        normal, height = plane
        center = self.backgrounds[rays.image].camera.center
        slope = rays.directions @ normal
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = (height - center @ normal) / slope
        hits = np.isfinite(depth) & (depth > NEAREST) & (depth < FARTHEST)
        depth = np.where(hits, depth, 1.0)
        compared = self._compare(rays.image, rays.directions, depth[..., None], rays.colors, rays.neighbours)
        cost = _smooth(compared)[..., 0].numpy()
        return depth, np.where(hits, cost, np.inf)


def _flatten(grids: Sequence[np.ndarray]) -> np.ndarray:
    """Concatenate the values of all rays: grids [h, w, ...] to [P, ...]."""
    return np.concatenate([grid.reshape(-1, *grid.shape[2:]) for grid in grids])


def plane_axes(normal: np.ndarray) -> np.ndarray:
    """Return two orthogonal unit vectors that span the plane of a unit normal. [2, 3]"""
    u = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    u /= np.linalg.norm(u)
    return np.stack([u, np.cross(normal, u)])


class _Support:
    """Region of a plane covered by distinct points: their convex hull in the plane, without outliers."""

    def __init__(self, points: np.ndarray, plane: tuple[np.ndarray, float]):
        normal, height = plane
        self._axes = plane_axes(normal)
        flat = points[np.abs(points @ normal - height) < 0.1] @ self._axes.T
        if len(flat) > 4000:
            flat = flat[:: len(flat) // 4000]
        if len(flat) >= 10:
            near = KDTree(flat).query(flat, k=10)[0][:, -1]
            flat = flat[near <= 3 * np.median(near)]
        self._sides = ConvexHull(flat).equations if len(flat) >= 10 else None

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """True for points [..., 3] near the plane inside the region. [...]"""
        if self._sides is None:
            return np.zeros(points.shape[:-1], bool)
        # The sides' half-planes; searching a triangulation takes seconds if many points lie outside.
        flat = points @ self._axes.T
        return np.logical_and.reduce([flat @ side[:2] + side[2] <= 0 for side in self._sides])


def _cost(world: torch.Tensor, color: torch.Tensor, others) -> torch.Tensor:
    """Mean colour difference to the better half of the neighbours that see the point. [h, w, D]"""
    gaps = []
    for camera, image, known in others:
        T = torch.from_numpy(camera.T_cam_world).float()
        p_cam = world @ T[:3, :3].T + T[:3, 3]
        depth = p_cam[..., 2]
        k = camera.intrinsics
        u = (k[0, 0] * p_cam[..., 0] / depth + k[0, 2]) / camera.width * 2 - 1
        v = (k[1, 1] * p_cam[..., 1] / depth + k[1, 2]) / camera.height * 2 - 1
        h, w, d = depth.shape
        grid = torch.stack([u, v], -1).reshape(1, h, w * d, 2).clamp(-2, 2)
        sample = F.grid_sample(image, grid, align_corners=False, padding_mode="border")[0].reshape(3, h, w, d)
        free = F.grid_sample(known, grid, align_corners=False)[0, 0].reshape(h, w, d)
        gap = (sample.permute(1, 2, 3, 0) - color[:, :, None]).abs().mean(-1)
        seen = (depth > 1e-3) & (u.abs() < 1) & (v.abs() < 1) & (free > 0.5)
        gaps.append(torch.where(seen, gap, torch.inf))
    ranked = torch.stack(gaps).sort(0).values
    seen = torch.isfinite(ranked)
    counts = seen.sum(0)
    half = torch.maximum((counts + 1) // 2, counts.clamp(max=2))
    use = torch.arange(len(gaps))[:, None, None, None] < half
    total = torch.where(use & seen, ranked, 0.0).sum(0) / half.clamp(min=1)
    return torch.where(counts >= min(2, len(gaps)), total, torch.inf)


def _smooth(cost: torch.Tensor) -> torch.Tensor:
    """Mean of the finite costs in a 3 x 3 block of rays, as surfaces are mostly smooth across rays. [h, w, D]"""
    finite = torch.isfinite(cost)
    volume = torch.where(finite, cost, 0.0).permute(2, 0, 1)[:, None]
    weight = finite.float().permute(2, 0, 1)[:, None]
    box = torch.ones(1, 1, 3, 3)
    mean = F.conv2d(volume, box, padding=1) / F.conv2d(weight, box, padding=1).clamp(min=1)
    return torch.where(finite, mean[:, 0].permute(1, 2, 0), torch.inf)
