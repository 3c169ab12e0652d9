"""Scenes of rigid bodies on a floor, seen as Gaussians by several cameras, for the benchmarks of association.

Every image is splatted front to back, and each pixel keeps the Gaussians with the largest weights. The true object of a
pixel is the one with the largest weight at exact positions; an association gets the lists of wrong positions.

Notation: N Gaussians, T times, V views, P pixels of an image, k Gaussians kept per pixel.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numba
import numpy as np

KEPT = 4  # Gaussians per pixel
OPACITY = 0.9
DISTANCE = 4.0  # of the cameras from the middle
TALLEST = 0.24  # semi-axis of the largest body, world units


@dataclass(frozen=True)
class SceneSettings:
    """Content of a scene.

    Attributes:
        bodies: Number of objects.
        gaussians: Number on all of them.
        floor: Number along each side of the floor.
        views: Cameras around the scene.
        times: Times that each camera sees.
        pixels: Width and height of an image.
        still: Share of objects that do not move.
        pairs: Pairs of objects that touch and move together in the first half of the time.
        radius: Smallest and largest semi-axis.
        extent: Half side of the square that objects stand on.
        sweep_rad: Angle that each camera turns about the middle from first to last time.
        leaving: True if one object is far away in the middle third of the time.
    """

    bodies: int = 10
    gaussians: int = 7000
    floor: int = 64
    views: int = 6
    times: int = 16
    pixels: int = 96
    still: float = 0.2
    pairs: int = 2
    radius: tuple[float, float] = (0.16, TALLEST)
    extent: float = 1.1
    sweep_rad: float = 0.0
    leaving: bool = False


PLANS = {
    "ten": SceneSettings(),
    "two": SceneSettings(bodies=2, gaussians=2000, pairs=0, still=0.0),
    "thirty": SceneSettings(bodies=30, gaussians=9000, radius=(0.09, 0.13), pairs=4, extent=1.25),
    "static": SceneSettings(still=1.0, sweep_rad=1.5, views=2, times=32),
    "leaving": SceneSettings(leaving=True),
    "four_images": SceneSettings(views=4, times=1),
}


@dataclass(frozen=True)
class Scene:
    """Gaussians over time and the cameras.

    Attributes:
        paths: Exact places. [N, T, 3]
        objects: Object of each Gaussian, 0 = floor. [N]
        sigmas: Size of each, world units. [N]
        plan: Description from which it was made.
    """

    paths: np.ndarray
    objects: np.ndarray
    sigmas: np.ndarray
    plan: SceneSettings

    @property
    def focal(self) -> float:
        """Focal length in pixels, so that a unit in the middle covers 0.3125 of the image's width."""
        return self.plan.pixels * 0.3125 * DISTANCE

    @property
    def pixel(self) -> float:
        """World length of a pixel in the middle of the scene."""
        return DISTANCE / self.focal


@dataclass(frozen=True)
class Image:
    """One image: the view and time it shows, true objects [P], Gaussians [P, k] (-1 = none) and their weights."""

    view: int
    time: int
    truth: np.ndarray
    indices: np.ndarray
    weights: np.ndarray


def make(plan: SceneSettings, seed: int) -> Scene:
    """Make a scene."""
    rng = np.random.default_rng(seed)
    times = np.linspace(0.0, 1.0, plan.times)
    axes = rng.uniform(*plan.radius, (plan.bodies, 3))
    centres, turns = _motions(plan, axes, times, rng)
    per_body = plan.gaussians // plan.bodies
    paths, objects, sigmas = [], [], []
    for body in range(plan.bodies):
        around = rng.normal(size=(per_body, 3))
        around *= axes[body] / np.linalg.norm(around, axis=1, keepdims=True)
        c, s = np.cos(turns[body]), np.sin(turns[body])
        x = c[None] * around[:, :1] - s[None] * around[:, 1:2]
        y = s[None] * around[:, :1] + c[None] * around[:, 1:2]
        z = np.repeat(around[:, 2:], len(times), axis=1)
        paths.append(np.stack([x, y, z], axis=-1) + centres[body])
        objects.append(np.full(per_body, body + 1))
        area = 4 * np.pi * np.mean(axes[body]) ** 2
        sigmas.append(np.full(per_body, 0.9 * np.sqrt(area / per_body)))
    grid = np.linspace(-1.0, 1.0, plan.floor) * (plan.extent + 0.7)
    floor = np.stack([*np.meshgrid(grid, grid), np.zeros((plan.floor, plan.floor))], axis=-1).reshape(-1, 1, 3)
    paths.append(np.repeat(floor, len(times), axis=1))
    objects.append(np.zeros(len(floor), int))
    sigmas.append(np.full(len(floor), 0.8 * (grid[1] - grid[0])))
    return Scene(*(np.concatenate(parts) for parts in (paths, objects, sigmas)), plan)


def _motions(
    plan: SceneSettings, axes: np.ndarray, times: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, ...]:
    """Centres [M, T, 3] and rotations about the vertical [M, T] of bodies that stay apart, except in pairs."""
    ahead = times[:, None]
    centres, turns = np.zeros((plan.bodies, len(times), 3)), np.zeros((plan.bodies, len(times)))
    still = set(rng.permutation(plan.bodies)[: round(plan.still * plan.bodies)].tolist())
    size = axes[:, :2].max(axis=1)

    def body(k: int, start: np.ndarray, velocity: np.ndarray, bend: np.ndarray) -> np.ndarray:
        flat = start + velocity * ahead + bend * ahead**2
        return np.concatenate([flat, np.full_like(ahead, axes[k, 2])], axis=1)

    for k in range(plan.bodies):
        mate = k - 1 if k % 2 and k < 2 * plan.pairs else None
        best, best_gap = None, -np.inf
        for _ in range(400):
            velocity, bend = rng.normal(size=(2, 2)) * (0.0 if k in still else 0.35)
            if mate is not None:
                angle = rng.uniform(0, 2 * np.pi)
                apart = 0.92 * (size[k] + size[mate]) * np.array([np.cos(angle), np.sin(angle)])
                later = (
                    np.maximum(ahead - 0.5, 0.0) * (0.0 if {k, mate} & still else 0.8) * apart / np.linalg.norm(apart)
                )
                path = centres[mate] + np.concatenate([apart + later, np.zeros_like(ahead)], axis=1)
                path[:, 2] = axes[k, 2]
            else:
                path = body(k, rng.uniform(-plan.extent, plan.extent, 2), velocity, bend)
            others = [j for j in range(k) if j != mate]
            gaps = [np.linalg.norm(path - centres[j], axis=1).min() - 1.02 * (size[k] + size[j]) for j in others]
            gap = min([*gaps, 0.2]) - 0.5 * max(np.abs(path[:, :2]).max() - plan.extent - 0.2, 0.0)
            if gap > best_gap:
                best, best_gap = path, gap
            if gap >= 0.0:
                break
        centres[k] = best
        turns[k] = turns[mate] if mate is not None else rng.normal() * (0.0 if k in still else 2.0) * times
    if plan.leaving:
        away = (times > 1 / 3) & (times < 2 / 3)
        centres[-1, away, 0] += 50.0
    return centres, turns


def displaced(scene: Scene, error_px: float, model: str, rng: np.random.Generator) -> np.ndarray:
    """Positions with errors that are constant or vary over time. [N, T, 3]

    Args:
        scene: The scene.
        error_px: Standard deviation of each error along each axis, pixels in the middle of the scene.
        model: ``drift``: a fixed offset of each Gaussian, and beside it a smooth drift of each object over time (the
            floor has none); ``jitter``: no error here, `observe` adds it anew for each Gaussian and image.
        rng: Source of the draws.
    """
    if model == "jitter" or not error_px:
        return scene.paths
    sigma = error_px * scene.pixel
    fixed = rng.normal(size=(len(scene.paths), 1, 3)) * sigma
    times = scene.paths.shape[1]
    knots = rng.normal(size=(scene.objects.max() + 1, 5, 3))
    knots[0] = 0.0
    at = np.linspace(0, 4, times) if times > 1 else np.zeros(1)
    low = np.minimum(at.astype(int), 3)
    part = (at - low)[None, :, None]
    drift = knots[:, low] * (1 - part) + knots[:, low + 1] * part
    drift *= sigma / np.sqrt((1 - part) ** 2 + part**2)  # as large between the knots as at them
    return scene.paths + fixed + drift[scene.objects]


def observe(scene: Scene, error_px: float, model: str, seed: int) -> Iterator[Image]:
    """All images in the order of views, then times; arguments as of `displaced`."""
    rng = np.random.default_rng(seed)
    paths = displaced(scene, error_px, model, rng)
    for view, t in _moments(scene.plan):
        image = _draw(scene, scene.paths[:, t], view, t)
        if error_px:
            places = paths[:, t]
            if model == "jitter":
                places = places + rng.normal(size=places.shape) * error_px * scene.pixel
            image = replace(_draw(scene, places, view, t), truth=image.truth)
        yield image


def _moments(plan: SceneSettings) -> list[tuple[int, int]]:
    return [(view, t) for view in range(plan.views) for t in range(plan.times)]


def _draw(scene: Scene, places: np.ndarray, view: int, time: int) -> Image:
    plan = scene.plan
    turn = 2 * np.pi * view / plan.views + plan.sweep_rad * time / max(plan.times - 1, 1)
    height = (0.45, 0.7)[view % 2]  # angle above the floor
    back = np.array([np.cos(turn) * np.cos(height), np.sin(turn) * np.cos(height), np.sin(height)])
    right = np.array([-np.sin(turn), np.cos(turn), 0.0])
    down = np.cross(-back, right)
    p_cam = places @ np.stack([right, down, -back], axis=1)
    depth = p_cam[:, 2] + DISTANCE
    visible = depth > 0.1
    scale = scene.focal / np.where(visible, depth, 1.0)
    xy = p_cam[:, :2] * scale[:, None] + plan.pixels / 2
    order = np.argsort(depth, kind="stable")
    order = order[visible[order]]
    truth, indices, weights = _splat(
        xy[order], np.maximum(scene.sigmas * scale, 0.45)[order], order, scene.objects, plan.pixels
    )
    return Image(view, time, truth, indices, weights)


@numba.njit(cache=True)
def _splat(xy, sigmas, order, objects, size):
    """Blend front to back. Returns the object and the Gaussians with the largest weights of each pixel."""
    pixels = size * size
    left = np.ones(pixels)
    shares = np.zeros((pixels, objects.max() + 1))
    indices = np.full((pixels, KEPT), -1, np.int32)
    weights = np.zeros((pixels, KEPT), np.float32)
    for row in range(len(order)):
        x, y, sigma, index = xy[row, 0], xy[row, 1], sigmas[row], order[row]
        reach = 2.5 * sigma
        for i in range(max(int(y - reach), 0), min(int(y + reach) + 1, size)):
            for j in range(max(int(x - reach), 0), min(int(x + reach) + 1, size)):
                distance = ((j + 0.5 - x) ** 2 + (i + 0.5 - y) ** 2) / (sigma * sigma)
                if distance > 6.25:
                    continue
                p = i * size + j
                weight = OPACITY * np.exp(-0.5 * distance) * left[p]
                left[p] -= weight
                shares[p, objects[index]] += weight
                at = KEPT
                while at > 0 and weights[p, at - 1] < weight:
                    at -= 1
                if at < KEPT:
                    for last in range(KEPT - 1, at, -1):
                        weights[p, last] = weights[p, last - 1]
                        indices[p, last] = indices[p, last - 1]
                    weights[p, at] = weight
                    indices[p, at] = index
    truth = np.zeros(pixels, np.int32)
    for p in range(pixels):
        truth[p] = np.argmax(shares[p])
    return truth, indices, weights
