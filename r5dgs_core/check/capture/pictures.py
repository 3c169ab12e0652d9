"""Pictures of findings."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from ... import errors
from ...data import dataset as datasets
from ...data.views import View
from ...scene.cameras import Camera

DPI = 100
_GOOD, _BAD = "#3b6ea5", "#c8452d"


@dataclass(frozen=True)
class Album:
    """Folder of pictures.

    Attributes:
        folder: The folder, created with the first picture; None to draw nothing.
    """

    folder: Path | None

    def write(self, name: str, draw: Callable[[], Figure]) -> str:
        """Draw and write a picture; returns its path, or "" without a folder or if an image cannot be read."""
        if self.folder is None:
            return ""
        try:
            figure = draw()
        except errors.DatasetError:
            return ""  # damaged images are faults of their own
        self.folder.mkdir(parents=True, exist_ok=True)
        path = self.folder / (re.sub(r"[^\w.-]", "_", name) + ".png")
        FigureCanvasAgg(figure).print_png(str(path), metadata={"Software": None})
        return str(path)


def plan(cameras: Sequence[Camera], middle: np.ndarray, marked: Sequence[str]) -> Figure:
    """Draw the cameras and their views in the plane in which they are spread most."""
    centers = np.stack([camera.center for camera in cameras])
    axes = np.stack([camera.T_cam_world[2, :3] for camera in cameras])
    reach = float(np.median(np.linalg.norm(centers - middle, axis=1))) or 1.0
    spread = np.concatenate([centers - middle, axes * reach])
    plane = np.linalg.svd(spread, full_matrices=False)[2][:2]  # [2, 3]
    figure, ax = _figure(6, 6)
    for camera, center in zip(cameras, centers, strict=True):
        color = _BAD if camera.name in marked else _GOOD
        corners = np.array([[0.0, camera.height / 2], [camera.width, camera.height / 2]])
        rays = np.concatenate([corners, np.ones((2, 1))], 1) @ np.linalg.inv(camera.intrinsics).T
        ends = center + reach * rays @ camera.T_cam_world[:3, :3]
        shape = np.stack([ends[0], center, ends[1]]) @ plane.T
        ax.plot(*shape.T, color=color, lw=1)
        ax.fill(*shape.T, color=color, alpha=0.12)
        ax.annotate(camera.name, center @ plane.T, color=color)
    ax.plot(*(middle @ plane.T), "k+")
    ax.set_aspect("equal")
    ax.set_title("Cameras and their views")
    return figure


def resolution(view: View, lines: int) -> Figure:
    """Draw a crop of an image in full and in reduced resolution."""
    image = datasets.load_image(view)
    step = max(1, round(view.camera.height / lines))
    height, width = (min(240, size) // step * step for size in image.shape[:2])
    top, left = (image.shape[0] - height) // 2, (image.shape[1] - width) // 2
    crop = image[top : top + height, left : left + width]
    small = crop.reshape(height // step, step, width // step, step, 3).mean(axis=(1, 3))
    return side_by_side([(crop, f"{view.camera.height} lines"), (small, f"about {lines} lines")])


def side_by_side(panels: Sequence[tuple[np.ndarray, str]]) -> Figure:
    """Draw images with titles in a row. Each [H, W, 3] uint8 or float in [0, 1]"""
    figure = Figure(figsize=(3.6 * len(panels), 3.4), dpi=DPI, layout="constrained")
    for k, (image, title) in enumerate(panels):
        ax = figure.add_subplot(1, len(panels), k + 1)
        ax.imshow(image, interpolation="nearest")
        ax.set_title(title, fontsize=9)
        ax.axis("off")
    return figure


def curves(x: np.ndarray, rows: Sequence[tuple[str, np.ndarray]], x_label: str, y_label: str, title: str) -> Figure:
    """Draw curves over a common axis."""
    figure, ax = _figure(7, 3.5)
    for label, values in rows:
        ax.plot(x, values, label=label)
    ax.set_xlabel(x_label)
    ax.set_ylabel(y_label)
    ax.set_title(title)
    ax.legend()
    return figure


def bars(names: Sequence[str], values: Sequence[float], errors: Sequence[float], y_label: str, title: str) -> Figure:
    """Draw one bar with its uncertainty per name."""
    figure, ax = _figure(7, 3.5)
    ax.bar(range(len(names)), values, yerr=errors, color=_GOOD, capsize=4)
    ax.set_xticks(range(len(names)), names)
    ax.set_ylabel(y_label)
    ax.set_title(title)
    return figure


def outlined(view: View, object_id: int, line: np.ndarray | None = None) -> np.ndarray:
    """Return an image with the outline of an object, and optionally a line a u + b v + c = 0 [3]. [H, W, 3] uint8"""
    image = (datasets.load_image(view) * 255).astype(np.uint8)
    ids = datasets.load_mask(view)
    if ids is not None:
        inside = ids == object_id
        edge = inside.copy()
        edge[1:-1, 1:-1] &= ~(inside[:-2, 1:-1] & inside[2:, 1:-1] & inside[1:-1, :-2] & inside[1:-1, 2:])
        image[edge] = (255, 40, 200)
    if line is not None:
        v, u = np.mgrid[: image.shape[0], : image.shape[1]] + 0.5
        a, b, c = line / max(float(np.hypot(line[0], line[1])), 1e-12)
        image[np.abs(a * u + b * v + c) < 0.8] = (255, 220, 0)
    return image


def _figure(width: float, height: float):
    figure = Figure(figsize=(width, height), dpi=DPI, layout="constrained")
    return figure, figure.add_subplot()
