"""Copies of a data set with wrong cameras, and the error of cameras up to what no image shows."""

from __future__ import annotations

import dataclasses
import json
import math
import shutil
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from scipy import optimize
from scipy.spatial.transform import Rotation

from r5dgs_core.data import dataset as datasets
from r5dgs_core.data import images, transforms
from r5dgs_core.scene import cameras
from r5dgs_core.scene.camera_correction import Correction
from r5dgs_core.scene.cameras import Camera
from r5dgs_core.train import normalization


def draw_errors(
    dataset: datasets.Dataset, pixels: float, gain: float, rng: np.random.Generator
) -> dict[str, Correction]:
    """Return errors of the training cameras by name.

    Half of the shift of the picture comes from a rotation and half from a shift of the camera; about the optical axis
    and along it they are twice as large.

    Args:
        dataset: The data set.
        pixels: Standard deviation of the shift of the picture along each axis, px.
        gain: Standard deviation of the gain of each colour.
        rng: Random generator.
    """
    norm = normalization.from_cameras([view.camera for view in dataset.train])
    depth = norm.scale * normalization.TARGET_DISTANCE
    result = {}
    for name, camera in training_cameras(dataset).items():
        unit = pixels / camera.intrinsics[0, 0] / math.sqrt(2) * np.array([1, 1, 2.0])
        turn, shift = rng.normal(size=3) * unit, rng.normal(size=3) * unit * depth
        result[name] = Correction(rotvec=turn, shift=shift, gain=np.diag(1 + gain * rng.normal(size=3)))
    return result


def training_cameras(dataset: datasets.Dataset) -> dict[str, Camera]:
    """Return the distinct cameras of the training split by name."""
    return {view.camera.name: view.camera for view in reversed(dataset.train)}


def write(data: Path, errors: Mapping[str, Correction], out: Path) -> Path:
    """Write a copy of a data set with wrong poses and colours of the training views; returns its folder."""
    dataset = datasets.read(data)
    shutil.copytree(data, out)
    path = out / "transforms_train.json"
    content = json.loads(path.read_text(encoding="utf-8"))
    views = {view.name: view for view in dataset.train}
    for part in [content, *content.get("data", {}).values()]:
        for frame in part.get("frames", ()):
            view = views[transforms.view_name(frame["file_path"])]
            error = errors[view.camera.name]
            camera = error.camera(view.camera)
            frame["transform_matrix"] = cameras.cam_world_to_opengl(camera.T_cam_world).tolist()
            if error.changes_colors:
                picture = datasets.load_rgba(view)
                picture[..., :3] = np.clip(error.seen(picture[..., :3]), 0, 1)
                file = out / view.image_path.relative_to(data)
                file.unlink()
                images.write_png(file.with_suffix(".png"), picture if dataset.has_alpha else picture[..., :3])
    path.write_text(json.dumps(content), encoding="utf-8")
    return out


def distance(found: Mapping[str, Camera], true: Mapping[str, Camera]) -> tuple[float, float]:
    """Return the distance between the pictures of found and true cameras, rms px: as they are, and at best.

    A similarity of the world, which no image shows, is fitted for the second number.
    """
    norm = normalization.from_cameras(list(true.values()))
    depth = norm.scale * normalization.TARGET_DISTANCE
    points = norm.origin + np.random.default_rng(0).normal(size=(200, 3)) * 0.15 * depth

    def differences(world: np.ndarray) -> np.ndarray:
        rows = []
        for name, camera in found.items():
            moved = _in_world(camera, world, norm.origin, depth)
            rows.append(cameras.project(moved, points)[0] - cameras.project(true[name], points)[0])
        return np.concatenate(rows).ravel()

    best = optimize.least_squares(differences, np.zeros(7)).x
    given, aligned = (float(np.sqrt(2 * np.mean(differences(world) ** 2))) for world in (np.zeros(7), best))
    return given, aligned


def _in_world(camera: Camera, world: np.ndarray, origin: np.ndarray, depth: float) -> Camera:
    """Return the camera in a world that is turned, shifted (in depths) and scaled about the origin. [7]"""
    turn, scale = Rotation.from_rotvec(world[:3]).as_matrix(), math.exp(world[6])
    T = camera.T_cam_world.copy()
    center = T[:3, :3] @ (origin + world[3:6] * depth) + T[:3, 3]
    T[:3, :3] = T[:3, :3] @ turn
    T[:3, 3] = scale * center - T[:3, :3] @ origin
    return dataclasses.replace(camera, T_cam_world=T)
