"""The images of a data set as videos: what one camera saw, in the order of time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..data import dataset as datasets
from ..data import images

STEP_DEG = 15.0  # a camera that turns further between two images begins another video
STEP = 0.3  # and one that goes further, as a share of its distance from what all cameras look at


@dataclass(frozen=True)
class Video:
    """Images in the order of time, all of one size.

    Attributes:
        name: Name of the camera, or a made one.
        views: Its images.
    """

    name: str
    views: tuple[datasets.View, ...]

    def image(self, index: int) -> np.ndarray:
        """One image as RGB. [H, W, 3] uint8"""
        return images.to_uint8(datasets.load_image(self.views[index]))


def of(views: Sequence[datasets.View]) -> list[Video]:
    """Sort views into videos.

    Images of one named or standing camera are a video. Where every image has a camera of its own, as those of one
    camera in motion do, images that follow each other in time are one as long as the camera hardly moves in between.

    Args:
        views: The views.

    Returns:
        The videos by first appearance; each view is in one of them.
    """
    groups: dict[tuple, list[datasets.View]] = {}
    for view in views:
        name = view.camera.name.split("@")[0]  # name@1, name@2, ... are one camera in motion
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
    """Videos of images that follow each other in time and place."""
    centers = np.array([view.camera.center for view in views])
    axes = np.array([view.camera.T_cam_world[2, :3] for view in views])
    # The point that is nearest to all optical axes; the least norm where they are parallel.
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
    """Whether two images may follow each other in a video."""
    a, b = one.camera, other.camera
    if (a.width, a.height) != (b.width, b.height):
        return False
    turn = a.T_cam_world[:3, :3] @ b.T_cam_world[:3, :3].T
    angle = np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1)))
    reach = min(np.linalg.norm(a.center - focus), np.linalg.norm(b.center - focus))
    return bool(angle <= STEP_DEG and np.linalg.norm(a.center - b.center) <= STEP * reach)
