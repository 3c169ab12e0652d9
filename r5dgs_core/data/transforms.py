"""Camera files `transforms_{train,val,test}.json`, in D-NeRF's flat layout and NVFi's nested one.

Flat: ``camera_angle_x`` and ``frames`` of ``file_path``, ``time``, ``transform_matrix``. Nested: ``data`` maps a camera
to one ``transform_matrix`` and its ``frames`` of ``file_path`` and ``time``. Matrices are camera to world with OpenGL
axes (y up, -z forward). Frames without times are spread evenly: index / (n - 1).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from .. import errors, findings, input_paths, strict_json
from ..scene.model_checks import MAX_TIME

RIGID_TOLERANCE = 1e-3
DISTORTION = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")


@dataclass(frozen=True)
class Entry:
    """One frame of a camera file.

    Attributes:
        place: File and frame, for errors.
        file_path: Path of the image relative to the data set, "/" between folders, as written.
        t: Scene time.
        matrix: Camera to world, OpenGL axes. [4, 4]
        camera: Name of the camera, "" if the file gives none.
        lens: Keys about intrinsics that apply to this frame.
        frame: Frame number, or None.
        lens_place: File or frame that ``lens`` comes from, for errors; ``place`` if empty.
    """

    place: str
    file_path: str
    t: float
    matrix: np.ndarray
    camera: str
    lens: dict[str, float]
    frame: float | None
    lens_place: str = ""

    def moved(self, shift: np.ndarray) -> Entry:
        """Translate the frame's camera by a vector [3]."""
        matrix = self.matrix.copy()
        matrix[:3, 3] += shift
        return replace(self, matrix=matrix)


def read(path: Path, guard: findings.Guard = findings.STRICT) -> tuple[list[Entry], dict[str, Any]]:
    """Read one camera file.

    Args:
        path: The file.
        guard: Entered around each frame.

    Returns:
        The frames in the file's order, and the file's top-level keys other than the frames.
    """
    with findings.coded("D02"):
        content = strict_json.read(path, errors.DatasetError, finite=False)  # frames are named below
    return parse(path, content, guard)


def parse(path: Path, content: Any, guard: findings.Guard = findings.STRICT) -> tuple[list[Entry], dict[str, Any]]:
    """Read the parsed content of a camera file; see `read`."""
    if not isinstance(content, dict):
        raise errors.DatasetError(f"{path}: expected a JSON object, found {type(content).__name__}", code="D02")
    if isinstance(content.get("frames"), list):
        entries = _read_frames(str(path), content["frames"], content, None, "", guard)
    elif isinstance(content.get("data"), dict):
        entries = []
        for camera, part in content["data"].items():
            place = f"{path}: data[{camera!r}]"
            with guard():
                if not isinstance(part, dict) or not isinstance(part.get("frames"), list):
                    raise errors.DatasetError(f"{place}: expected 'transform_matrix' and 'frames'", code="D02")
                common = {**content, **part}
                entries += _read_frames(place, part["frames"], common, part.get("transform_matrix"), camera, guard)
    else:
        keys = ", ".join(sorted(content)) or "nothing"
        raise errors.DatasetError(f"{path}: expected 'frames' (D-NeRF) or 'data' (NVFi), found {keys}", code="D02")
    return entries, {key: value for key, value in content.items() if key not in ("frames", "data")}


def intrinsics(entry: Entry, width: int, height: int) -> np.ndarray:
    """Return the camera matrix of a frame for the actual size of its image, without its distortion.

    Uses ``fl_x fl_y cx cy`` (pixels of an image of ``w`` x ``h``, if given), else ``camera_angle_x`` and
    ``camera_angle_y`` (radians). Defaults are square pixels and a centred principal point.

    Args:
        entry: The frame.
        width: Width of its image in pixels.
        height: Height of its image in pixels.

    Returns:
        Camera matrix in pixels. [3, 3]
    """
    lens, place = entry.lens, entry.lens_place or entry.place
    declared = lens.get("w", width), lens.get("h", height)
    scale = np.array([width / declared[0], height / declared[1]])
    if abs(scale[0] - scale[1]) * max(declared) > 1.5:
        raise errors.DatasetError(
            f"{entry.place}: the image is {width}x{height}, but 'w' and 'h' are {declared[0]:g}x{declared[1]:g}",
            code="D09",
        )
    if "fl_x" in lens or "fl_y" in lens:
        focal_x = lens.get("fl_x", lens.get("fl_y", 0.0)) * scale[0]
        focal_y = lens.get("fl_y", lens.get("fl_x", 0.0)) * scale[1]
    elif "camera_angle_x" in lens or "camera_angle_y" in lens:
        for key in ("camera_angle_x", "camera_angle_y"):
            if key in lens and not 0.0 < lens[key] < math.pi:
                raise errors.DatasetError(f"{place}: '{key}' is {lens[key]:g}, expected radians in (0, pi)", code="D08")
        focal_x = 0.5 * width / math.tan(0.5 * lens["camera_angle_x"]) if "camera_angle_x" in lens else 0.0
        focal_y = 0.5 * height / math.tan(0.5 * lens["camera_angle_y"]) if "camera_angle_y" in lens else focal_x
        focal_x = focal_x or focal_y
    else:
        raise errors.DatasetError(f"{place}: expected 'camera_angle_x' or 'fl_x', found neither", code="D08")
    if not (focal_x > 0 and focal_y > 0):
        raise errors.DatasetError(
            f"{place}: the focal length must be positive, found {focal_x:g}, {focal_y:g}", code="D08"
        )
    cx = lens["cx"] * scale[0] if "cx" in lens else 0.5 * width
    cy = lens["cy"] * scale[1] if "cy" in lens else 0.5 * height
    return np.array([[focal_x, 0.0, cx], [0.0, focal_y, cy], [0.0, 0.0, 1.0]])


def check_undistorted(entry: Entry, root: Path) -> None:
    """Raise `DatasetError` with the command that undistorts a data set if a frame has lens distortion."""
    distorted = [key for key in DISTORTION if abs(entry.lens.get(key, 0.0)) > 1e-9]
    if distorted:
        raise errors.DatasetError(
            f"{entry.lens_place or entry.place}: expected undistorted images, found lens distortion "
            f"({', '.join(distorted)}). Remedy: {input_paths.prepare_command(root)}",
            code="D08",
        )


def check_perspective(path: Path, header: dict[str, Any]) -> None:
    """Raise `DatasetError` with the command that undistorts a data set if its camera model is not perspective."""
    model = "OPENCV_FISHEYE" if header.get("is_fisheye") else str(header.get("camera_model", ""))
    if "FISHEYE" in model:
        raise errors.DatasetError(
            f"{path}: expected perspective cameras, found {model}. Remedy: {input_paths.prepare_command(path.parent)}",
            code="D08",
        )


def view_name(file_path: str) -> str:
    """Derive the name of a view from its path: without "./", drive, "..", and image suffix."""
    parts = [part for part in PurePosixPath(file_path.replace("\\", "/")).parts if part not in (".", "..", "/")]
    name = "/".join(parts)
    head, _, suffix = name.rpartition(".")
    return head if head and suffix.lower() in ("png", "jpg", "jpeg", "exr", "webp", "tif", "tiff") else name


def _read_frames(
    place: str, frames: list, common: dict, shared_matrix: Any, camera: str, guard: findings.Guard
) -> list[Entry]:
    given = ["time" in frame for frame in frames if isinstance(frame, dict)]
    with guard():
        if any(given) and not all(given):
            raise errors.DatasetError(
                f"{place}: frame {given.index(False)} has no 'time', but others have; give all a time, or none",
                code="D04",
            )
    entries = []
    for i, frame in enumerate(frames):
        with guard():
            t = i / max(len(frames) - 1, 1)
            entries.append(_read_frame(place, i, frame, common, shared_matrix, camera, t))
    return entries


def _read_frame(place: str, i: int, frame: Any, common: dict, shared_matrix: Any, camera: str, t: float) -> Entry:
    """Read frame ``i``; ``t`` is its time if it gives none."""
    at = f"{place}: frame {i}"
    if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str) or not frame["file_path"]:
        raise errors.DatasetError(f"{at}: expected an object with a 'file_path'", code="D03")
    at = f"{at} ({frame['file_path']})"
    lens = {
        key: finite(where, key, value)
        for where, source in ((place, common), (at, frame))
        for key, value in _lens_keys(source).items()
        if value is not None
    }
    lens_place = at if _lens_keys(frame) else place
    for key in ("w", "h"):
        if key in lens and lens[key] <= 0:
            raise errors.DatasetError(f"{lens_place}: '{key}' must be positive, found {lens[key]:g}", code="D08")
    number = frame.get("frame")
    numbered = isinstance(number, (int, float)) and not isinstance(number, bool)
    return Entry(
        place=at,
        file_path=frame["file_path"],
        t=time_of(at, "time", frame["time"]) if "time" in frame else t,
        matrix=rigid_matrix(at, frame.get("transform_matrix", shared_matrix)),
        camera=str(frame.get("view", frame.get("camera", camera))),
        lens=lens,
        lens_place=lens_place,
        frame=finite(at, "frame", number) if numbered else None,
    )


def rigid_matrix(place: str, value: Any) -> np.ndarray:
    """Check a camera-to-world matrix: finite, and a rotation, an optional uniform scale and a translation. [4, 4]"""
    if value is None:
        raise errors.DatasetError(f"{place}: 'transform_matrix' is missing", code="D05")
    try:
        matrix = np.array(value, np.float64)
    except (TypeError, ValueError):
        matrix = np.zeros(0)
    if matrix.shape == (3, 4):
        matrix = np.vstack([matrix, [0.0, 0.0, 0.0, 1.0]])
    if matrix.shape != (4, 4):
        raise errors.DatasetError(f"{place}: expected a 'transform_matrix' of 4x4 numbers", code="D05")
    if not np.isfinite(matrix).all():
        raise errors.DatasetError(f"{place}: 'transform_matrix' holds NaN or infinity", code="D06")
    lengths = np.linalg.norm(matrix[:3, :3], axis=0)
    if lengths.min() < 1e-9 or not np.allclose(matrix[3], [0, 0, 0, 1], atol=1e-6):
        raise errors.DatasetError(f"{place}: 'transform_matrix' is not a rigid camera-to-world matrix", code="D07")
    unit = matrix[:3, :3] / lengths
    off = max(float(np.abs(unit.T @ unit - np.eye(3)).max()), float(np.ptp(lengths) / lengths.mean()))
    if off > RIGID_TOLERANCE:
        raise errors.DatasetError(
            f"{place}: 'transform_matrix' is not rigid (axes off by {off:.2g}, allowed {RIGID_TOLERANCE:g}); "
            "remove shear and uneven scale",
            code="D07",
        )
    if np.linalg.det(unit) < 0:
        raise errors.DatasetError(f"{place}: 'transform_matrix' mirrors the scene (determinant -1)", code="D07")
    return matrix


def _lens_keys(source: dict) -> dict[str, Any]:
    names = {"img_w": "w", "img_h": "h"}
    keys = ("camera_angle_x", "camera_angle_y", "fl_x", "fl_y", "cx", "cy", "w", "h", "img_w", "img_h", *DISTORTION)
    return {names.get(key, key): source[key] for key in keys if key in source}


def time_of(place: str, key: str, value: Any) -> float:
    """Return the value of a key as a scene time; DatasetError if a scene file cannot hold it."""
    t = finite(place, key, value)
    if abs(t) > MAX_TIME:
        raise errors.DatasetError(f"{place}: '{key}' must be a time up to {MAX_TIME:g}, found {t:g}", code="D03")
    return t


def finite(place: str, key: str, value: Any) -> float:
    """Return the value of a key as a float; DatasetError naming place and key if it is not a finite number."""
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise errors.DatasetError(f"{place}: '{key}' must be a finite number, found {value!r}", code="D03")
    return float(value)
