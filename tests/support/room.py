"""Pictures of a textured room with exact cameras, drawn by intersecting rays with planes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from r5dgs_core.capture.calibration.lens import Lens

SIDE = 512  # texture pixels of a wall
HALF = np.array([2.0, 1.5, 2.0])  # half sizes of the room; y is down


def textures(seed: int = 0) -> np.ndarray:
    """Six walls of blobs of several sizes. [6, SIDE, SIDE, 3] float32 in 0..255"""
    rng = np.random.default_rng(seed)
    walls = np.zeros((6, SIDE, SIDE, 3), np.float32)
    for cells in (8, 16, 32, 64, 128):
        noise = rng.random((6, cells, cells, 3)).astype(np.float32)
        walls += noise.repeat(SIDE // cells, 1).repeat(SIDE // cells, 2)
    return 255 * walls / 5


def look_at(eye: Sequence[float], target: Sequence[float]) -> np.ndarray:
    """Camera to world, OpenCV axes, y down. [4, 4]"""
    pose = np.eye(4)
    forward = np.subtract(target, eye) / np.linalg.norm(np.subtract(target, eye))
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], 1)
    pose[:3, 3] = eye
    return pose


def picture(lens: Lens, size: tuple[int, int], pose: np.ndarray, walls: np.ndarray) -> np.ndarray:
    """Draw the room. [H, W, 3] uint8"""
    x, y = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5)
    rays = lens.unproject(np.stack([x, y], -1).reshape(-1, 2)) @ pose[:3, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = (np.sign(rays) * HALF - pose[:3, 3]) / rays
    axis = np.nanargmin(np.where(reach > 0, reach, np.inf), axis=1)
    rows = np.arange(len(rays))
    points = pose[:3, 3] + rays * reach[rows, axis, None]
    wall = 2 * axis + (rays[rows, axis] > 0)
    first, second = (axis + 1) % 3, (axis + 2) % 3
    u = (points[rows, first] / HALF[first] + 1) / 2 * (SIDE - 1)
    v = (points[rows, second] / HALF[second] + 1) / 2 * (SIDE - 1)
    column, row = np.clip(u.astype(int), 0, SIDE - 2), np.clip(v.astype(int), 0, SIDE - 2)
    a, b = (u - column)[:, None], (v - row)[:, None]
    colors = (1 - b) * ((1 - a) * walls[wall, row, column] + a * walls[wall, row, column + 1])
    colors += b * ((1 - a) * walls[wall, row + 1, column] + a * walls[wall, row + 1, column + 1])
    return np.rint(colors).astype(np.uint8).reshape(size[1], size[0], 3)


@dataclass(frozen=True, eq=False)
class Film:
    """A recording in memory."""

    name: str
    frames: Sequence[np.ndarray]
    times: np.ndarray

    @property
    def width(self) -> int:
        return self.frames[0].shape[1]

    @property
    def height(self) -> int:
        return self.frames[0].shape[0]

    def read(self, wanted: Sequence[int]) -> Iterator[tuple[int, np.ndarray]]:
        for index in wanted:
            yield index, self.frames[index]


def pose_errors(found: Sequence[np.ndarray], true: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Errors of camera-to-world matrices after the best similarity: positions, and angles in degrees."""
    a, b = (np.array([pose[:3, 3] for pose in poses]) for poses in (found, true))
    u, _, v = np.linalg.svd(sum(t[:3, :3] @ f[:3, :3].T for f, t in zip(found, true, strict=True)))
    turn = u @ np.diag([1, 1, np.linalg.det(u @ v)]) @ v
    moved, wanted = (a - a.mean(0)) @ turn.T, b - b.mean(0)
    scale = (moved * wanted).sum() / (moved**2).sum()
    cosine = [(np.trace((turn @ f[:3, :3]).T @ t[:3, :3]) - 1) / 2 for f, t in zip(found, true, strict=True)]
    return np.linalg.norm(scale * moved - wanted, axis=1), np.degrees(np.arccos(np.clip(cosine, -1, 1)))
