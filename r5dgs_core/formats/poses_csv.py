"""Poses of objects as comma-separated values: one row for each object and time (docs/reference/poses.md)."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterator
from pathlib import Path

from .. import atomic_files
from ..scene.scene import Scene
from . import pose_table, registry

COLUMNS = (
    *("id", "name", "part", "time", "scene_time", "predicted", "x", "y", "z", "qw", "qx", "qy", "qz"),
    *("vx", "vy", "vz", "wx", "wy", "wz", "half_width", "half_angle_rad", "band_level"),
)


def export(scene: Scene, path: Path, options: registry.Options) -> Iterator[Path]:
    """Write the poses at all times to one file. Implements `registry.Format.write`."""
    table = pose_table.make(scene, options)
    stream = io.StringIO()
    for key, value in table.header.items():
        stream.write(f"# {key}: {value if isinstance(value, str) else json.dumps(value)}\n")
    rows = csv.writer(stream, lineterminator="\n")
    rows.writerow(COLUMNS)
    for one in table.objects:
        numbers = (one.positions, one.quats, one.velocities, one.angular_velocities)
        for k, (time, scene_time, predicted) in enumerate(
            zip(table.times.tolist(), table.scene_times.tolist(), table.predicted.tolist(), strict=True)
        ):
            head = (one.object_id, one.name, one.part or "", time, scene_time, int(predicted))
            values = [value for columns in numbers for value in columns[k].tolist()]
            known = one.level is not None and predicted
            band = (float(one.half_widths[k]), float(one.half_angles[k]), one.level) if known else ("", "", "")
            rows.writerow((*head, *values, *band))
    with registry.writing(path):
        atomic_files.write(path, stream.getvalue().encode())
    yield path


FORMAT = registry.Format(
    name="poses_csv",
    label="Pose Table",
    suffix=".csv",
    keeps=pose_table.KEEPS,
    loses=pose_table.LOSES,
    write=export,
    has_times=True,
    losses=pose_table.losses,
)
