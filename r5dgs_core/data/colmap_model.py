"""Files of a COLMAP reconstruction: `cameras`, `images` and `points3D`, binary or text.

Poses are world to camera with OpenCV axes, quaternions wxyz, pixel centres at +0.5, as in this package. Binary files
are little endian; see "Output Format" in COLMAP's documentation.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .. import errors
from ..motion import rotations

# Name and number of parameters of COLMAP's camera models, by id.
MODELS = {
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8),
    6: ("FULL_OPENCV", 12),
    7: ("FOV", 5),
    8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5),
    10: ("THIN_PRISM_FISHEYE", 12),
    11: ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
    12: ("SIMPLE_DIVISION", 4),
    13: ("DIVISION", 5),
    14: ("SIMPLE_FISHEYE", 3),
    15: ("FISHEYE", 4),
    16: ("EUCM", 6),
    17: ("EQUIRECTANGULAR", 2),
}
PINHOLES = ("SIMPLE_PINHOLE", "PINHOLE")
SINGLE_FOCAL = {"SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"} | {
    *("SIMPLE_DIVISION", "SIMPLE_FISHEYE")
}
LONGEST_NAME = 255  # bytes in a file or folder name; the limit of common file systems


@dataclass(frozen=True)
class Lens:
    """A lens for an image of a given size.

    Attributes:
        place: File and camera, for errors.
        model: Name of COLMAP's camera model.
        width: Width of the image in pixels.
        height: Height of the image in pixels.
        fx: Focal length in pixels, horizontal.
        fy: Focal length in pixels, vertical.
        cx: Principal point in pixels from the left edge.
        cy: Principal point in pixels from the upper edge.
        coefficients: Parameters of the distortion, in COLMAP's order.
    """

    place: str
    model: str
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    coefficients: tuple[float, ...] = ()


@dataclass(frozen=True)
class Registered:
    """An image registered by COLMAP.

    Attributes:
        name: Path in the folder of images, "/" between folders.
        lens: Its lens.
        T_cam_world: World to camera, OpenCV axes. [4, 4]
    """

    name: str
    lens: Lens
    T_cam_world: np.ndarray


@dataclass(frozen=True)
class Reconstruction:
    """Content of a reconstruction.

    Attributes:
        images: Registered images, sorted by name.
        points: Points, world. [P, 3] float64, or None without the file.
        colors: Colours of the points, sRGB in [0, 1]. [P, 3] float32, or None without the file.
        files: The files that were read.
    """

    images: tuple[Registered, ...]
    points: np.ndarray | None
    colors: np.ndarray | None
    files: tuple[Path, ...]


def read(folder: Path) -> Reconstruction:
    """Read a reconstruction, preferring binary files to text files.

    Raises:
        DatasetError: A file is missing or damaged, or a lens is unknown.
    """
    camera_path, image_path = _file(folder, "cameras"), _file(folder, "images")
    lenses = dict(_text_lenses(camera_path) if camera_path.suffix == ".txt" else _binary_lenses(camera_path))
    found = _text_images(image_path) if image_path.suffix == ".txt" else _binary_images(image_path)
    images = {}
    for name, camera_id, quat, shift in found:
        if any(len(part.encode(errors="replace")) > LONGEST_NAME for part in name.split("/")):
            raise errors.DatasetError(
                f"{image_path}: image {name[:40]}...: expected a name that a file can have, found one of {len(name)} "
                "letters; is the file damaged?"
            )
        if camera_id not in lenses:
            raise errors.DatasetError(f"{image_path}: image {name}: camera {camera_id} is not in {camera_path.name}")
        if not (np.isfinite([*quat, *shift]).all() and np.linalg.norm(quat) > 1e-6):
            raise errors.DatasetError(f"{image_path}: image {name}: expected a finite pose, found {quat} {shift}")
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotations.quats_to_rotmats(rotations.normalize(np.array(quat))), shift
        images[name] = Registered(name, lenses[camera_id], pose)
    if not images:
        raise errors.DatasetError(f"{image_path}: expected registered images, found none")
    files, points, colors = [camera_path, image_path], None, None
    if any((folder / f"points3D{suffix}").exists() for suffix in (".bin", ".txt")):
        files.append(_file(folder, "points3D"))
        rows = list(_text_points(files[-1]) if files[-1].suffix == ".txt" else _binary_points(files[-1]))
        table = np.array(rows, np.float64).reshape(-1, 6)
        table = table[np.isfinite(table).all(1)]
        points, colors = table[:, :3], (table[:, 3:] / 255).astype(np.float32)
    ordered = tuple(images[name] for name in sorted(images))
    return Reconstruction(ordered, points, colors, tuple(files))


def _file(folder: Path, name: str) -> Path:
    for suffix in (".bin", ".txt"):
        if (folder / f"{name}{suffix}").exists():
            return folder / f"{name}{suffix}"
    raise errors.DatasetError(f"{folder / name}.bin: the file is missing, and so is {name}.txt")


def _lens(place: str, model: str, width: int, height: int, numbers: list[float]) -> Lens:
    wanted = dict(MODELS.values()).get(model)
    if wanted is None or model == "EQUIRECTANGULAR":
        kind = "a panorama; render perspective views of it" if wanted else "unknown; convert it to a model of COLMAP's"
        raise errors.DatasetError(f"{place}: the lens {model} is {kind}, and use these images")
    count = 1 if model in SINGLE_FOCAL else 2  # of focal lengths
    if len(numbers) != wanted or not np.isfinite(numbers).all() or min(numbers[:count]) <= 0 or min(width, height) < 1:
        raise errors.DatasetError(
            f"{place}: expected {wanted} parameters and a size, found {numbers} and {width}x{height}"
        )
    focal, (cx, cy) = numbers[:count], numbers[count : count + 2]
    return Lens(place, model, width, height, focal[0], focal[-1], cx, cy, tuple(numbers[count + 2 :]))


class _Bytes:
    """Sequential reader of a binary file."""

    def __init__(self, path: Path) -> None:
        self.path, self.at = path, 0
        try:
            self.data = path.read_bytes()
        except OSError as error:
            raise errors.DatasetError(f"{path}: cannot be read ({error})") from error

    def take(self, layout: str) -> tuple:
        """Read the numbers of a layout of `struct`, little endian."""
        end = self.at + struct.calcsize("<" + layout)
        if end > len(self.data):
            raise self.short()
        values = struct.unpack_from("<" + layout, self.data, self.at)
        self.at = end
        return values

    def word(self) -> str:
        """Read text up to the next zero byte."""
        end = self.data.find(b"\0", self.at)
        if end < 0:
            raise self.short()
        text, self.at = self.data[self.at : end], end + 1
        return text.decode("utf-8", "replace")

    def skip(self, count: int) -> None:
        """Skip bytes."""
        self.at += count
        if self.at > len(self.data):
            raise self.short()

    def short(self) -> errors.DatasetError:
        """Return the error for a truncated file."""
        return errors.DatasetError(f"{self.path}: the file ends at byte {len(self.data)}; is it truncated?")


def _binary_lenses(path: Path) -> Iterator[tuple[int, Lens]]:
    data = _Bytes(path)
    for _ in range(data.take("Q")[0]):
        camera_id, kind, width, height = data.take("iiQQ")
        if kind not in MODELS:
            raise errors.DatasetError(f"{path}: camera {camera_id}: unknown lens {kind}; write the model as text")
        model, count = MODELS[kind]
        yield camera_id, _lens(f"{path}: camera {camera_id}", model, width, height, list(data.take("d" * count)))


def _binary_images(path: Path) -> Iterator[tuple[str, int, tuple, tuple]]:
    data = _Bytes(path)
    for _ in range(data.take("Q")[0]):
        _, *pose, camera_id = data.take("I7dI")
        name = data.word()
        data.skip(24 * data.take("Q")[0])
        yield name.replace("\\", "/"), camera_id, tuple(pose[:4]), tuple(pose[4:])


def _binary_points(path: Path) -> Iterator[tuple]:
    data = _Bytes(path)
    for _ in range(data.take("Q")[0]):
        _, x, y, z, r, g, b, _, seen = data.take("Q3d3BdQ")
        data.skip(8 * seen)
        yield x, y, z, r, g, b


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Yield number and text of the lines that are not comments, including empty ones."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise errors.DatasetError(f"{path}: cannot be read ({error})") from error
    for number, line in enumerate(text.splitlines(), 1):
        if not line.startswith("#"):
            yield number, line.strip()


def _text_lenses(path: Path) -> Iterator[tuple[int, Lens]]:
    for number, line in _lines(path):
        words = line.split()
        if not words:
            continue
        place = f"{path}: line {number}"
        try:
            camera_id, width, height = int(words[0]), int(words[2]), int(words[3])
            numbers = [float(word) for word in words[4:]]
        except (IndexError, ValueError) as error:
            raise errors.DatasetError(f"{place}: expected id, model, width, height and parameters") from error
        yield camera_id, _lens(place, words[1], width, height, numbers)


def _text_images(path: Path) -> Iterator[tuple[str, int, tuple, tuple]]:
    points_follow = False  # lines come in pairs; the second, with 2D points, may be empty
    for number, line in _lines(path):
        if points_follow:
            points_follow = False
        elif line:
            points_follow = True
            words = line.split(maxsplit=9)
            try:
                pose, camera_id, name = [float(word) for word in words[1:8]], int(words[8]), words[9]
            except (IndexError, ValueError) as error:
                raise errors.DatasetError(
                    f"{path}: line {number}: expected id, quaternion, translation, camera and name, found {line[:60]!r}"
                ) from error
            yield name.replace("\\", "/"), camera_id, tuple(pose[:4]), tuple(pose[4:])


def _text_points(path: Path) -> Iterator[tuple]:
    for number, line in _lines(path):
        if not line:
            continue
        try:
            values = tuple(float(word) for word in line.split()[1:7])
        except ValueError:
            values = ()
        if len(values) != 6:
            raise errors.DatasetError(f"{path}: line {number}: expected id, x, y, z, r, g, b, found {line[:60]!r}")
        yield values
