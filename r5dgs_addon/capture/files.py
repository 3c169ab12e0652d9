"""Files of a captured data set: PNG images and masks, JSON, and atomic creation of the folder."""

from __future__ import annotations

import json
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from ...r5dgs_core import errors


def require_openimageio() -> Any:
    """Return the OpenImageIO module. Raises BackendError with installation instructions if it is missing."""
    try:
        import OpenImageIO
    except ImportError as error:
        raise errors.BackendError(
            "capture: OpenImageIO is needed to read object ids and to write masks, and this Blender's Python does not "
            "have it; install it with 'python -m pip install OpenImageIO', run by that Python"
        ) from error
    return OpenImageIO


def _images() -> Any:
    """Import the core's `images` module on first use, because it requires OpenImageIO."""
    require_openimageio()
    from ...r5dgs_core.data import images

    return images


@contextmanager
def new_folder(directory: Path) -> Iterator[Path]:
    """Create a temporary folder that is renamed to ``directory`` on success and removed after an error."""
    directory = directory.absolute()
    _check_free(directory)
    temporary = directory.with_name(f".{directory.name}.{secrets.token_hex(8)}.partial")
    try:
        temporary.parent.mkdir(parents=True, exist_ok=True)
        temporary.mkdir()  # the name is unique, so the folder belongs to this process alone
    except OSError as error:
        raise errors.DatasetError(f"{directory}: cannot write the data set: {error}") from error
    try:
        yield temporary
        _check_free(directory)
        if directory.exists():
            directory.rmdir()
        temporary.rename(directory)
    except OSError as error:
        raise errors.DatasetError(f"{directory}: cannot write the data set: {error}") from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _check_free(directory: Path) -> None:
    if directory.exists() and not directory.is_dir():
        raise errors.DatasetError(f"{directory}: expected a folder, found a file; choose another place")
    if directory.is_dir() and any(directory.iterdir()):
        raise errors.DatasetError(f"{directory}: expected a new or empty folder, found files; choose another")


def write_view(folder: Path, stem: str, image: np.ndarray, ids: np.ndarray, *, wide: bool) -> None:
    """Write an image and its mask.

    Args:
        folder: Folder of the data set.
        stem: Split and name without extension, such as "train/r_0000".
        image: Display sRGB, straight alpha. [H, W, 3 or 4] uint8
        ids: Object of each pixel, 0 for the background. [H, W]
        wide: True for a 16-bit mask.
    """
    images = _images()
    images.write_png(folder / f"{stem}.png", image)
    images.write_png(folder / "object_mask" / f"{stem}.png", ids.astype(np.uint16 if wide else np.uint8))


def read_png(path: Path) -> np.ndarray:
    """Read the stored integers of a PNG, straight alpha. [H, W, C] uint8 or uint16"""
    return _images().read_png(path)


def read_exr_channel(path: Path, endings: tuple[str, ...]) -> np.ndarray:
    """Read the channel whose name has one of the endings from any part of a multilayer EXR. [H, W] float32

    Blender 4 writes all passes as one part, Blender 5 one part per pass; pass names differ, too.
    """
    oiio = require_openimageio()
    source = oiio.ImageInput.open(str(path))
    if source is None:
        raise errors.BackendError(f"{path}: the rendered EXR cannot be read: {oiio.geterror()}")
    try:
        names: list[str] = []
        part = 0
        while source.seek_subimage(part, 0):
            channels = list(source.spec().channelnames)
            for index, name in enumerate(channels):
                if name.endswith(endings):
                    return source.read_image(part, 0, index, index + 1, "float")[..., 0]
            names += channels
            part += 1
    finally:
        source.close()
    raise errors.BackendError(f"{path}: expected a channel named like {endings[0]!r}, found {', '.join(names)}")


def write_transforms(folder: Path, split: str, header: dict[str, Any], frames: list[dict[str, Any]]) -> None:
    """Write ``transforms_<split>.json``, unless the split has no images.

    The global ``camera_angle_x`` is that of the first frame. A frame with other intrinsics stores its own.
    """
    if not frames:
        return
    angle = frames[0]["camera_angle_x"]
    width, height = header["w"], header["h"]
    rows = []
    for frame in frames:
        row = dict(frame)
        intrinsics = row.pop("intrinsics")
        own_angle = row.pop("camera_angle_x")
        focal = 0.5 * width / np.tan(0.5 * angle)
        described = {"fl_x": focal, "fl_y": focal, "cx": 0.5 * width, "cy": 0.5 * height}
        if any(abs(intrinsics[name] - described[name]) > 1e-6 * width for name in described):
            row.update(intrinsics, camera_angle_x=own_angle)
        rows.append(row)
    write_json(folder / f"transforms_{split}.json", {"camera_angle_x": angle, **header, "frames": rows})


def write_json(path: Path, value: dict[str, Any]) -> None:
    """Write JSON with one frame or object per line, for compact and readable diffs."""
    members = []
    for key, item in value.items():
        text = json.dumps(item, ensure_ascii=False)
        if isinstance(item, list) and item and isinstance(item[0], dict):
            text = "[\n" + ",\n".join(json.dumps(row, ensure_ascii=False) for row in item) + "\n]"
        members.append(f"{json.dumps(key, ensure_ascii=False)}: {text}")
    path.write_text("{" + ",\n ".join(members) + "}\n", encoding="utf-8")
