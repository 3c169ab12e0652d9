"""Write COLMAP reconstructions in COLMAP's binary and text formats."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from r5dgs_core.motion import rotations
from r5dgs_core.scene.cameras import Camera

PINHOLE, OPENCV = 1, 4


def write(
    folder: Path, views: dict[str, Camera], points: np.ndarray, *, text: bool = False, model: int = PINHOLE
) -> None:
    """Write `cameras`, `images` and `points3D`.

    Args:
        folder: Where to.
        views: Camera of each image; every image gets a lens of its own.
        points: World. [P, 3]
        text: Write text instead of binary files.
        model: Lens of all cameras; OPENCV has four parameters of distortion more.
    """
    folder.mkdir(parents=True, exist_ok=True)
    writer = _write_text if text else _write_binary
    writer(folder, views, points, model)


def _numbers(camera: Camera, model: int) -> tuple[list[float], np.ndarray, np.ndarray]:
    """Parameters of the lens, quaternion and translation."""
    k = camera.intrinsics
    lens = [float(x) for x in (k[0, 0], k[1, 1], k[0, 2], k[1, 2])] + [0.01, 0.0, 0.0, 0.0] * (model == OPENCV)
    quat = rotations.rotmats_to_quats(camera.T_cam_world[None, :3, :3])[0]
    return lens, quat, camera.T_cam_world[:3, 3]


def _write_binary(folder: Path, views: dict[str, Camera], points: np.ndarray, model: int) -> None:
    cameras, images = struct.pack("<Q", len(views)), struct.pack("<Q", len(views))
    for i, (name, camera) in enumerate(views.items(), 1):
        lens, quat, shift = _numbers(camera, model)
        cameras += struct.pack(f"<iiQQ{len(lens)}d", i, model, camera.width, camera.height, *lens)
        images += struct.pack("<I7dI", 100 + i, *quat, *shift, i) + name.encode() + b"\0"
        images += struct.pack("<Q", 2) + struct.pack("<ddq", 1.5, 2.5, -1) * 2
    cloud = struct.pack("<Q", len(points))
    for i, point in enumerate(points, 1):
        cloud += struct.pack("<Q3d3BdQ", i, *point, 255, 51, 0, 0.5, 2) + struct.pack("<II", 1, 0) * 2
    for name, data in {"cameras": cameras, "images": images, "points3D": cloud}.items():
        (folder / f"{name}.bin").write_bytes(data)


def _write_text(folder: Path, views: dict[str, Camera], points: np.ndarray, model: int) -> None:
    kind = {PINHOLE: "PINHOLE", OPENCV: "OPENCV"}[model]
    cameras, images = ["# Camera list", "#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"], ["# Image list"]
    for i, (name, camera) in enumerate(views.items(), 1):
        lens, quat, shift = _numbers(camera, model)
        cameras.append(" ".join(map(str, [i, kind, camera.width, camera.height, *lens])))
        images.append(" ".join(map(str, [100 + i, *quat, *shift, i, name])))
        images.append("1.5 2.5 -1 3.5 4.5 7" if i % 2 else "")
    cloud = ["# 3D point list"]
    cloud += [" ".join(map(str, [i, *p, 255, 51, 0, 0.5, 1, 0])) for i, p in enumerate(points, 1)]
    for name, lines in {"cameras": cameras, "images": images, "points3D": cloud}.items():
        (folder / f"{name}.txt").write_text("\n".join(lines) + "\n")
