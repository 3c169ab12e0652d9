"""Cameras of a source folder, by their files: one video per camera, chapters of a video, or a folder of frames.

    SOURCE/cam0.mp4                          a video
    SOURCE/GX010042.MP4, GX020042.MP4        chapters of one GoPro recording
    SOURCE/cam0/GX010042.MP4, ...            a camera's video or chapters in a folder of its own
    SOURCE/cam0/00000.png, ...               frames
    SOURCE/00000.png, ...                    frames of one camera

Needs only the standard library.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from .. import errors
from ..data import file_kinds

VIDEO, FRAMES = "video", "frames"
FRAME_SUFFIXES = (*file_kinds.IMAGES, *file_kinds.HEIC)
# GoPro: GH020042 is chapter 2 of recording 42. Older cameras name its first chapters GOPR0042 and GP010042.
_CHAPTER = re.compile(r"(?P<family>G[HXL])(?P<chapter>\d{2})(?P<number>\d{4})", re.IGNORECASE)
_OLD_CHAPTER = re.compile(r"(?P<family>G)(?:OPR|P(?P<chapter>\d{2}))(?P<number>\d{4})", re.IGNORECASE)
_EDGE_BYTES = 1 << 16  # bytes at each end of a file that enter its fingerprint


@dataclass(frozen=True)
class CameraFiles:
    """Files of one camera.

    Attributes:
        name: Name of the camera.
        kind: `VIDEO` or `FRAMES`.
        paths: Its chapters, or its frames, in temporal order.
    """

    name: str
    kind: str
    paths: tuple[Path, ...]


def find(source: Path) -> list[CameraFiles]:
    """Return the cameras of a source, sorted by name.

    Args:
        source: A folder (see above), or one video.

    Raises:
        DatasetError: There is no camera, a camera has no frames, or two cameras have the same name.
    """
    source = Path(source)
    if source.is_file():
        if source.suffix.lower() not in file_kinds.VIDEOS:
            raise errors.DatasetError(
                f"{source}: expected a video or a folder, found a {source.suffix or 'plain'} file"
            )
        return [CameraFiles(source.stem, VIDEO, (source,))]
    if not source.is_dir():
        raise errors.DatasetError(f"{source}: expected a folder of videos or frames, found nothing; check the path")
    found = _videos(_with_suffix(source, file_kinds.VIDEOS))
    for folder in sorted(path for path in source.iterdir() if path.is_dir() and not path.name.startswith(".")):
        found += _of_folder(folder)
    frames = _with_suffix(source, FRAME_SUFFIXES)
    if not found and frames:
        found = [CameraFiles(source.resolve().name, FRAMES, frames)]
    if not found:
        deeper = sorted(path.parent for path in source.glob("*/*/*") if path.suffix.lower() in file_kinds.VIDEOS)
        raise errors.DatasetError(
            f"{source}: expected a video or a folder of frames per camera, found none; supported are "
            f"{', '.join(file_kinds.VIDEOS)} and frames of {', '.join(FRAME_SUFFIXES)}"
            + (f". Remedy: name the folder {deeper[0]}, which has videos" if deeper else "")
        )
    _check_names(found)
    return sorted(found, key=lambda camera: natural(camera.name))


def fingerprint(paths: Sequence[Path]) -> str:
    """Return a hash of the names, sizes and ends of files."""
    hasher = hashlib.sha256()
    for path in paths:
        size = path.stat().st_size
        with path.open("rb") as stream:
            head = stream.read(_EDGE_BYTES)
            stream.seek(max(size - _EDGE_BYTES, 0))
            hasher.update(f"{path.name} {size} ".encode() + head + stream.read(_EDGE_BYTES))
    return hasher.hexdigest()


def natural(name: str) -> list[tuple[int, int, str]]:
    """Sort key that orders numbers in names by value: cam2 before cam10."""
    parts = re.findall(r"\d+|\D+", name)
    return [(0, int(part), part) if part.isdigit() else (1, 0, part.lower()) for part in parts]


def _with_suffix(folder: Path, suffixes: tuple[str, ...]) -> tuple[Path, ...]:
    found = [path for path in folder.iterdir() if path.suffix.lower() in suffixes and path.is_file()]
    return tuple(sorted((path for path in found if not path.name.startswith(".")), key=lambda path: natural(path.name)))


def _of_folder(folder: Path) -> list[CameraFiles]:
    """Return the camera of a folder, if it is one."""
    videos, frames = _with_suffix(folder, file_kinds.VIDEOS), _with_suffix(folder, FRAME_SUFFIXES)
    if videos and frames:
        raise errors.DatasetError(f"{folder}: expected a video or frames, found both; keep one of them")
    if videos:
        cameras = _videos(videos)
        if len(cameras) > 1:
            raise errors.DatasetError(
                f"{folder}: expected one recording of one camera, found {len(cameras)} "
                f"({', '.join(camera.name for camera in cameras[:3])}); keep the files of one recording"
            )
        return [CameraFiles(folder.name, VIDEO, cameras[0].paths)]
    if frames:
        return [CameraFiles(folder.name, FRAMES, frames)]
    if not any(folder.iterdir()):
        raise errors.DatasetError(f"{folder}: the camera has no frames; copy them, or remove the folder")
    return []


def _videos(paths: tuple[Path, ...]) -> list[CameraFiles]:
    """Group videos by recording."""
    recordings: dict[tuple[str, ...], list[tuple[int, Path]]] = {}
    for path in paths:
        key, chapter = (path.name,), 1
        for pattern, first in ((_CHAPTER, 1), (_OLD_CHAPTER, 0)):
            if match := pattern.fullmatch(path.stem):
                key = (match["family"].upper(), match["number"], path.suffix.lower())
                chapter = int(match["chapter"] or 0) - first + 1
        recordings.setdefault(key, []).append((chapter, path))
    cameras = []
    for chapters in recordings.values():
        ordered = sorted(chapters)
        missing = set(range(1, ordered[-1][0])) - {number for number, _ in ordered}
        if missing:
            raise errors.DatasetError(
                f"{ordered[-1][1]}: part {min(missing)} of this recording is missing; copy it beside the others"
            )
        cameras.append(CameraFiles(ordered[0][1].stem, VIDEO, tuple(path for _, path in ordered)))
    return cameras


def _check_names(found: list[CameraFiles]) -> None:
    by_name: dict[str, CameraFiles] = {}
    for camera in found:
        other = by_name.setdefault(camera.name.lower(), camera)
        if other is not camera:
            raise errors.DatasetError(
                f"{camera.paths[0]}: two cameras have the name {camera.name}, the other is {other.paths[0]}; rename one"
            )
