"""Frames, times and splits of a data set with a COLMAP reconstruction (`layouts.colmap` describes its files)."""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .. import errors, findings, input_paths, strict_json
from ..scene import cameras
from . import colmap_model, file_kinds, images, transforms
from .colmap_model import Registered
from .layouts.raw_dataset import RawDataset
from .transforms import Entry

HELD_OUT = 8  # every eighth camera is held out, as in 3D Gaussian Splatting
IMAGES = "images"
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class _Frame:
    """An image with the registered image that gives its pose, its camera and its time."""

    name: str
    pose: Registered
    camera: str
    t: float = 0.0


def read(root: Path, sparse: Path, min_registered: float, guard: findings.Guard) -> RawDataset:
    """Read the data set of a reconstruction in ``sparse``; see `layouts.colmap.read`."""
    if not (root / IMAGES).is_dir():
        raise errors.DatasetError(f"{root / IMAGES}: expected the folder of the images, found none", code="D14")
    with findings.coded("D14"):
        model = colmap_model.read(sparse)
        for image in model.images:
            if image.lens.model not in colmap_model.PINHOLES:
                raise errors.DatasetError(
                    f"{image.lens.place}: expected the lens SIMPLE_PINHOLE or PINHOLE, found {image.lens.model}, which "
                    f"is distorted. Remedy: {input_paths.prepare_command(root)}"
                )
    path = root / "times.json"
    header: dict[str, Any] = {"world_convention": "colmap"}
    if path.exists():
        with findings.coded("D16"):
            times, more = read_times(path)
        header |= more
        frames = _timed(root, model.images, times, path, guard)
    else:
        frames, numbers = _videos(root, model.images, guard)
        if numbers:
            header["frames_per_unit"] = float(numbers)
        frames = frames or [_Frame(image.name, image, _stem(image.name)) for image in model.images]
        with guard():
            _check_registered(root, frames, model.images, min_registered, guard)
    splits = _split(frames, header.get("t_max", math.inf))
    entries = {
        split: [_entry(sparse, frame) for frame in sorted(part, key=lambda frame: (frame.t, frame.name))]
        for split, part in splits.items()
    }
    files = (*model.files, path) if path.exists() else model.files
    return RawDataset(entries, header, root / IMAGES, files, model.points, model.colors)


def read_times(path: Path) -> tuple[dict[str, float], dict[str, float]]:
    """Read the time of each image, and the other keys of ``times.json``."""
    content = strict_json.read(path, errors.DatasetError)
    if not isinstance(content, dict):
        raise errors.DatasetError(f"{path}: expected image names and times, found {type(content).__name__}", code="D16")
    more = {}
    times = content
    if isinstance(content.get("times"), dict):
        times = content["times"]
        given = (key for key in ("t_max", "frames_per_unit") if key in content)
        more = {key: transforms.finite(str(path), key, content[key]) for key in given}
    if not times:
        raise errors.DatasetError(f"{path}: expected image names and times, found none", code="D16")
    return {str(name).replace("\\", "/"): transforms.time_of(str(path), name, t) for name, t in times.items()}, more


def _check_registered(
    root: Path,
    frames: list[_Frame],
    registered: tuple[Registered, ...],
    min_registered: float,
    guard: findings.Guard,
) -> None:
    """Raise DatasetError if too many images have no pose, or if there are videos among them."""
    placed = {frame.name for frame in frames} | {image.name for image in registered}
    kinds = (*images.SUFFIXES, *images.UNREADABLE_SUFFIXES, *file_kinds.VIDEOS)
    present = {
        path.relative_to(root / IMAGES).as_posix()
        for path in (root / IMAGES).rglob("*")
        if path.suffix.lower() in kinds and not path.name.startswith(".") and path.is_file()
    }
    missing = sorted(present - placed)
    for name in missing:
        if name.lower().endswith(file_kinds.VIDEOS):
            with guard():
                raise images.unreadable_kind(root / IMAGES / name)
    if len(present) - len(missing) >= min_registered * len(present):
        if missing:
            _log.warning("%d of %d images have no pose and are left out: %s", len(missing), len(present), missing[0])
        return
    if all(name.lower().endswith(images.UNREADABLE_SUFFIXES) for name in missing):
        raise images.unreadable_kind(root / IMAGES / missing[0])
    accepted = 100 * (len(present) - len(missing)) // len(present) / 100
    raise errors.DatasetError(
        f"{root / IMAGES}: expected poses for most images, found {len(present) - len(missing)} of {len(present)} "
        f"registered by COLMAP ({missing[0]} is not). Remedy: match more pairs of images ('colmap exhaustive_matcher', "
        f"then 'colmap mapper'), remove the others from {IMAGES}/, or set data.min_registered to {accepted:g}",
        code="D15",
    )


def _timed(
    root: Path, registered: tuple[Registered, ...], times: dict[str, float], path: Path, guard: findings.Guard
) -> list[_Frame]:
    """Frames that ``times.json`` lists, with the pose of their image or of their static camera."""
    own = {image.name: image for image in registered}
    standing = _standing(registered)
    frames = []
    for name, t in times.items():
        with guard():
            camera = name.rpartition("/")[0]
            _check_kind(root, name, f"{path}: {name!r}")
            if name in own and not (camera in standing and _count(root, camera) > 1):
                frames.append(_Frame(name, own[name], _stem(name), t))
            elif camera in standing:
                frames.append(_Frame(name, standing[camera], camera, t))
            else:
                raise errors.DatasetError(
                    f"{path}: {name!r}: expected a registered image, or one of a camera that is registered once, found "
                    "neither; if COLMAP left it out, remove it from this file",
                    code="D16",
                )
    return frames


def _check_kind(root: Path, name: str, place: str) -> None:
    """Raise DatasetError if an image is missing or of an unsupported kind."""
    path = root / IMAGES / name
    if not path.is_file():
        raise errors.DatasetError(f"{place}: the image is missing, expected {path}", code="D10")
    if path.suffix.lower() not in images.SUFFIXES:
        raise images.unreadable_kind(path, place)


def _videos(root: Path, registered: tuple[Registered, ...], guard: findings.Guard) -> tuple[list[_Frame], int]:
    """Frames of static cameras, and the span of their frame numbers; no frames if each camera has at most one.

    Times are (number - first) / span.
    """
    found: list[tuple[str, Registered, str]] = []
    moving = False
    for camera, pose in _standing(registered).items():
        names = list(_names(root, camera))
        moving = moving or len(names) > 1
        found += [(name, pose, camera) for name in names]
    if not moving:
        return [], 0
    numbers = []
    for name, _, _ in found:
        match = re.search(r"(\d+)$", _stem(name))
        if match is None:
            raise errors.DatasetError(
                f"{root / IMAGES / name}: expected a number at the end of the frame's name, found none; give the times "
                f"in {root / 'times.json'}",
                code="D16",
            )
        numbers.append(int(match[1]))
    first, span = min(numbers), max(numbers) - min(numbers)
    used = {pose.name for _, pose, _ in found}
    for image in registered:
        if image.name not in used:
            with guard():
                _check_kind(root, image.name, f"{root / IMAGES / image.name}")
            _log.warning("%s: left out, as its time is unknown; list it in times.json", image.name)
    frames = [
        _Frame(name, pose, camera, (number - first) / max(span, 1))
        for (name, pose, camera), number in zip(found, numbers, strict=True)
    ]
    return frames, span


def _standing(registered: tuple[Registered, ...]) -> dict[str, Registered]:
    """Cameras that are registered once: a folder with one registered image, or an image named like a folder."""
    inside: dict[str, list[Registered]] = {}
    for image in registered:
        inside.setdefault(image.name.rpartition("/")[0], []).append(image)
    alone = {_stem(image.name): image for image in inside.pop("", [])}
    return {**alone, **{camera: part[0] for camera, part in inside.items() if len(part) == 1}}


def _names(root: Path, camera: str) -> Iterator[str]:
    """Yield the images in the folder of a camera."""
    place = root / IMAGES / camera
    for path in sorted(place.iterdir()) if place.is_dir() else []:
        if path.suffix.lower() in images.SUFFIXES and path.is_file() and not path.name.startswith("."):
            yield f"{camera}/{path.name}"


def _count(root: Path, camera: str) -> int:
    return sum(1 for _ in _names(root, camera))


def _split(frames: list[_Frame], t_max: float) -> dict[str, list[_Frame]]:
    """Assign frames to splits; no camera of "val" is in "train".

    Held-out cameras without frames within the times of the others are trained on. Frames of the remaining held-out
    cameras outside those times are dropped.
    """
    names = sorted({frame.camera for frame in frames})
    held = set(names[::HELD_OUT]) if len(names) >= HELD_OUT else set()
    early = [frame for frame in frames if frame.t <= t_max + 1e-9]
    if not early:
        raise errors.DatasetError(f"t_max {t_max:g} of times.json: expected images up to it, found none", code="D16")
    first, last = _span(early, held)
    held &= {frame.camera for frame in early if first <= frame.t <= last}
    first, last = _span(early, held)
    val = [frame for frame in early if frame.camera in held]
    inside = [frame for frame in val if first <= frame.t <= last]
    if len(inside) < len(val):
        _log.info(
            "%d images of held-out cameras are left out: outside the times of the others",
            len(val) - len(inside),
        )
    return {
        "train": [frame for frame in early if frame.camera not in held],
        "val": inside,
        "test": [frame for frame in frames if frame.t > t_max + 1e-9],
    }


def _span(frames: list[_Frame], held: set[str]) -> tuple[float, float]:
    """First and last time of the cameras that are not held out, with a small tolerance; (inf, -inf) without frames."""
    seen = [frame.t for frame in frames if frame.camera not in held]
    return min(seen, default=math.inf) - 1e-9, max(seen, default=-math.inf) + 1e-9


def _entry(sparse: Path, frame: _Frame) -> Entry:
    lens = frame.pose.lens
    return Entry(
        place=f"{sparse}: image {frame.name}",
        file_path=frame.name,
        t=frame.t,
        matrix=cameras.cam_world_to_opengl(frame.pose.T_cam_world),
        camera=frame.camera,
        lens={"fl_x": lens.fx, "fl_y": lens.fy, "cx": lens.cx, "cy": lens.cy, "w": lens.width, "h": lens.height},
        frame=None,
    )


def _stem(name: str) -> str:
    """Name without the suffix."""
    head, dot, _ = name.rpartition(".")
    return head if dot and "/" not in name[len(head) :] else name
