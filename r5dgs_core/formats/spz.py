"""Gaussians as SPZ files of Niantic: one time, quantised, world x right, y up, z back."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from .. import atomic_files, errors, extras
from ..playback import played_splats
from ..playback.scene_player import Player
from ..scene import cameras, sampling
from ..scene.scene import Scene
from . import registry, scene_nodes, turned_splats

EXTRA, PACKAGE = "export", "gsply"
_STEPS = (1 << 23) - 1  # largest fixed-point position
_MOST_BITS = 20  # fraction of a position
_DC = 127.5 / (0.15 * 255)  # largest stored coefficient of degree 0, and of the others
_SH = 127 / 128
_LOG_SCALES = (-10.0, 5.9375)
_TIMES = 8  # at which losses are counted


def export(scene: Scene, path: Path, options: registry.Options) -> Iterator[Path]:
    """Write the Gaussians at each time. Implements `registry.Format.write`."""
    with extras.required("SPZ files", EXTRA):
        import gsply
    player = Player(scene)
    axes = cameras.WORLD_TO_BLENDER["opengl"].T @ cameras.WORLD_TO_BLENDER[scene.world_convention]
    for t, target in scene_nodes.files(scene, options, FORMAT.paths(path, options, scene)):
        splats = turned_splats.turned(played_splats.at(player, t, options.object_ids), axes)
        content = gsply.GSData(
            means=splats.means,
            scales=splats.log_scales,
            quats=splats.quats,
            opacities=splats.opacity_logits,
            sh0=np.ascontiguousarray(splats.sh[:, 0]),
            shN=np.ascontiguousarray(splats.sh[:, 1:]),
        )
        farthest = max(float(np.abs(splats.means).max()), 2.0**-_MOST_BITS)
        bits = min(math.floor(math.log2(_STEPS / farthest)), _MOST_BITS)
        if bits < 0:
            raise errors.SceneFileError(f"{target}: SPZ holds positions up to {_STEPS}, found {farthest:g}")
        with registry.writing(target), atomic_files.replacing_by_name(target) as temporary:
            gsply.write_spz(temporary, content, fractional_bits=bits)
        yield target


def losses(scene: Scene, options: registry.Options) -> list[str]:
    """Parts of this scene that files do not hold, as sentences, from at most `_TIMES` of the times."""
    player, (low, high) = Player(scene), _LOG_SCALES
    wrong, sizes = np.zeros((2, len(scene.gaussians.means)), bool)
    for t in sampling.spread(options.times, _TIMES):
        rows = played_splats.rows_at(scene, t, options.object_ids)
        splats = played_splats.at(player, t, options.object_ids)
        wrong[rows] |= (np.abs(splats.sh[:, 0]) > _DC).any(-1) | (np.abs(splats.sh[:, 1:]) > _SH).any((1, 2))
        sizes[rows] |= ((splats.log_scales < low) | (splats.log_scales > high)).any(-1)
    found = scene_nodes.lost_frames(scene, options)
    if wrong.any():
        found.append(f"{int(wrong.sum())} Gaussians have colours beyond the range of SPZ, which are clipped")
    if sizes.any():
        found.append(f"{int(sizes.sum())} Gaussians have sizes beyond the range of SPZ, which are clipped")
    return found


FORMAT = registry.Format(
    name="spz",
    label="Compressed Gaussians, SPZ",
    suffix=".spz",
    keeps="Gaussians of one time with their shading (quantised), y up; one file per frame",
    loses="motion between frames, objects, names, sky, cameras",
    write=export,
    per_frame=True,
    losses=losses,
    extra=EXTRA,
    packages=(PACKAGE,),
)
