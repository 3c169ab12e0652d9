"""Public functions of the package, which ``r5dgs_core`` exports lazily (docs/reference/python.md)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .motion import se3
from .playback.scene_player import Player
from .scene import scene_file
from .scene.cameras import Camera
from .scene.scene import Scene


def load(path: str | Path) -> Scene:
    """Read a ``.r5dgs`` file. Raises `SceneFileError` if it is missing or damaged."""
    return scene_file.read(Path(path))


def save(scene: Scene, path: str | Path) -> Path:
    """Write a scene to a ``.r5dgs`` file atomically, and return the path."""
    return scene_file.write(scene, Path(path))


def poses(scene: Scene, t: float, mode: str = "rigid") -> dict[str, np.ndarray]:
    """Return the motion of each object from t_max to a time.

    Args:
        scene: The scene.
        t: Scene time; may exceed t_max.
        mode: Playback mode past t_max.

    Returns:
        Matrix of each object by its name, which maps world positions at t_max to those at ``t``: the pose of the
        object's first rigid body, or the identity for objects at rest. [4, 4] float64
        ``scene.predictability.warnings`` names objects whose motion past t_max is not predictable, and
        ``scene.predictability.outlooks`` has the half widths of their confidence bands.
    """
    quats, displacements = Player(scene, mode).group_poses(t)
    bodies = {group.object_id: group for group in reversed(scene.groups) if group.role == "body"}
    found = {}
    for item in scene.objects:
        matrix = np.eye(4)
        if item.id in bodies:
            group = bodies[item.id]
            matrix = se3.pose_to_matrix(group.pivot, quats[group.id], displacements[group.id])
        if item.id > 0:
            found[item.name] = matrix
    return found


def picture(scene: Scene, t: float, camera: Camera | int = 0, mode: str = "rigid") -> np.ndarray:
    """Render a scene at a time.

    Args:
        scene: The scene.
        t: Scene time; may exceed t_max.
        camera: A camera, or the index of one of ``scene.cameras``.
        mode: Playback mode past t_max.

    Returns:
        Display-referred sRGB in [0, 1], top row first. [H, W, 3] float32
    """
    from .render import scene_renderer

    view = scene.cameras[camera] if isinstance(camera, int) else camera
    return np.clip(scene_renderer.render(Player(scene, mode), view, t).color, 0, 1)


def train_scene(
    data: str | Path,
    run: str | Path,
    *,
    preset: str | None = None,
    settings: Sequence[str] = (),
    resume: bool = False,
    overwrite: bool = False,
) -> Scene:
    """Train a run folder from a data set, and return the baked scene.

    Args:
        data: Folder of the data set.
        run: Run folder, created if it is missing.
        preset: Named settings: "fast", "cpu" or "paper".
        settings: Values of configuration keys, for example ``["train.iterations=3000"]``.
        resume: True to continue a stopped run with its own configuration.
        overwrite: True to replace an existing run.

    Raises:
        ConfigError: A setting is unknown or invalid.
        DatasetError: The data set cannot be read.
        CheckpointError: The run folder cannot be used.
        Interrupted: SIGINT or SIGTERM was received; continue with ``resume``.
    """
    from .bake import bake
    from .config import config
    from .data import dataset
    from .train import run as training

    chosen = config.load(None, tuple(settings), preset)
    finished = training.train(Path(data), Path(run), chosen, resume=resume, overwrite=overwrite)
    kept = finished.config.data
    return bake.bake(finished, dataset.read(Path(data), kept.masks, kept.min_registered))


def evaluate(scene: Scene, data: str | Path, modes: Sequence[str] = ("rigid",)) -> dict[str, Any]:
    """Measure a scene on the held-out views of a data set; returns the content of ``evaluation.json``.

    Args:
        scene: The scene.
        data: Folder of the data set.
        modes: Playback modes past t_max.
    """
    from .data import dataset
    from .evaluation import evaluate as evaluation

    found = dataset.read(Path(data), min_registered=0.0).relative_to(scene.origin)
    return evaluation.evaluate(scene, found, modes=tuple(modes))
