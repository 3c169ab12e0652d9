"""Gaussians as SOG files of PlayCanvas, made by the program splat-transform: one time, quantised.

The axes are those of PLY files of 3DGS, x right, y down, z forward, which viewers of SOG turn upright.
"""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path

from .. import atomic_files, errors
from ..playback import played_splats
from ..playback.scene_player import Player
from ..scene import cameras
from ..scene.scene import Scene
from . import ply, registry, scene_nodes, turned_splats

PROGRAM = "splat-transform"
REMEDY = "npm install -g @playcanvas/splat-transform@2.7.1"


def export(scene: Scene, path: Path, options: registry.Options) -> Iterator[Path]:
    """Write the Gaussians at each time. Implements `registry.Format.write`."""
    player, program = Player(scene), shutil.which(PROGRAM)
    if program is None:
        raise errors.BackendError(str(FORMAT.why_unavailable()))
    axes = cameras.WORLD_TO_BLENDER["colmap"].T @ cameras.WORLD_TO_BLENDER[scene.world_convention]
    for t, target in scene_nodes.files(scene, options, FORMAT.paths(path, options, scene)):
        splats = turned_splats.turned(played_splats.at(player, t, options.object_ids), axes)
        with (
            registry.writing(target),
            tempfile.TemporaryDirectory() as folder,
            atomic_files.replacing_by_name(target) as temporary,
        ):
            source = ply.write(splats, Path(folder) / "gaussians.ply", plain=True)
            command = [program, "--quiet", "--overwrite", "--gpu", "cpu", source, temporary]
            done = subprocess.run(command, capture_output=True, text=True)
            if done.returncode or not temporary.stat().st_size:
                said = (done.stderr or done.stdout).strip().splitlines()
                raise errors.BackendError(f"{target}: {PROGRAM} failed: {said[-1] if said else done.returncode}")
        yield target


FORMAT = registry.Format(
    name="sog",
    label="Compressed Gaussians, SOG",
    suffix=".sog",
    keeps="Gaussians of one time with their shading (quantised), y down; one file per frame",
    loses="motion between frames, objects, names, sky, cameras",
    write=export,
    per_frame=True,
    losses=scene_nodes.lost_frames,
    program=PROGRAM,
    remedy=REMEDY,
)
