"""Scene summary of ``r5dgs info`` and ``bake``."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from .. import terminal
from ..scene import camera_correction, predictability, quality
from ..scene.motion_words import motion_of
from ..scene.scene import Scene


def summary(scene: Scene, path: Path | None = None) -> str:
    """Return the summary of a scene: duration, frames, extent, moving objects and quality, as lines.

    Args:
        path: File of the scene; an evaluation beside it provides the quality.
    """
    objects = [item for item in scene.objects if item.id > 0]
    first, fps = float(scene.tracks.times[0]), scene.frames_per_unit
    frames = round((scene.t_max - first) * fps) + 1
    moving = [(item, motion) for item in objects if (motion := observed_motion(scene, item.id)) is not None]
    outlooks = predictability.outlooks(scene)
    count = "1 object" if len(objects) == 1 else f"{len(objects)} objects"
    lines = [
        f"scene      {terminal.printable(scene.name)}: {len(scene.gaussians.means)} Gaussians, {count}",
        f"duration   {frames} frame{'s' * (frames != 1)}: scene time {first:g} to {scene.t_max:g}, then predicted",
        f"frames     {_rate(scene)}",
        f"extent     {scene.extent:.3g} world units" + _meters(scene),
        f"moving     {len(moving)} of {len(objects)} objects",
        *(f"  {terminal.printable(item.name)}: {motion}{_band(scene, outlooks[item.id])}" for item, motion in moving),
        f"quality    {quality.measure(scene, path).text()}",
        *_loss_of_baking(scene),
        *(f"cameras    {text}" for text in camera_correction.sizes(scene.provenance.get("cameras", {})).values()),
    ]
    return "\n".join(lines)


def _meters(scene: Scene) -> str:
    unit = scene.units.meters_per_unit
    return "" if unit is None else f" ({scene.extent * unit:.3g} m)"


def _rate(scene: Scene) -> str:
    """Return the number of Blender frames per unit of scene time and, if it is known, per second."""
    fps, seconds = scene.frames_per_unit, scene.units.seconds_per_unit
    if seconds is None:
        return f"{fps:g} per unit of scene time (per second if the data set's times are seconds)"
    return f"{fps / seconds:.4g} per second; a unit of scene time is {seconds:.4g} s"


def _band(scene: Scene, outlook: predictability.Outlook) -> str:
    """Return the half width of an object's confidence band in words, or "" if it is unknown."""
    if outlook.half_width is None:
        return ""
    share = f"{outlook.half_width_percent:.2g} % of its size"
    return f"; ± {outlook.half_width:.2g} world units ({share}) at t = {predictability.horizon(scene):g}"


def _loss_of_baking(scene: Scene) -> list[str]:
    """Return a line with the PSNR of checkpoint and scene on the training views; empty if it was not stored."""
    found = scene.provenance.get("training_views")
    values = [found.get(name) for name in ("checkpoint_psnr", "baked_psnr")] if isinstance(found, dict) else [None]
    if not all(isinstance(value, int | float) for value in values):
        return []
    return ["baking     checkpoint {:.2f} dB, scene {:.2f} dB on the training views".format(*values)]


def observed_motion(scene: Scene, object_id: int) -> str | None:
    """Return an object's largest displacement and turn in the observed time, and its later motion; None if it rests."""
    groups = [group for group in scene.groups if group.object_id == object_id and group.role == "body"]
    if not groups or motion_of(scene, groups) in ("still", "pinned"):
        return None
    poses = np.concatenate([scene.tracks.poses[group.id] for group in groups])
    away = float(np.linalg.norm(poses[:, 4:], axis=1).max())
    sines = np.clip(np.linalg.norm(poses[:, 1:4], axis=1), 0, 1)
    degrees = float(np.degrees(2 * np.arcsin(sines)).max())
    return f"{away:.2g} world units and {degrees:.0f} degrees from its last pose; then {motion_of(scene, groups)}"
