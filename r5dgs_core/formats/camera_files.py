"""Writers of camera files for radiance-field tools: `transforms.json` of NeRF and D-NeRF, COLMAP's text model."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .. import atomic_files, errors
from ..motion import rotations
from ..scene import cameras
from ..scene.cameras import Camera
from ..scene.scene import Scene
from . import registry


@dataclass(frozen=True)
class CameraFrame:
    """One image and its camera.

    Attributes:
        file_path: Path of the image relative to the camera file, with "/" between folders and a suffix.
        camera: The camera; its name is that of the camera, not of the image.
        t: Scene time, or None if there is none.
    """

    file_path: str
    camera: Camera
    t: float | None = None


def write_transforms(path: str | Path, views: Sequence[CameraFrame]) -> Path:
    """Write NeRF's camera file atomically: camera to world with OpenGL axes, in the cameras' world.

    ``camera_angle_x w h fl_x fl_y cx cy`` are at the top level if all views share them, else in each view. ``time`` is
    in the views that have one.

    Args:
        path: Target file.
        views: At least one.

    Returns:
        The path.
    """
    lenses = [_lens(view.camera) for view in views]
    shared = lenses[0] if all(lens == lenses[0] for lens in lenses) else {}
    rows = []
    for view, lens in zip(views, lenses, strict=True):
        row: dict[str, Any] = {"file_path": view.file_path}
        if view.t is not None:
            row["time"] = float(view.t)
        row["transform_matrix"] = cameras.cam_world_to_opengl(view.camera.T_cam_world).tolist()
        rows.append(json.dumps(row if shared else {**row, **lens}, ensure_ascii=False))
    head = "".join(f"{json.dumps(key)}: {json.dumps(value)},\n " for key, value in shared.items())
    atomic_files.write(path, ("{" + head + '"frames": [\n' + ",\n".join(rows) + "\n]}\n").encode())
    return Path(path)


def export(scene: Scene, path: Path, options: registry.Options) -> Iterator[Path]:
    """Write every camera of a scene at each time, in the data set's world. Implements `registry.Format.write`.

    Images are named as in Blender's export of all cameras: ``images/CAMERA/0001.png`` with frame numbers, else
    ``images/CAMERA.png``.
    """
    views = []
    for number, t in enumerate(options.times):
        end = ".png" if options.frames is None else f"/{options.frames[number]:04d}.png"
        views += [CameraFrame(f"images/{c.name}{end}", cameras.translated(c, scene.origin), t) for c in scene.cameras]
    if not views:
        raise errors.ConfigError(f"{scene.name}: expected cameras in the scene, found none; train it from a data set")
    with registry.writing(path):
        yield write_transforms(path, views)


FORMAT = registry.Format(
    name="cameras",
    label="Cameras",
    suffix=".json",
    keeps="lens, pose and time of every camera, as transforms.json of NeRF and D-NeRF",
    loses="everything but cameras",
    write=export,
    has_objects=False,
)


def write_colmap(folder: str | Path, views: Sequence[CameraFrame]) -> Path:
    """Write COLMAP's text model into ``sparse/0`` of a folder, each file atomically, without points.

    Images are named by their paths without the leading folder ``images``, as in COLMAP. If views have times, they are
    stored in ``times.json`` beside ``sparse`` (docs/reference/dataset.md), an extension that COLMAP ignores.

    Args:
        folder: An existing folder.
        views: At least one.

    Returns:
        The folder of the model.
    """
    if any(view.t is not None for view in views):
        times = {_image_name(view): float(view.t) for view in views if view.t is not None}
        atomic_files.write(Path(folder) / "times.json", (json.dumps({"times": times}, indent=1) + "\n").encode())
    folder = Path(folder) / "sparse" / "0"
    folder.mkdir(parents=True, exist_ok=True)
    lenses: dict[tuple[float, ...], int] = {}
    camera_lines, image_lines = [], []
    for number, view in enumerate(views, 1):
        camera, k = view.camera, view.camera.intrinsics
        lens = (camera.width, camera.height, *(float(v) for v in (k[0, 0], k[1, 1], k[0, 2], k[1, 2])))
        if lens not in lenses:
            lenses[lens] = len(lenses) + 1
            camera_lines.append(f"{lenses[lens]} PINHOLE " + " ".join(repr(value) for value in lens))
        quat = rotations.rotmats_to_quats(camera.T_cam_world[:3, :3])
        center = cameras.cam_world_to_opengl(camera.T_cam_world)[:3, 3]
        shift = -rotations.quats_to_rotmats(quat) @ center  # rotation as read back; `center` may be far
        pose = " ".join(repr(float(value)) for value in (*quat, *shift))
        image_lines.append(f"{number} {pose} {lenses[lens]} {_image_name(view)}\n")
    _write_lines(folder / "cameras.txt", "CAMERA_ID MODEL WIDTH HEIGHT PARAMS[] (fx fy cx cy)", camera_lines)
    _write_lines(folder / "images.txt", "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then its points", image_lines)
    _write_lines(folder / "points3D.txt", "POINT3D_ID X Y Z R G B ERROR TRACK[]", [])
    return folder


def _lens(camera: Camera) -> dict[str, float]:
    k = camera.intrinsics
    fl_x, fl_y, cx, cy = (float(value) for value in (k[0, 0], k[1, 1], k[0, 2], k[1, 2]))
    angle = 2 * math.atan(0.5 * camera.width / fl_x)
    return {
        "camera_angle_x": angle, "w": camera.width, "h": camera.height, "fl_x": fl_x, "fl_y": fl_y, "cx": cx, "cy": cy,
    }  # fmt: skip


def _image_name(view: CameraFrame) -> str:
    return view.file_path.removeprefix("images/")


def _write_lines(path: Path, head: str, lines: list[str]) -> None:
    atomic_files.write(path, "".join(f"{line}\n" for line in [f"# {head}", *lines]).encode())
