"""Data sets on disk: views with camera, time and mask, object names, and true poses if known.

Layout: ``transforms_{train,val,test}.json`` (`transforms`), images beside them, ``object_mask/<view name>.png``
(`masks`), ``objects.json`` (names of the ids), ``ground_truth.json`` (pose of every object at every time). `layouts`
has the other layouts of images and cameras, which give the same result.
"""

from __future__ import annotations

import hashlib
import logging
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from .. import errors, findings
from ..scene import cameras, units
from ..scene.units import Units
from . import frame_rate, images, masks, view_masks
from . import origin as origins
from .annotations import OBJECTS, GroundTruth, read_ground_truth, read_objects
from .layouts import registry
from .layouts.colmap import MIN_REGISTERED
from .layouts.raw_dataset import RawDataset
from .layouts.registry import CAMERAS_FILE
from .splits import SPLITS
from .view_masks import MASKS
from .views import View, make_views

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Dataset:
    """Result of `read`.

    Attributes:
        root: Folder of the data set.
        name: Name of that folder.
        train: Training views.
        val: Held-out views within the observed time.
        test: Views of later times.
        object_names: Names by object id.
        object_aliases: Aliases by object id.
        ground_truth: True poses, or None.
        world_convention: Key of ``cameras.WORLD_TO_BLENDER``.
        frames_per_unit: Blender frames per unit of scene time.
        units: Units of time and length, if known.
        has_alpha: True if images have transparent pixels (checked for three training images).
        digest: Hash of the camera files and of names, sizes and ends of the images, for provenance.
        points: Points of a reconstruction, world. [P, 3] float64 or None
        point_colors: Their colours, sRGB in [0, 1]. [P, 3] float32 or None
        mask_folder: Folder of the training views' masks; None if masks are ignored.
        own_ids: True if the folder defines its own ids, different from the data set's.
        origin: Point of the files' world that all positions are relative to; zero unless the cameras are so far from
            the files' origin that float32 would lose detail (`origin`). [3] float64
    """

    root: Path
    name: str
    train: tuple[View, ...]
    val: tuple[View, ...]
    test: tuple[View, ...]
    object_names: dict[int, str]
    object_aliases: dict[int, tuple[str, ...]]
    ground_truth: GroundTruth | None
    world_convention: str
    frames_per_unit: float
    has_alpha: bool
    digest: str
    points: np.ndarray | None = None
    point_colors: np.ndarray | None = None
    mask_folder: Path | None = None
    own_ids: bool = False
    origin: np.ndarray = field(default_factory=lambda: np.zeros(3))
    units: Units = Units()

    def views(self, split: str) -> tuple[View, ...]:
        """Return the views of "train", "val" or "test"."""
        if split not in SPLITS:
            raise ValueError(f"split must be one of {SPLITS}, got {split!r}")
        return getattr(self, split)

    @property
    def cameras(self) -> tuple[cameras.Camera, ...]:
        """Distinct cameras of all splits, by first appearance."""
        found: dict[str, cameras.Camera] = {}
        for split in SPLITS:
            for view in self.views(split):
                found.setdefault(view.camera.name, view.camera)
        return tuple(found.values())

    @property
    def times(self) -> np.ndarray:
        """Distinct times of the training views, increasing. [S]"""
        return np.unique([view.t for view in self.train])

    @property
    def t_max(self) -> float:
        """Last observed time: that of the latest training view."""
        return float(self.times[-1])

    def relative_to(self, origin: np.ndarray) -> Dataset:
        """Return the data set with positions relative to another point of the files' world [3]."""
        shift = self.origin - origin
        if not shift.any():
            return self
        splits = {
            split: tuple(replace(view, camera=cameras.translated(view.camera, shift)) for view in self.views(split))
            for split in SPLITS
        }
        return replace(
            self,
            **splits,
            ground_truth=None if self.ground_truth is None else self.ground_truth.moved(shift),
            points=None if self.points is None else self.points + shift,
            origin=np.asarray(origin, np.float64),
        )

    def require_one_numbering(self) -> None:
        """Check that the ids of the training masks are consistent.

        Raises:
            DatasetError: Ids are valid per video only, and there are several videos.
        """
        videos = sorted({view.mask_video for view in self.train if view.mask_path is not None})
        if len(videos) > 1:
            raise errors.DatasetError(
                f"{self.mask_folder}: the ids of these masks are valid per video only ({len(videos)} videos: "
                f"{', '.join(videos[:3])}{', ...' if len(videos) > 3 else ''}); an object has a different id in each. "
                f"Remedy: train with --masks none, then r5dgs associate RUN --masks {self.mask_folder}, which gives "
                "them one numbering"
            )


def read(
    root: Path,
    train_masks: str = MASKS,
    min_registered: float = MIN_REGISTERED,
    guard: findings.Guard = findings.STRICT,
) -> Dataset:
    """Read and check a data set; images and masks are inspected but not loaded.

    Args:
        root: Folder with ``transforms_train.json``, or with images and a COLMAP reconstruction (`layouts.colmap`).
        train_masks: Folder of the training views' masks, relative to ``root`` or absolute; ``none`` ignores masks.
            The other splits keep the data set's masks, which evaluation uses. An ``objects.json`` in the folder
            marks its ids as its own; the true poses, which use the data set's ids, are then ignored.
        min_registered: Minimum share of the images in ``images`` that a COLMAP reconstruction must have registered.
        guard: Entered around each frame, image and file, for callers that continue after an error (`findings`).

    Returns:
        The data set. A split without camera file is empty.

    Raises:
        DatasetError: A file is missing or invalid; the message names it and the remedy.
    """
    root = Path(root)
    with findings.coded("D01"):
        layout = registry.find(root)
    raw = layout.read(root, min_registered, guard)
    if not raw.entries["train"]:
        raise errors.DatasetError(f"{root / CAMERAS_FILE}: expected at least one frame, found none", code="D24")
    raw, origin = _near_origin(raw, root)
    folders = {split: view_masks.folder_of(root, train_masks if split == "train" else MASKS) for split in SPLITS}
    views, digest = _views(raw, root, folders, origin, guard)
    mask_folder = folders["train"]
    own_ids = mask_folder is not None and (mask_folder / OBJECTS).exists()
    names, aliases = _object_names(mask_folder if mask_folder is not None and own_ids else root, guard)
    with guard():
        _check_convention(root, raw.header)
    ground_truth = None if own_ids else _true_poses(root, origin, names, guard)  # these use the data set's own ids
    frames_per_unit = frame_rate.DEFAULT
    with guard():
        frames_per_unit = frame_rate.frames_per_unit(
            root, raw.header, [e for split in SPLITS for e in raw.entries[split]]
        )
    return Dataset(
        root=root,
        name=root.resolve().name,
        **views,
        object_names=names,
        object_aliases=aliases,
        ground_truth=ground_truth,
        world_convention=raw.header.get("world_convention", "blender"),
        frames_per_unit=frames_per_unit,
        has_alpha=_has_alpha(views["train"], guard),
        digest=digest,
        points=raw.points,
        point_colors=raw.colors,
        mask_folder=mask_folder,
        own_ids=own_ids,
        origin=origin,
        units=_units(root, raw.header, guard),
    )


def _units(root: Path, header: dict[str, Any], guard: findings.Guard) -> Units:
    """Return the units of the camera files; unknown ones after an error that the guard collects."""
    with guard():
        try:
            return units.read(header)
        except ValueError as error:
            raise errors.DatasetError(f"{root / CAMERAS_FILE}: {error}", code="D23") from error
    return Units()


def _object_names(folder: Path, guard: findings.Guard) -> tuple[dict[int, str], dict[int, tuple[str, ...]]]:
    """Return names and aliases by object id; none after an error that the guard collects."""
    with guard(), findings.coded("D20"):
        return read_objects(folder, guard)
    return {}, {}


def _true_poses(root: Path, origin: np.ndarray, names: dict[int, str], guard: findings.Guard) -> GroundTruth | None:
    """Return the true poses, if any, and add the names of their objects to ``names``."""
    found = None
    with guard(), findings.coded("D21"):
        found = read_ground_truth(root)
    if found is None:
        return None
    for object_id, name in zip(found.object_ids, found.names, strict=True):
        names.setdefault(object_id, name)
    return found.moved(-origin)


def _views(
    raw: RawDataset, root: Path, folders: dict[str, Path | None], origin: np.ndarray, guard: findings.Guard
) -> tuple[dict[str, tuple[View, ...]], str]:
    """Return the views of each split, and the digest of all files of the data set."""
    hasher = hashlib.sha256()
    for path in raw.files:
        hasher.update(path.read_bytes())
    views = view_masks.attach(make_views(raw, folders, origin, guard), folders, hasher, guard)
    for view in (view for split in SPLITS for view in views[split]):
        for file in (view.image_path, view.mask_path):
            if file is not None:
                hasher.update(_fingerprint(root, file))
    return views, hasher.hexdigest()


def _near_origin(raw: RawDataset, root: Path) -> tuple[RawDataset, np.ndarray]:
    """Measure positions from an origin near the cameras if they are far from the world's; returns that origin [3]."""
    origin = origins.find(np.stack([e.matrix[:3, 3] for split in SPLITS for e in raw.entries[split]]), str(root))
    points = None if raw.points is None else raw.points - origin
    if not origin.any():
        return replace(raw, points=points), origin
    _log.info("the cameras are far from the world's origin: positions are measured from %s", origin.tolist())
    entries = {split: [entry.moved(-origin) for entry in raw.entries[split]] for split in SPLITS}
    return replace(raw, entries=entries, points=points), origin


def _check_convention(root: Path, header: dict[str, Any]) -> None:
    convention = header.get("world_convention", "blender")
    if not isinstance(convention, str) or convention not in cameras.WORLD_TO_BLENDER:
        raise errors.DatasetError(
            f"{root / CAMERAS_FILE}: 'world_convention' must be one of {', '.join(cameras.WORLD_TO_BLENDER)}, found "
            f"{convention!r:.60}",
            code="D23",
        )


def load_rgba(view: View) -> np.ndarray:
    """Load the image of a view, straight alpha, 1 if the file has none. [H, W, 4] float32"""
    return _of_camera(view, images.to_rgba(images.read(view.image_path)))


def _of_camera(view: View, pixels: np.ndarray) -> np.ndarray:
    """Return pixels of the size that the view's image had when the data set was read."""
    if pixels.shape[:2] != (view.camera.height, view.camera.width):
        raise errors.DatasetError(
            f"{view.image_path}: the image changed: {pixels.shape[1]}x{pixels.shape[0]} now, "
            f"{view.camera.width}x{view.camera.height} when the data set was read"
        )
    return pixels


def load_image(view: View, background: np.ndarray | None = None) -> np.ndarray:
    """Load the image of a view composited on a colour (sRGB [3], white if None). [H, W, 3] float32

    The colours of a view with a correction are converted to those of the scene, and then not limited to 0 to 1.
    """
    return in_scene_colors(view, load_given_image(view, background))


def load_given_image(view: View, background: np.ndarray | None = None) -> np.ndarray:
    """Load the image of a view composited on a colour, in the colours of its camera. [H, W, 3] float32"""
    return images.composite(load_rgba(view), background)


def in_scene_colors(view: View, image: np.ndarray) -> np.ndarray:
    """Convert an image in the colours of a view's camera to those of the scene. [H, W, 3]"""
    return image if view.correction is None else view.correction.unseen(image)


def load_image_8bit(view: View, background: np.ndarray | None = None) -> np.ndarray:
    """Load `load_image` rounded to 8 bits; opaque colours of 8 bits are not converted. [H, W, 3] uint8"""
    stored = images.read_raw(view.image_path) if view.correction is None else None
    if stored is not None and stored.dtype == np.uint8:
        channels = stored.shape[2]
        if channels == 3 or (channels == 4 and (stored[..., 3] == 255).all()):
            return np.ascontiguousarray(_of_camera(view, stored)[..., :3])
    return np.round(load_image(view, background) * 255).astype(np.uint8)


def load_mask(view: View) -> np.ndarray | None:
    """Load the object ids of a view, at the size of its image; returns None without a mask.

    Returns:
        Object ids, 0 = background, `masks.UNKNOWN` for unknown pixels. [H, W] int32
    """
    if view.mask_path is None:
        return None
    ids = masks.read(view.mask_path, view.mask_colors, view.mask_unknown)
    return masks.resize(ids, view.camera.width, view.camera.height, str(view.mask_path))


def _has_alpha(views: tuple[View, ...], guard: findings.Guard) -> bool:
    with guard():
        for view in {views[0].name: views[0], "middle": views[len(views) // 2], "last": views[-1]}.values():
            channels = images.size(view.image_path)[2]
            if channels in (2, 4) and float(images.read(view.image_path)[..., -1].min()) < 1.0:
                return True
    return False


def _fingerprint(root: Path, path: Path) -> bytes:
    """Relative name, size, first and last 4 KB of a file."""
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(4096)
        file.seek(max(size - 4096, 0))
        tail = file.read(4096)
    name = path.relative_to(root).as_posix() if path.is_relative_to(root) else path.name
    return b"\0".join([name.encode(), str(size).encode(), head, tail])
