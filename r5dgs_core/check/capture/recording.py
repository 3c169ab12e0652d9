"""One camera's images in temporal order, reduced and measured."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from ...data.views import View
from ...prepare import motion_tracks
from ...prepare.frame_store import FrameStore

LEAST = 8  # minimum number of images of a camera for rules about time


@dataclass(frozen=True)
class Recording:
    """Images of one static camera.

    Attributes:
        views: Its views, by time.
        stack: Reduced images. [h, w, 3] uint8 each
        edges: Mean gradient of the full image in each reduced pixel, levels per pixel. [h, w] float16 each
        step: Full pixels per reduced pixel.
    """

    views: tuple[View, ...]
    stack: FrameStore
    edges: FrameStore
    step: int

    @property
    def name(self) -> str:
        """Name of the camera."""
        return self.views[0].camera.name

    @property
    def times(self) -> np.ndarray:
        """Scene times of the views. [F]"""
        return np.array([view.t for view in self.views])


def by_camera(views: Iterable[View]) -> list[tuple[View, ...]]:
    """Group views by camera, each group by time; a file that several splits list counts once."""
    groups: dict[str, dict[str, View]] = {}
    for view in views:
        groups.setdefault(view.camera.name, {}).setdefault(str(view.image_path), view)
    return [tuple(sorted(group.values(), key=lambda view: view.t)) for group in groups.values()]


class Gathered:
    """Images of a camera that are reduced one by one.

    Args:
        most: Maximum number of images.

    Attributes:
        views: Their views.
    """

    def __init__(self, most: int):
        self._most = most
        self.views: list[View] = []
        self._stack, self._edges = FrameStore(), FrameStore()

    @property
    def full(self) -> bool:
        """True if no more images can be added."""
        return len(self.views) == self._most

    def add(self, view: View, color: np.ndarray) -> None:
        """Add an image. [H, W, 3] uint8"""
        picture, edges = _reduced(color)
        self._stack.append(picture)
        self._edges.append(edges)
        self.views.append(view)

    def recording(self) -> Recording:
        """Return the images; there is at least one."""
        step = motion_tracks.step_of(self.views[0].camera.width)
        return Recording(tuple(self.views), self._stack, self._edges, step)


def _reduced(color: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the reduced image [h, w, 3] uint8 and its edges [h, w] float16 of an image [H, W, 3] uint8."""
    step = motion_tracks.step_of(color.shape[1])
    gray = color.mean(2, dtype=np.float32)
    slope = np.zeros_like(gray)
    slope[:, 1:] = np.abs(np.diff(gray, axis=1))
    slope[1:] = np.maximum(slope[1:], np.abs(np.diff(gray, axis=0)))
    height, width = gray.shape[0] // step, gray.shape[1] // step
    cells = slope[: height * step, : width * step].reshape(height, step, width, step)
    return motion_tracks.reduce(color, step), cells.max(axis=(1, 3)).astype(np.float16)
