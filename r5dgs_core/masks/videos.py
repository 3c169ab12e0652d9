"""Grouping of a data set's images into videos: the images of one camera in temporal order."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..data import dataset as datasets
from ..data import images

STEP_DEG = 15.0  # maximum turn of a camera between two images of a video, degrees
STEP = 0.3  # maximum step of a camera between them, as a share of its distance from the common focus


@dataclass(frozen=True)
class Video:
    """Images of one size in temporal order.

    Attributes:
        name: Name of the camera, or a generated one.
        views: Its images.
    """

    name: str
    views: tuple[datasets.View, ...]

    def image(self, index: int) -> np.ndarray:
        """Load one image as RGB. [H, W, 3] uint8"""
        return images.to_uint8(datasets.load_image(self.views[index]))


def of(views: Sequence[datasets.View]) -> list[Video]:
    """Group views into videos.

    The images of a named or static camera form a video. If every image has its own camera, as with one moving camera,
    consecutive images form a video as long as the camera moves little between them.

    Returns:
        The videos by first appearance; each view is in exactly one.
    """
    groups: dict[tuple, list[datasets.View]] = {}
    for view in views:
        name = view.camera.name.split("@")[0]  # name@1, name@2, ... are one moving camera
        groups.setdefault((name, view.camera.width, view.camera.height), []).append(view)
    if len(groups) == len(views) > 1:
        return _chained(views)
    taken: set[str] = set()
    videos = []
    for (name, width, height), some in groups.items():
        own = name if name not in taken else f"{name} {width}x{height}"
        taken.add(own)
        videos.append(Video(own, tuple(sorted(some, key=_order))))
    return videos


def _order(view: datasets.View) -> tuple[float, str]:
    return view.t, view.name


def _chained(views: Sequence[datasets.View]) -> list[Video]:
    """Split images by time and place into videos of a moving camera."""
    centers = np.array([view.camera.center for view in views])
    axes = np.array([view.camera.T_cam_world[2, :3] for view in views])
    # The point nearest to all optical axes; the minimum-norm solution if they are parallel.
    projectors = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    focus = np.linalg.lstsq(projectors.sum(0), np.einsum("vij,vj->i", projectors, centers), rcond=None)[0]
    chains: list[list[datasets.View]] = []
    for view in sorted(views, key=_order):
        last = chains[-1][-1] if chains else None
        if last is None or not _near(last, view, focus):
            chains.append([])
        chains[-1].append(view)
    return [Video(f"video{k}", tuple(chain)) for k, chain in enumerate(chains)]


def _near(one: datasets.View, other: datasets.View, focus: np.ndarray) -> bool:
    """Return True if two images can be consecutive in a video."""
    a, b = one.camera, other.camera
    if (a.width, a.height) != (b.width, b.height):
        return False
    turn = a.T_cam_world[:3, :3] @ b.T_cam_world[:3, :3].T
    angle = np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1)))
    reach = min(np.linalg.norm(a.center - focus), np.linalg.norm(b.center - focus))
    return bool(angle <= STEP_DEG and np.linalg.norm(a.center - b.center) <= STEP * reach)
