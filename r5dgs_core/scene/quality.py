"""Known error of a scene: measured image quality, and observed motion that the rigid groups do not explain."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from .. import errors, strict_json
from .scene import Scene

MODE = "rigid"  # Blender's playback mode, see `playback.modes.MODES`


@dataclass(frozen=True)
class Quality:
    """Image and motion error of a scene, as far as known.

    Attributes:
        psnr_observed: PSNR of held-out views in the observed time, dB, or None.
        psnr_later: PSNR of views past t_max, dB, or None.
        rigid_rms: Root mean square distance of Gaussians from the rigid motion of their group in the observed time,
            relative to the scene's extent; None if not measured.
        bending: Number of Gaussians with residuals: motion that their group does not explain.
    """

    psnr_observed: float | None
    psnr_later: float | None
    rigid_rms: float | None
    bending: int

    def text(self) -> str:
        """One-line summary for users."""
        if self.psnr_observed is not None:
            later = "" if self.psnr_later is None else f", {self.psnr_later:.1f} dB past the observed time"
            return f"held-out views {self.psnr_observed:.1f} dB PSNR{later}"
        if self.psnr_later is not None:
            return f"views past the observed time {self.psnr_later:.1f} dB PSNR"
        if self.rigid_rms is not None:
            return f"motion {100 * self.rigid_rms:.2g} % of the scene's size (rms); picture error not measured"
        return "error not measured; run 'r5dgs evaluate'"


def measure(scene: Scene, path: Path | None = None) -> Quality:
    """Collect the known errors of a scene.

    Args:
        scene: The scene.
        path: Its file, or None. An evaluation beside it is used if it is not older and has the same scene name and
            number of Gaussians.

    Returns:
        The known errors.
    """
    splits = _evaluation(scene, path)
    counts = (
        np.bincount(scene.gaussians.motion_ids, minlength=len(scene.groups))
        if len(scene.gaussians.means)
        else np.zeros(0)
    )
    squares = [count * group.rigid_rms**2 for count, group in zip(counts, scene.groups, strict=False)]
    measured = any(group.rigid_max > 0 for group in scene.groups)
    rms = float(np.sqrt(sum(squares) / max(counts.sum(), 1))) / scene.extent if measured else None
    bending = 0 if scene.residuals is None else len(scene.residuals.rows)
    return Quality(_psnr(splits, "val"), _psnr(splits, "test"), rms, bending)


def _evaluation(scene: Scene, path: Path | None) -> dict[str, Any]:
    """Splits of the evaluation beside a scene file; empty if no evaluation of this scene exists."""
    if path is None:
        return {}
    for place in (path.with_suffix(".evaluation.json"), path.with_name("evaluation.json")):
        try:
            if place.stat().st_mtime < path.stat().st_mtime:
                continue
            found = strict_json.read(place, errors.SceneFileError)
            if found["scene"] == scene.name and found["train"]["gaussians"] == len(scene.gaussians.means):
                return found["splits"]
        except (OSError, errors.SceneFileError, KeyError, TypeError):  # missing, or not an evaluation
            continue
    return {}


def _psnr(splits: dict[str, Any], split: str) -> float | None:
    try:
        value = splits[split][MODE]["psnr"]
    except (KeyError, TypeError):
        return None
    return float(value) if isinstance(value, int | float) else None
