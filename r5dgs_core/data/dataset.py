"""Data sets on disk: views with camera, time and mask, object names, and true poses if known.

Layout: ``transforms_{train,val,test}.json`` (`transforms`), images beside them, ``object_mask/<view name>.png``
(`masks`), ``objects.json`` (names of the ids), ``ground_truth.json`` (pose of every object at every time). Images with
a COLMAP reconstruction instead of camera files give the same result (`colmap`).
"""

from __future__ import annotations

import glob
import hashlib
import logging
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from .. import errors, findings, input_paths
from ..scene import cameras
from . import colmap, images, mask_notes, masks, transforms
from . import origin as origins
from .annotations import OBJECTS, GroundTruth, read_ground_truth, read_objects

SPLITS = ("train", "val", "test")
MASKS, NO_MASKS = "object_mask", "none"
FRAMES_PER_UNIT = 60.0
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class View:
    """One image of a data set.

    Attributes:
        name: Path of the image in the data set without suffix, "train/r_0000".
        camera: Its camera, OpenCV axes; ``camera.name`` is shared by the views of one camera.
        t: Scene time.
        split: "train", "val" or "test".
        image_path: The image file.
        mask_path: The object id image, or None.
        mask_colors: Object id of each packed colour, if masks are coded by colour.
        mask_unknown: Value of unknown pixels in the mask file.
        mask_video: Video within which the mask's ids are valid; "" if they are valid in the whole scene.
    """

    name: str
    camera: cameras.Camera
    t: float
    split: str
    image_path: Path
    mask_path: Path | None
    mask_colors: dict[int, int] | None = None
    mask_unknown: int = masks.UNKNOWN
    mask_video: str = ""


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
        has_alpha: True if images have transparent pixels (checked for three training images).
        digest: Hash of the camera files and of names, sizes and ends of the images, for provenance.
        points: Points of a COLMAP reconstruction, world. [P, 3] float64 or None
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
            split: tuple(replace(view, camera=cameras.moved(view.camera, shift)) for view in self.views(split))
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
    min_registered: float = colmap.MIN_REGISTERED,
    guard: findings.Guard = findings.STRICT,
) -> Dataset:
    """Read and check a data set; images and masks are inspected but not loaded.

    Args:
        root: Folder with ``transforms_train.json``, or with images and a COLMAP reconstruction (`colmap`).
        train_masks: Folder of the training views' masks, relative to ``root`` or absolute; ``none`` ignores masks.
            The other splits keep the data set's masks, as they serve evaluation. An ``objects.json`` in the folder
            marks its ids as its own; the true poses, which use the data set's ids, are then ignored.
        min_registered: Smallest share of the images in ``images`` that a COLMAP reconstruction must have registered.
        guard: Entered around each frame, image and file, for callers that continue after an error (`findings`).

    Returns:
        The data set. A split without camera file is empty.

    Raises:
        DatasetError: A file is missing or invalid; the message names it and the remedy.
    """
    root = Path(root)
    with findings.coded("D01"):
        input_paths.check_dataset(root)
    reconstruction = None
    if not (root / input_paths.CAMERAS_FILE).exists():
        reconstruction = colmap.read(root, min_registered, guard)
    entries: dict[str, list[transforms.Entry]] = {}
    header: dict[str, Any] = {}
    hasher = hashlib.sha256()
    for split in SPLITS:
        path = root / f"transforms_{split}.json"
        entries[split] = []
        if path.exists():
            with guard():
                entries[split], top = transforms.read(path, guard)
                header = {**top, **header}
            hasher.update(path.read_bytes())
    if reconstruction is not None:
        entries, header = reconstruction.entries, reconstruction.header
        for path in reconstruction.files:
            hasher.update(path.read_bytes())
    if not entries["train"]:
        raise errors.DatasetError(
            f"{root / 'transforms_train.json'}: expected at least one frame, found none", code="D24"
        )

    origin = origins.find(np.stack([e.matrix[:3, 3] for split in SPLITS for e in entries[split]]), str(root))
    if origin.any():
        entries = {split: [entry.moved(-origin) for entry in entries[split]] for split in SPLITS}
        _log.info("the cameras stand far from the world's origin: positions are measured from %s", origin.tolist())
    rounding = float(np.spacing(np.abs(origin).max()))
    camera_names = _CameraNames([entry for split in SPLITS for entry in entries[split]], rounding)
    image_root = root if reconstruction is None else root / colmap.IMAGES
    folders = {"train": _mask_folder(root, train_masks), "val": root / MASKS, "test": root / MASKS}
    views = {
        split: _make_views(folders[split], image_root, split, entries[split], camera_names, guard) for split in SPLITS
    }
    named = folders["train"] if folders["train"] != folders["val"] else None
    if named is not None and all(view.mask_path is None for view in views["train"]):
        raise errors.DatasetError(
            f"{named}: expected masks such as {views['train'][0].name}.png, found none. Remedy: import masks of "
            "another layout with 'r5dgs masks --from', or train without masks: --masks none",
            code="D17",
        )
    for folder in dict.fromkeys(folders.values()):
        alike = {split: views[split] for split in SPLITS if folders[split] == folder}
        with guard(), findings.coded("D17"):
            alike = _attach_mask_colors(alike)
        with guard(), findings.coded("D22"):
            alike = _attach_notes(alike, folder, hasher)
        views |= alike
    every = [view for split in SPLITS for view in views[split]]
    for view in every:
        for file in (view.image_path, view.mask_path):
            if file is not None:
                hasher.update(_fingerprint(root, file))
    mask_folder = folders["train"]
    own_ids = mask_folder is not None and (mask_folder / OBJECTS).exists()
    names: dict[int, str] = {}
    aliases: dict[int, tuple[str, ...]] = {}
    with guard(), findings.coded("D20"):
        names, aliases = read_objects(mask_folder if mask_folder is not None and own_ids else root)
    convention = header.get("world_convention", "blender")
    with guard():
        if not isinstance(convention, str) or convention not in cameras.WORLD_TO_BLENDER:
            raise errors.DatasetError(
                f"{root / 'transforms_train.json'}: 'world_convention' must be one of "
                f"{', '.join(cameras.WORLD_TO_BLENDER)}, found {convention!r:.60}",
                code="D23",
            )
    ground_truth = None
    with guard(), findings.coded("D21"):
        if not own_ids:  # poses use the ids of the data set's own masks
            ground_truth = read_ground_truth(root)
    if ground_truth is not None:
        ground_truth = ground_truth.moved(-origin)
        for object_id, name in zip(ground_truth.object_ids, ground_truth.names, strict=True):
            names.setdefault(object_id, name)
    frames_per_unit = FRAMES_PER_UNIT
    with guard():
        frames_per_unit = _frames_per_unit(root, header, [e for split in SPLITS for e in entries[split]])
    return Dataset(
        root=root,
        name=root.resolve().name,
        train=views["train"],
        val=views["val"],
        test=views["test"],
        object_names=names,
        object_aliases=aliases,
        ground_truth=ground_truth,
        world_convention=convention,
        frames_per_unit=frames_per_unit,
        has_alpha=_has_alpha(views["train"]),
        digest=hasher.hexdigest(),
        points=None if reconstruction is None or reconstruction.points is None else reconstruction.points - origin,
        point_colors=None if reconstruction is None else reconstruction.colors,
        mask_folder=mask_folder,
        own_ids=own_ids,
        origin=origin,
    )


def load_rgba(view: View) -> np.ndarray:
    """Load the image of a view, straight alpha, 1 if the file has none. [H, W, 4] float32"""
    pixels = images.to_rgba(images.read(view.image_path))
    if pixels.shape[:2] != (view.camera.height, view.camera.width):
        raise errors.DatasetError(
            f"{view.image_path}: the image changed: {pixels.shape[1]}x{pixels.shape[0]} now, "
            f"{view.camera.width}x{view.camera.height} when the data set was read"
        )
    return pixels


def load_image(view: View, background: np.ndarray | None = None) -> np.ndarray:
    """Load the image of a view composited on a colour (sRGB [3], white if None). [H, W, 3] float32"""
    return images.composite(load_rgba(view), background)


def load_mask(view: View) -> np.ndarray | None:
    """Load the object ids of a view, at the size of its image; returns None without a mask.

    Returns:
        Object ids, 0 = background, `masks.UNKNOWN` for unknown pixels. [H, W] int32
    """
    if view.mask_path is None:
        return None
    ids = masks.read(view.mask_path, view.mask_colors, view.mask_unknown)
    return masks.resize(ids, view.camera.width, view.camera.height, str(view.mask_path))


class _CameraNames:
    """Names for distinct cameras: that of the file, or cam0, cam1, ...; poses of a moving camera get @1, @2, ...

    Cameras are equal if they agree to 1e-6 of the image width, of a radian, and of the distance between cameras, so
    neither the unit nor the origin of the world matters.

    Args:
        entries: All views of the data set; generated names differ from theirs.
        rounding: Error of the cameras' positions, world units.
    """

    def __init__(self, entries: list[transforms.Entry], rounding: float) -> None:
        centers = np.array([entry.matrix[:3, 3] for entry in entries], np.float64)
        middle = np.median(centers, axis=0)
        apart = float(np.median(np.linalg.norm(centers - middle, axis=1)))
        self.step = max(1e-6 * apart, 1e-9 * float(np.linalg.norm(middle)), 4 * rounding, 1e-300)
        self.taken = {entry.camera for entry in entries if entry.camera}
        self.by_key: dict[tuple, str] = {}
        self.uses: dict[str, int] = {}

    def name(self, given: str, camera: cameras.Camera) -> str:
        lens, turn = camera.intrinsics.ravel() / camera.width, camera.T_cam_world[:3, :3].ravel()
        numbers = np.round(np.concatenate([lens / 1e-6, turn / 1e-6, camera.center / self.step]))
        key = (given, camera.width, camera.height, (numbers + 0.0).tobytes())  # turns -0.0 into 0.0
        if key not in self.by_key:
            count = self.uses.get(given, 0)
            name = given
            while not given or count:
                name = f"{given}@{count}" if given else f"cam{count}"
                if name not in self.taken:
                    break
                count += 1
            self.uses[given] = count + 1
            self.taken.add(name)
            self.by_key[key] = name
        return self.by_key[key]


def _mask_folder(root: Path, name: str) -> Path | None:
    """Folder of the training views' masks, or None. The data set's own folder is always returned under the same path,
    because its colour-coded masks are numbered together with those of the other splits."""
    if name == NO_MASKS:
        return None
    folder = root / name  # an absolute path replaces the root
    if folder.resolve() == (root / MASKS).resolve():
        return root / MASKS
    if name != MASKS and not folder.is_dir():
        raise errors.DatasetError(
            f"{folder}: no such folder of masks; give another with --masks, or 'none'", code="D17"
        )
    return folder


def _make_views(
    mask_folder: Path | None,
    image_root: Path,
    split: str,
    entries: list[transforms.Entry],
    names: _CameraNames,
    guard: findings.Guard,
) -> tuple[View, ...]:
    views: dict[str, View] = {}
    for entry in entries:
        with guard():
            name = transforms.view_name(entry.file_path)
            if name in views:
                raise errors.DatasetError(
                    f"{entry.place}: the image is listed twice; each frame needs its own", code="D13"
                )
            image_path = _find_image(image_root, entry)
            width, height, _ = images.size(image_path)
            matrix = cameras.opengl_to_cam_world(entry.matrix)
            camera = cameras.Camera(width, height, transforms.intrinsics(entry, width, height), matrix)
            try:
                cameras.check(camera)
            except ValueError as error:
                raise errors.DatasetError(f"{entry.place}: {error}") from error
            camera = replace(camera, name=names.name(entry.camera, camera))
            mask_path = None if mask_folder is None else mask_folder / f"{name}.png"
            if mask_path is not None and not mask_path.is_file():
                mask_path = None
            views[name] = View(name, camera, entry.t, split, image_path, mask_path)
    return tuple(views.values())


def _find_image(root: Path, entry: transforms.Entry) -> Path:
    path = root / entry.file_path.replace("\\", "/")
    candidates = [path] if path.suffix.lower() in images.SUFFIXES else []
    candidates += [path.with_name(path.name + suffix) for suffix in images.SUFFIXES]
    for candidate in candidates:
        if candidate.is_file():
            return candidate
    present = [path] if path.is_file() else sorted(path.parent.glob(f"{glob.escape(path.name)}.*"))
    if present:
        raise images.unreadable_kind(present[0], entry.place)
    raise errors.DatasetError(f"{entry.place}: the image is missing, expected {candidates[0]}", code="D10")


def _attach_mask_colors(views: dict[str, tuple[View, ...]]) -> dict[str, tuple[View, ...]]:
    """Number the colours of all masks of the splits together, if masks are coded by colour."""
    paths = [view.mask_path for some in views.values() for view in some if view.mask_path is not None]
    colors = masks.color_table(paths)
    if not colors:
        return views
    _log.info("masks are coded by colour: %d colours numbered by value, black is 0", len(colors) - 1)
    return {split: tuple(replace(view, mask_colors=colors) for view in some) for split, some in views.items()}


def _attach_notes(views: dict[str, tuple[View, ...]], folder: Path | None, hasher: Any) -> dict[str, tuple[View, ...]]:
    """Apply the mask folder's ``masks.json`` to the views (`mask_notes`)."""
    if folder is None or not (folder / mask_notes.FILE).exists():
        return views
    notes = mask_notes.read(folder)
    if not notes.finished:
        _log.warning("%s: masks are missing; run the command that makes them again", folder)
    videos = notes.video_of()
    lone = "" if notes.numbering == mask_notes.SCENE else "other masks"

    def told(view: View) -> View:
        if view.mask_path is None:
            return view
        return replace(view, mask_unknown=notes.unknown, mask_video=videos.get(view.name, lone))

    hasher.update(f"{notes.numbering} {notes.unknown}".encode() * len(views))  # once per split
    return {split: tuple(map(told, some)) for split, some in views.items()}


def _frames_per_unit(root: Path, header: dict[str, Any], entries: list[transforms.Entry]) -> float:
    """Blender frames per unit of time: from the file, from frame numbers, from duration and rate, or 60."""
    hints = {}
    for key in ("frames_per_unit", "fps", "duration"):
        if header.get(key) is not None:
            value = header[key]
            if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 < value < float("inf"):
                raise errors.DatasetError(f"{root}: '{key}' must be a positive number, found {value!r}", code="D23")
            hints[key] = float(value)
    if "frames_per_unit" in hints:
        return hints["frames_per_unit"]
    numbered = [(entry.t, entry.frame) for entry in entries if entry.frame is not None]
    if len(numbered) == len(entries):
        t, frame = np.array(numbered).T
        if np.ptp(t) > 0 and np.ptp(frame) > 0:
            slope = float(np.polyfit(t, frame, 1)[0])
            if slope > 0:
                return slope
    if "fps" in hints and "duration" in hints:
        return hints["fps"] * hints["duration"]
    if "fps" in hints and max(entry.t for entry in entries) > 1.0:
        return hints["fps"]  # times are in seconds
    return FRAMES_PER_UNIT


def _has_alpha(views: tuple[View, ...]) -> bool:
    for view in {views[0].name: views[0], "middle": views[len(views) // 2], "last": views[-1]}.values():
        if images.size(view.image_path)[2] in (2, 4) and float(images.read(view.image_path)[..., -1].min()) < 1.0:
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
