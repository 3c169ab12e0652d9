"""Data sets of three static cameras that watch a swinging ball, sound or with one fault of a capture."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from r5dgs_core.data import images
from r5dgs_core.scene import cameras as scene_cameras
from r5dgs_core.scene.cameras import Camera
from tests.support import recordings

COUNT, WIDTH, HEIGHT = 30, 160, 120
SECONDS = 1.5
TIMES = np.arange(COUNT) / COUNT
STEP = 1 / COUNT

Draw = Callable[[recordings.Rig, int, float], np.ndarray]


def draw(rig: recordings.Rig, camera: int, t: float) -> np.ndarray:
    """Draw a camera's image at a scene time. [H, W, 3] uint8"""
    return recordings.draw_ball(rig.cameras[camera], rig.lenses[camera], t * SECONDS)


def make(
    root: Path,
    *,
    drawn: Draw = draw,
    angles: Sequence[float] | None = None,
    turned: np.ndarray | None = None,
    times: Sequence[np.ndarray] = (TIMES, TIMES, TIMES),
    masks: Callable[[recordings.Rig, int, float], np.ndarray] | None = None,
) -> Path:
    """Write a data set.

    Args:
        root: Where to.
        drawn: Function that draws an image.
        angles: Angle of each camera on its circle, radians.
        turned: Rotation of the last camera about itself. [3, 3]
        times: Scene times of each camera.
        masks: Function that draws a mask; None for no masks.
    """
    rig = recordings.make_rig(3, WIDTH, HEIGHT, angles=angles)
    data = {}
    for k, name in enumerate(rig.names):
        frames = []
        for number, t in enumerate(times[k]):
            path = f"images/{name}/{number:04d}.png"
            images.write_png(root / path, drawn(rig, k, t))
            frames.append({"file_path": path, "time": float(t)})
            if masks is not None:
                images.write_png(root / "object_mask" / path, masks(rig, k, t).astype(np.uint8))
        pose = np.array(rig.cameras[k].T_cam_world)
        if turned is not None and k == 2:
            pose[:3] = turned @ pose[:3]
        f, cx, cy = rig.lenses[k].fx, rig.lenses[k].cx, rig.lenses[k].cy
        matrix = scene_cameras.cam_world_to_opengl(pose).tolist()
        data[name] = {"fl_x": f, "fl_y": f, "cx": cx, "cy": cy, "transform_matrix": matrix, "frames": frames}
    content = {"frames_per_unit": 30.0, "seconds_per_unit": SECONDS, "data": data}
    (root / "transforms_train.json").write_text(json.dumps(content))
    return root


def ball_mask(camera: Camera, t: float) -> np.ndarray:
    """Mask of the ball. [H, W] bool"""
    center = camera.T_cam_world[:3, :3] @ recordings.ball(t * SECONDS) + camera.T_cam_world[:3, 3]
    u, v, _ = camera.intrinsics @ center / center[2]
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    return np.hypot(x - u, y - v) < 0.22 * camera.intrinsics[0, 0] / center[2]


def dimmed(color: tuple[float, float, float]) -> Draw:
    """Drawing in which the light of the second camera falls by some stops per color over time."""

    def drawn(rig: recordings.Rig, camera: int, t: float) -> np.ndarray:
        pixels = draw(rig, camera, t)
        if camera != 1:
            return pixels
        factor = 2.0 ** (-t * np.array(color) / 2.2)
        return (pixels * factor).astype(np.uint8)

    return drawn


def blurred(rig: recordings.Rig, camera: int, t: float) -> np.ndarray:
    """Draw the second half of the second camera's images over three intervals instead of at one time."""
    if camera != 1 or t < 0.5:
        return draw(rig, camera, t)
    parts = [draw(rig, camera, t + share * 3 * STEP).astype(np.float32) for share in np.linspace(-0.5, 0.5, 15)]
    return np.mean(parts, axis=0).astype(np.uint8)


def rolling(rig: recordings.Rig, camera: int, t: float) -> np.ndarray:
    """Draw rows one after the other, during a whole interval."""
    bands = np.array_split(np.arange(HEIGHT), 30)
    parts = [draw(rig, camera, t + STEP * (rows.mean() / HEIGHT - 0.5))[rows] for rows in bands]
    return np.concatenate(parts)


def late(rig: recordings.Rig, camera: int, t: float) -> np.ndarray:
    """Draw the second camera's images half an interval late."""
    return draw(rig, camera, t + (0.5 * STEP if camera == 1 else 0.0))


def repeated(rig: recordings.Rig, camera: int, t: float) -> np.ndarray:
    """Draw every tenth image of the second camera like the one before it."""
    number = round(t / STEP)
    return draw(rig, camera, t - STEP if camera == 1 and number % 10 == 5 else t)


def named(root: Path, names: dict[str, str]) -> Path:
    """Write names of the ids; returns the folder."""
    (root / "objects.json").write_text(json.dumps(names))
    return root


def disagreeing(rig: recordings.Rig, camera: int, t: float) -> np.ndarray:
    """Mask of the ball, on the wrong side of the second camera's images."""
    mask = ball_mask(rig.cameras[camera], t)
    return mask[::-1, ::-1] if camera == 1 else mask


def lonely(rig: recordings.Rig, camera: int, t: float) -> np.ndarray:
    """Mask of the ball, and of a second object in the first camera alone."""
    mask = ball_mask(rig.cameras[camera], t).astype(np.uint8)
    if camera == 0:
        mask[2:8, 2:8] = 2
    return mask
