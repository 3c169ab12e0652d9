"""Poses of objects as JSON (docs/reference/poses.md)."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from .. import atomic_files
from ..playback.object_poses import ObjectPoses
from ..scene.scene import Scene
from . import pose_table, registry

FORMAT_NAME, FORMAT_VERSION = "r5dgs poses", 1


def export(scene: Scene, path: Path, options: registry.Options) -> Iterator[Path]:
    """Write the poses at all times to one file. Implements `registry.Format.write`."""
    table = pose_table.make(scene, options)
    head = {"format": FORMAT_NAME, "format_version": FORMAT_VERSION, **table.header}
    content = {
        **head,
        "times": table.times.tolist(),
        "scene_times": table.scene_times.tolist(),
        "predicted": table.predicted.tolist(),
        "objects": [_entry(one) for one in table.objects],
    }
    with registry.writing(path):
        atomic_files.write(path, (json.dumps(content, indent=1, allow_nan=False) + "\n").encode())
    yield path


def _entry(one: ObjectPoses) -> dict[str, Any]:
    return {
        "id": one.object_id,
        "name": one.name,
        "part": one.part,
        "positions": one.positions.tolist(),
        "quaternions_wxyz": one.quats.tolist(),
        "velocities": one.velocities.tolist(),
        "angular_velocities_rad": one.angular_velocities.tolist(),
        "band_level": one.level,
        "half_widths": _known(one.half_widths),
        "half_angles_rad": _known(one.half_angles),
    }


def _known(values: np.ndarray) -> list[float | None]:
    return [value if np.isfinite(value) else None for value in values.tolist()]


FORMAT = registry.Format(
    name="poses",
    label="Poses",
    suffix=".json",
    keeps=pose_table.KEEPS,
    loses=pose_table.LOSES,
    write=export,
    has_times=True,
    losses=pose_table.losses,
)
