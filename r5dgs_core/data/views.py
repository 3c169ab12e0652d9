"""Views of a data set: images with camera, time and mask."""

from __future__ import annotations

import glob
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from .. import errors, findings
from ..scene import camera_correction, cameras
from . import images, masks, transforms
from .layouts.raw_dataset import RawDataset
from .splits import SPLITS


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
        correction: Correction of the calibrated camera that ``camera`` and ``t`` contain, or None. The image is loaded
            in the scene's colours.
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
    correction: camera_correction.Correction | None = None


def make_views(
    raw: RawDataset, mask_folders: dict[str, Path | None], origin: np.ndarray, guard: findings.Guard
) -> dict[str, tuple[View, ...]]:
    """Look up images and masks of the frames, and name their cameras.

    Args:
        raw: Frames of each split, positions relative to ``origin``.
        mask_folders: Folder of the masks of each split, or None.
        origin: Point of the files' world that positions are relative to. [3]
        guard: Entered around each frame.

    Raises:
        DatasetError: An image is missing, unreadable or listed twice, or a camera is invalid.
    """
    rounding = float(np.spacing(np.abs(origin).max()))
    names = _CameraNames([entry for split in SPLITS for entry in raw.entries[split]], rounding)
    return {split: _views_of(split, raw, mask_folders[split], names, guard) for split in SPLITS}


def _views_of(
    split: str, raw: RawDataset, mask_folder: Path | None, names: _CameraNames, guard: findings.Guard
) -> tuple[View, ...]:
    views: dict[str, View] = {}
    for entry in raw.entries[split]:
        with guard():
            name = transforms.view_name(entry.file_path)
            if name in views:
                raise errors.DatasetError(
                    f"{entry.place}: the image is listed twice; each frame needs its own", code="D13"
                )
            transforms.check_undistorted(entry, raw.image_root)
            image_path = _find_image(raw.image_root, entry)
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
    try:
        for candidate in candidates:
            if candidate.is_file():
                return candidate
        siblings = sorted(path.parent.glob(f"{glob.escape(path.name)}.*"))
        present = [file for file in (path, *siblings) if file.is_file()]
    except OSError as error:  # for example a name that is too long
        raise errors.DatasetError(f"{entry.place}: the image cannot be read: {error.strerror}", code="D10") from error
    if present:
        raise images.unreadable_kind(present[0], entry.place)
    raise errors.DatasetError(f"{entry.place}: the image is missing, expected {candidates[0]}", code="D10")


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
