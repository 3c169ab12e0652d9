"""Training views: normalised camera, time, 8-bit image and mask, which are read when they are used."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from ..config.config import Config
from ..data import array_cache
from ..data import dataset as datasets
from ..data.array_cache import ArrayCache, CachedArray
from ..errors import DatasetError
from ..scene.cameras import Camera
from ..scene.sampling import spread
from .normalization import Normalization

IMAGE, MASK, ALPHA = "load_image", "load_mask", "load_alpha"
MAX_SAMPLE = 1000  # maximum number of views for statistics of all images


@dataclass(frozen=True)
class TrainView:
    """Image of the training split.

    The pixels are read from the files when they are used, and may be read several times; only a bounded cache holds
    them. A list of views therefore needs no memory for images, but a list of their images does.

    Attributes:
        name: Name in the data set.
        camera: Camera in normalised coordinates.
        t: Scene time.
        load_image: Returns the image. [H, W, 3] uint8
        load_mask: Returns the object ids; None without a mask. [H, W] uint8 if they fit, else uint16
        load_alpha: Returns the opacity of the pixels; None if the image has no alpha. [H, W] uint8
        load_unexplained: Returns the region that is left out of training; None without one. [H, W] bool
    """

    name: str
    camera: Camera
    t: float
    load_image: Callable[[], np.ndarray]
    load_mask: Callable[[], np.ndarray] | None = None
    load_alpha: Callable[[], np.ndarray] | None = None
    load_unexplained: Callable[[], np.ndarray] | None = None

    @property
    def image(self) -> np.ndarray:
        """Image, sRGB. [H, W, 3] uint8"""
        return self.load_image()

    @property
    def mask(self) -> np.ndarray | None:
        """Object ids, or None. [H, W]"""
        return None if self.load_mask is None else self.load_mask()

    @property
    def alpha(self) -> np.ndarray | None:
        """Opacity of the pixels, or None. [H, W] uint8"""
        return None if self.load_alpha is None else self.load_alpha()

    @property
    def unexplained(self) -> np.ndarray | None:
        """Mask of the pixels that are left out of training (`unexplained_views`), or None. [H, W] bool"""
        return None if self.load_unexplained is None else self.load_unexplained()

    @property
    def has_mask(self) -> bool:
        """True if the view has a mask; does not read it."""
        return self.load_mask is not None

    def with_arrays(
        self, image: np.ndarray | None = None, mask: np.ndarray | None = None, alpha: np.ndarray | None = None
    ) -> TrainView:
        """Return the view with other pixels, held in memory; those of None stay the same."""
        given = {IMAGE: image, MASK: mask, ALPHA: alpha}
        return dataclasses.replace(self, **{k: _constant(v) for k, v in given.items() if v is not None})

    def with_image_function(self, name: str, change: Callable[[np.ndarray], np.ndarray]) -> TrainView:
        """Return the view with a function of its image, which is called when the image is used.

        Args:
            name: Name of the function, different from that of other functions of this view.
            change: The function. [H, W, 3] -> [H, W, 3] uint8
        """
        source = self.load_image
        if isinstance(source, CachedArray):
            return dataclasses.replace(self, load_image=source.derived(name, change))
        return self.with_arrays(image=change(source()))


def of_arrays(
    name: str,
    camera: Camera,
    t: float,
    image: np.ndarray,
    mask: np.ndarray | None = None,
    alpha: np.ndarray | None = None,
) -> TrainView:
    """Return a view whose pixels are in memory. Arguments as the properties of `TrainView`."""
    return TrainView(name, camera, t, _constant(image)).with_arrays(mask=mask, alpha=alpha)


def _constant(array: np.ndarray) -> Callable[[], np.ndarray]:
    return lambda: array


def load(
    dataset: datasets.Dataset,
    normalization: Normalization,
    background: np.ndarray | None,
    memory: float = math.inf,
) -> list[TrainView]:
    """Load the training split, and check that all images and masks can be read.

    Args:
        dataset: The data set.
        normalization: World coordinates to training coordinates.
        background: Colour behind transparent pixels; None if images are opaque. [3]
        memory: Maximum memory for pixels, bytes. It does not affect results.

    Raises:
        DatasetError: There is no training view, or an image or mask cannot be read.
    """
    if not dataset.train:
        raise DatasetError(f"{dataset.root}: expected training views, found none")
    cache = ArrayCache(memory)
    views = []
    for index, view in enumerate(dataset.train):

        def stored(part: str, read: Callable[[], np.ndarray], index: int = index) -> CachedArray:
            return CachedArray(cache, (part, index), read)

        image = stored(IMAGE, functools.partial(datasets.load_image_8bit, view, background))
        mask = None if view.mask_path is None else stored(MASK, functools.partial(_read_mask, view))
        alpha = stored(ALPHA, functools.partial(_read_alpha, view)) if dataset.has_alpha else None
        views.append(TrainView(view.name, normalization.camera(view.camera), view.t, image, mask, alpha))
    for view in in_turn(views, IMAGE, MASK):
        _ = view.image, view.mask
    return views


def _read_mask(view: datasets.View) -> np.ndarray:
    """Return the object ids of a view with a mask. [H, W] uint8 if they fit, else uint16"""
    mask = datasets.load_mask(view)
    assert mask is not None
    return np.clip(mask, 0, 65535).astype(np.uint8 if mask.max() < 256 else np.uint16)


def _read_alpha(view: datasets.View) -> np.ndarray:
    """Return the opacity of a view's pixels. [H, W] uint8"""
    return np.round(datasets.load_rgba(view)[..., 3] * 255).astype(np.uint8)


def in_turn(views: Sequence[TrainView], *parts: str) -> Iterator[TrainView]:
    """Yield the views, while ``parts`` (`IMAGE`, `MASK`, `ALPHA`) of the next ones are read in the background."""
    for k, view in enumerate(views):
        expect(views[k + 1 : k + 1 + array_cache.AHEAD], *parts)
        yield view


def expect(views: Sequence[TrainView], *parts: str) -> None:
    """Begin to read parts of views in the background."""
    for view in views:
        for part in parts:
            source = getattr(view, part)
            if isinstance(source, CachedArray):
                source.expect()


def lent(views: Sequence[TrainView], nbytes: float) -> contextlib.AbstractContextManager[None]:
    """Return a context in which ``nbytes`` of the memory for pixels serve other things."""
    source = views[0].load_image
    return source.cache.lent(nbytes) if isinstance(source, CachedArray) else contextlib.nullcontext()


def forget(views: Sequence[TrainView]) -> None:
    """Drop all pixels that are in memory; they are read again when they are used."""
    for view in views:
        if isinstance(view.load_image, CachedArray):
            view.load_image.cache.clear()


def behind(dataset: datasets.Dataset, config: Config) -> np.ndarray | None:
    """Return the colour behind transparent pixels; None if the run learns its background. [3]"""
    kind = config.train.background
    if kind == "auto":
        kind = "white" if dataset.has_alpha else "learned"
    return {"learned": None, "white": np.ones(3), "black": np.zeros(3)}[kind]


def with_masks(views: Sequence[TrainView], masks: Sequence[np.ndarray]) -> list[TrainView]:
    """Return the views with other masks, which are taken from the sequence when they are used. Each [H, W]"""
    if len(masks) != len(views):
        raise ValueError(f"expected a mask for each of {len(views)} views, got {len(masks)}")
    sources = (functools.partial(masks.__getitem__, index) for index in range(len(views)))
    return [dataclasses.replace(view, load_mask=source) for view, source in zip(views, sources, strict=True)]


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
