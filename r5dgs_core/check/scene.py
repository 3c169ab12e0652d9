"""Faults of a scene file: errors of the reader, and likely mistakes."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..findings import Collector, Finding
from ..motion import key_reduction, models
from ..scene import predictability, scene_file
from ..scene.scene import Scene
from ..scene.splats import to_opacities
from ..terminal import printable
from .codes import CODES

LAST_FRAME = 1_048_574  # Blender's last frame
_SEEN = 1 / 255  # minimum opacity that is drawn
_FEW_SEEN = 0.05  # share of visible Gaussians below which S16 is reported
_MAX_STEPS = 1 << 16  # maximum number of integration steps per motion


def check(path: Path) -> list[Finding]:
    """Return all faults of a scene file."""
    collect = Collector(CODES, "S01")
    scene: Scene | None = None
    with collect():
        scene = scene_file.read(path, collect)
    if scene is None or collect.findings:  # warnings rely on valid numbers
        return collect.findings
    if len(scene.gaussians.means) == 0:
        collect.add("S02", f"{path}: expected Gaussians, found none")
    for item in scene.objects:
        if item.count == 0 and item.id > 0:
            collect.add("S10", f"{path}: object {item.id} ({printable(item.name)}) has no Gaussians")
        for word in (item.name, *item.aliases):
            if not word.strip() or not word.isprintable():
                collect.add("S12", f"{path}: object {item.id}: the name '{printable(word)}' is empty or not printable")
    _check_gaussians(scene, path, collect)
    _check_motion(scene, path, collect)
    return collect.findings


def _check_gaussians(scene: Scene, path: Path, collect: Collector) -> None:
    if len(scene.gaussians.means) == 0:
        return
    with np.errstate(over="ignore"):
        large = int((np.exp(scene.gaussians.log_scales.astype(np.float64)).max(-1) > scene.extent).sum())
        seen = float((to_opacities(scene.gaussians.opacity_logits) >= _SEEN).mean())
    if large:
        collect.add("S11", f"{path}: {large} of {len(scene.gaussians.means)} Gaussians are larger than the scene")
    if seen < _FEW_SEEN:
        collect.add("S16", f"{path}: only {100 * seen:.1f} % of the Gaussians can be seen")


def _check_motion(scene: Scene, path: Path, collect: Collector) -> None:
    start = float(scene.tracks.times[0])
    end = predictability.horizon(scene)
    last = max(abs(t) * scene.frames_per_unit for t in (start, end))
    if last > LAST_FRAME:
        collect.add("S15", f"{path}: expected frames up to {LAST_FRAME:,}, found {last:.4g}")
    taus = np.linspace(0.0, end - scene.t_max, 17)
    for group in scene.groups:
        place = f"{path}: motion group {group.id}"
        with np.errstate(all="ignore"):
            quats, moved, spins, _ = models.curve(group.model, taus, _MAX_STEPS)
        if not (np.isfinite(quats).all() and np.isfinite(moved).all()):
            collect.add("S13", f"{place}: not finite between t_max and {end:g}")
        elif float(np.linalg.norm(spins, axis=-1).max()) / scene.frames_per_unit > key_reduction.MAX_FRAME_TURN_RAD:
            collect.add(
                "S14",
                f"{place}: turns by more than {np.degrees(key_reduction.MAX_FRAME_TURN_RAD):.0f} degrees per frame",
            )
