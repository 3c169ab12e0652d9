"""Faults of a data set: errors of the reader, damaged images and masks, and likely mistakes."""

from __future__ import annotations

import hashlib
import shutil
from collections import defaultdict
from pathlib import Path

import numpy as np

from ..data import colmap_dataset, dataset, images, masks
from ..data.dataset import Dataset, View
from ..data.layouts import camera_files, colmap
from ..findings import Collector, Finding, coded
from ..prepare import capture_file, motion_tracks
from ..terminal import printable
from .capture import agreement, arrangement, over_time, recording, timing
from .capture.pictures import Album
from .codes import CODES

MIN_CAMERAS, MIN_IMAGES = 3, 3
MIN_SPACE = 1 << 30  # bytes
_PARALLEL = 1e-6  # minimum eigenvalue per camera; below it, all optical axes are parallel
_LISTED = 5  # names per finding
_OF_ALL_TRAINING_IMAGES = {"D41", "D42", "D43", "D47"}


def check(
    root: Path,
    train_masks: str = dataset.MASKS,
    min_registered: float = colmap.MIN_REGISTERED,
    pictures: Path | None = None,
) -> list[Finding]:
    """Return all faults of a data set folder.

    Args:
        root: The folder.
        train_masks, min_registered: As for `dataset.read`.
        pictures: Folder for pictures of faults of the capture; None to draw none.
    """
    collect = Collector(CODES, "D00")
    found: Dataset | None = None
    with collect():
        found = dataset.read(root, train_masks, min_registered, collect)
    cameras_file = str(root / dataset.CAMERAS_FILE)
    faulty = {finding.code for finding in collect.findings if finding.place == cameras_file}
    if faulty - {"D24"}:  # the frames are missing because they have faults
        collect.findings = [finding for finding in collect.findings if finding.code != "D24"]
    if shutil.disk_usage(root).free < MIN_SPACE:
        collect.add("D53", f"{root}: expected at least 1 GB of free disk space, found less")
    if found is None:
        return collect.findings
    _check_splits(found, collect)
    if not found.train:  # all frames have faults, and nothing can be compared with them
        return collect.findings
    _check_times(found, collect)
    _check_cameras(found, collect)
    if faulty:  # rules that compare with the whole training split
        collect.findings = [finding for finding in collect.findings if finding.code not in _OF_ALL_TRAINING_IMAGES]
    _check_names(found, collect)
    album = Album(pictures)
    arrangement.check(found, collect, album)
    _check_images(found, collect, album)
    _check_masks(found, collect, album)
    return collect.findings


def _views(found: Dataset) -> list[View]:
    return [view for split in dataset.SPLITS for view in found.views(split)]


def _some(names: list[str]) -> str:
    listed = ", ".join(map(printable, names[:_LISTED]))
    return listed if len(names) <= _LISTED else f"{listed} and {len(names) - _LISTED} more"


def _check_splits(found: Dataset, collect: Collector) -> None:
    splits: dict[Path, set[str]] = defaultdict(set)
    for view in _views(found):
        splits[view.image_path].add(view.split)
    for path, names in splits.items():
        if len(names) > 1:
            collect.add("D40", f"{path}: expected in one split, found in {' and '.join(sorted(names))}")
    folder = found.root / colmap_dataset.IMAGES
    if not camera_files.detect(found.root):
        kinds = (*images.SUFFIXES, *images.UNREADABLE_SUFFIXES)
        present = {path for path in folder.rglob("*") if path.suffix.lower() in kinds}
        left_out = sorted(path.relative_to(folder).as_posix() for path in present - set(splits))
        if left_out:
            collect.add("D54", f"{folder}: {len(left_out)} of {len(present)} images are not used: {_some(left_out)}")


def _check_times(found: Dataset, collect: Collector) -> None:
    first, last = float(found.times[0]), found.t_max
    if first == last:
        collect.add("D43", f"{found.root}: all training images have the time {first:g}")
    for view in found.val:
        if not first <= view.t <= last:
            collect.add("D41", f"{view.image_path}: time {view.t:g}, expected {first:g} to {last:g}")
    for view in found.test:
        if view.t <= last:
            collect.add("D42", f"{view.image_path}: time {view.t:g}, expected later than {last:g}")
    for split in dataset.SPLITS:
        path = found.root / f"transforms_{split}.json"
        if path.exists() and b'"time"' not in path.read_bytes():
            collect.add("D44", f"{path}: no frame has a 'time'")
        times = defaultdict(list)
        for view in found.views(split):
            times[view.camera.name].append(view.t)
        unsorted = [camera for camera, t in times.items() if (np.diff(t) < 0).any()]
        if unsorted:
            collect.add("D45", f"{path}: times go back within the frames of {_some(unsorted)}")


def _check_cameras(found: Dataset, collect: Collector) -> None:
    cameras = list({view.camera.name: view.camera for view in found.train}.values())
    if len(cameras) < MIN_CAMERAS or len(found.train) < MIN_IMAGES:
        collect.add(
            "D47",
            f"{found.root}: expected at least {MIN_CAMERAS} places of cameras and {MIN_IMAGES} training images, "
            f"found {len(cameras)} and {len(found.train)}",
        )
    if len(cameras) < 2:
        return
    centers = np.stack([camera.center for camera in cameras])
    axes = np.stack([camera.T_cam_world[2, :3] for camera in cameras])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    total = across.sum(0)
    if np.linalg.eigvalsh(total)[0] < _PARALLEL * len(cameras):
        return
    middle = np.linalg.solve(total, (across @ centers[:, :, None])[..., 0].sum(0))  # point nearest to all optical axes
    away = [
        camera.name for camera, depth in zip(cameras, ((middle - centers) * axes).sum(-1), strict=True) if depth < 0
    ]
    if away:
        collect.add("D46", f"{found.root}: {len(away)} of {len(cameras)} cameras look away: {_some(away)}")


def _check_names(found: Dataset, collect: Collector) -> None:
    words = [view.name for view in _views(found)] + [camera.name for camera in found.cameras]
    words += [*found.object_names.values(), *(word for some in found.object_aliases.values() for word in some)]
    for word in dict.fromkeys(words):
        if not word.isprintable():
            collect.add("D52", f"{found.root}: the name {printable(word)!r} holds control characters")


def _check_images(found: Dataset, collect: Collector, album: Album) -> None:
    """Decode all images, camera by camera, and check those of a camera over time."""
    same: dict[bytes, View] = {}
    clocks = timing.Clocks(str(found.root), found.units.seconds_per_unit, collect, album)
    for views in recording.by_camera(_views(found)):
        gathered = recording.Gathered(min(len(views), motion_tracks.MOST_FRAMES))
        for view in views:
            with collect(), coded("D12"):
                color = dataset.load_image_8bit(view)
                digest = hashlib.sha256(view.image_path.read_bytes()).digest()
                other = same.setdefault(digest, view)
                if other.camera.name != view.camera.name:
                    collect.add("D51", f"{view.image_path}: the same file as {other.image_path}, from another camera")
                if not gathered.full:
                    gathered.add(view, color)
        if len(gathered.views) >= recording.LEAST:
            one = gathered.recording()
            over_time.check(one, str(found.root), found.units.seconds_per_unit, collect, album)
            clocks.add(one)
    clocks.check()
    with collect():
        clocks.check_record(capture_file.read(found.root))


def _check_masks(found: Dataset, collect: Collector, album: Album) -> None:
    without = [view.name for view in found.train if view.mask_path is None]
    if 0 < len(without) < len(found.train):
        collect.add("D48", f"{found.mask_folder}: {len(without)} training images have no mask: {_some(without)}")
    seen: dict[int, set[str]] = defaultdict(set)
    sightings: dict[int, list[agreement.Sighting]] = defaultdict(list)
    complete = True
    for view in _views(found):
        loaded = None
        with collect(), coded("D17"):
            loaded = dataset.load_mask(view)
        complete = complete and (loaded is not None or view.mask_path is None)
        if loaded is not None:
            for object_id in np.unique(loaded):
                seen[int(object_id)].add(view.name)
            for object_id, one in agreement.sightings(view, loaded).items() if view.split == "train" else ():
                sightings[object_id].append(one)
    ids = sorted(set(seen) - {0, masks.UNKNOWN})
    folder = found.mask_folder or found.root / dataset.MASKS
    unnamed = [object_id for object_id in ids if object_id not in found.object_names]
    if found.object_names and unnamed:
        collect.add("D49", f"{folder}: ids without a name: {_some([str(each) for each in unnamed])}")
    total = sum(view.mask_path is not None for view in _views(found))
    lone = [object_id for object_id in ids if len(seen[object_id]) == 1 and total > 1]
    for object_id in lone:
        collect.add("D50", f"{folder}: id {object_id} occurs in {next(iter(seen[object_id]))} alone")
    absent = [name for object_id, name in found.object_names.items() if object_id not in seen]
    if seen and complete and absent:
        collect.add("D55", f"{folder}: expected pixels of {_some(absent)}, found none")
    agreement.check(found, sightings, collect, album)
