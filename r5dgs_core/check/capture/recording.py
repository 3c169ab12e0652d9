"""One camera's images in temporal order, reduced and measured."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from ...data.views import View
from ...prepare import motion_tracks

LEAST = 8  # minimum number of images of a camera for rules about time


@dataclass(frozen=True)
class Recording:
    """Images of one static camera.

    Attributes:
        views: Its views, by time.
        stack: Reduced images. [F, h, w, 3] uint8
        edges: Mean gradient of the full image in each reduced pixel, levels per pixel. [F, h, w] float16
        step: Full pixels per reduced pixel.
    """

    views: tuple[View, ...]
    stack: np.ndarray
    edges: np.ndarray
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


def measure(views: Sequence[View], pictures: Sequence[np.ndarray]) -> Recording:
    """Return the recording of a camera.

    Args:
        views: Its views, by time.
        pictures: Their reduced images and edges, as from `reduce`.
    """
    stack, edges = zip(*pictures, strict=True)
    return Recording(tuple(views), np.stack(stack), np.stack(edges), motion_tracks.step_of(views[0].camera.width))


def reduce(color: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the reduced image [h, w, 3] uint8 and its edges [h, w] float16 of an image [H, W, 3] uint8."""
    step = motion_tracks.step_of(color.shape[1])
    gray = color.mean(2, dtype=np.float32)
    slope = np.zeros_like(gray)
    slope[:, 1:] = np.abs(np.diff(gray, axis=1))
    slope[1:] = np.maximum(slope[1:], np.abs(np.diff(gray, axis=0)))
    height, width = gray.shape[0] // step, gray.shape[1] // step
    cells = slope[: height * step, : width * step].reshape(height, step, width, step)
    return motion_tracks.reduce(color, step), cells.max(axis=(1, 3)).astype(np.float16)
