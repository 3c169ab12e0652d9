"""Training views in memory: normalised camera, time, 8-bit image and mask."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..config.config import Config
from ..data import dataset as datasets
from ..errors import DatasetError
from ..scene.cameras import Camera
from ..scene.sampling import spread
from .normalization import Normalization


@dataclass(frozen=True)
class TrainView:
    """Image of the training split.

    Attributes:
        name: Name in the data set.
        camera: Camera in normalised coordinates.
        t: Scene time.
        image: sRGB. [H, W, 3] uint8
        mask: Object ids, or None. [H, W] uint8 if they fit, else uint16
        alpha: Opacity of the pixels; None if the image has no alpha. [H, W] uint8
    """

    name: str
    camera: Camera
    t: float
    image: np.ndarray
    mask: np.ndarray | None
    alpha: np.ndarray | None


def load(dataset: datasets.Dataset, normalization: Normalization, background: np.ndarray | None) -> list[TrainView]:
    """Load the training split.

    Args:
        dataset: The data set.
        normalization: World coordinates to training coordinates.
        background: Colour behind transparent pixels; None if images are opaque. [3]

    Raises:
        DatasetError: There is no training view.
    """
    if not dataset.train:
        raise DatasetError(f"{dataset.root}: expected training views, found none")
    views = []
    for view in dataset.train:
        alpha = None
        if dataset.has_alpha:
            rgba = datasets.load_rgba(view)
            alpha = np.round(rgba[..., 3] * 255).astype(np.uint8)
        image = np.round(datasets.load_image(view, background) * 255).astype(np.uint8)
        camera = normalization.camera(view.camera)
        mask = datasets.load_mask(view)
        small = None if mask is None else np.clip(mask, 0, 65535).astype(np.uint8 if mask.max() < 256 else np.uint16)
        views.append(TrainView(view.name, camera, view.t, image, small, alpha))
    return views


def behind(dataset: datasets.Dataset, config: Config) -> np.ndarray | None:
    """Return the colour behind transparent pixels; None if the run learns its background. [3]"""
    kind = config.train.background
    if kind == "auto":
        kind = "white" if dataset.has_alpha else "learned"
    return {"learned": None, "white": np.ones(3), "black": np.zeros(3)}[kind]


def with_masks(views: Sequence[TrainView], masks: Sequence[np.ndarray]) -> list[TrainView]:
    """Return the views with other masks. Each [H, W]"""
    return [dataclasses.replace(view, mask=mask) for view, mask in zip(views, masks, strict=True)]


def nearest_knot(times: np.ndarray, t: float) -> int:
    """Return the index of the observed time [S] nearest to ``t``."""
    return int(np.argmin(np.abs(times - t)))


def by_camera(views: Sequence[TrainView], limit: int | None = None) -> list[list[TrainView]]:
    """Group views by camera (pose, lens and size); ``limit`` cameras spread evenly if there are more."""
    groups: dict[bytes, list[TrainView]] = {}
    for view in views:
        groups.setdefault(camera_key(view.camera), []).append(view)
    return spread(list(groups.values()), len(groups) if limit is None else limit)


def camera_key(camera: Camera) -> bytes:
    """Return a key that is equal for cameras of the same pose, lens and image size."""
    size = np.array([camera.width, camera.height])
    return np.round(camera.T_cam_world, 5).tobytes() + np.round(camera.intrinsics, 3).tobytes() + size.tobytes()
