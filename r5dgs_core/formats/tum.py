"""Trajectories of objects in the format of the TUM RGB-D benchmark: one file for each object or part."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from .. import atomic_files
from ..scene.scene import Scene
from . import pose_table, registry

COLUMNS = "timestamp tx ty tz qx qy qz qw"
_LONGEST = 80  # characters of a name


def export(scene: Scene, path: Path, options: registry.Options) -> Iterator[Path]:
    """Write the poses of each object to a file of its own. Implements `registry.Format.write`."""
    table = pose_table.make(scene, options)
    order = np.argsort(table.times, kind="stable")
    head = [f"# {key}: {value}" for key, value in table.header.items() if key != "velocity"]
    for one, target in zip(table.objects, FORMAT.paths(path, options, scene), strict=True):
        rows = np.column_stack([table.times, one.positions, one.quats[:, [1, 2, 3, 0]]])[order]
        lines = [f"# object {one.object_id}: {one.label!r}", *head, f"# {COLUMNS}"]
        lines += [" ".join(map(repr, row)) for row in rows.tolist()]
        with registry.writing(target):
            atomic_files.write(target, ("\n".join(lines) + "\n").encode())
        yield target


def _parts(scene: Scene, options: registry.Options) -> list[str]:
    """Part of the file name for each object: letters, digits and underscores, each once."""
    found: list[str] = []
    for one in pose_table.make(scene, dataclasses.replace(options, times=options.times[:1])).objects:
        name = re.sub(r"\W+", "_", one.label).strip("_")[:_LONGEST] or str(one.object_id)
        while name in found:
            name += f"_{one.group}"
        found.append(name)
    return found


FORMAT = registry.Format(
    name="tum",
    label="Trajectories",
    suffix=".txt",
    keeps="position and rotation of objects and parts at any times, one file each",
    loses="velocities, bands, Gaussians, colours, bending of Gaussians, cameras",
    write=export,
    has_times=True,
    parts=_parts,
    losses=pose_table.losses,
)
