"""What is known of a scene's error: what its evaluation measured, and what its motion leaves out."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from .. import errors, strict_json
from .scene import Scene

MODE = "rigid"  # how Blender plays, see `playback.MODES`


@dataclass(frozen=True)
class Quality:
    """Error of a scene's pictures and of its motion, as far as it is known.

    Attributes:
        psnr_observed: Of held-out views in the observed time, dB, or None.
        psnr_later: Of views past t_max, dB, or None.
        rigid_rms: Root mean square distance of Gaussians from the rigid motion of their group in the observed time, as
            a share of the scene's extent; None where it was not measured.
        bending: Number of Gaussians with residuals: the part of the observed motion that no group's motion explains.
    """

    psnr_observed: float | None
    psnr_later: float | None
    rigid_rms: float | None
    bending: int

    def text(self) -> str:
        """In a line, for people."""
        if self.psnr_observed is not None:
            later = "" if self.psnr_later is None else f", {self.psnr_later:.1f} dB past the observed time"
            return f"held-out views {self.psnr_observed:.1f} dB PSNR{later}"
        if self.psnr_later is not None:
            return f"views past the observed time {self.psnr_later:.1f} dB PSNR"
        if self.rigid_rms is not None:
            return f"motion {100 * self.rigid_rms:.2g} % of the scene's size (rms); picture error not measured"
        return "error not measured; 'r5dgs evaluate' does"


def of(scene: Scene, path: Path | None = None) -> Quality:
    """What is known of a scene's error.

    Args:
        scene: The scene.
        path: Its file. An evaluation beside it counts where it is not older and is of a scene of this name and number
            of Gaussians.

    Returns:
        What is known.
    """
    splits = _evaluation(scene, path)
    counts = np.bincount(scene.motion_ids, minlength=len(scene.groups)) if len(scene.means) else np.zeros(0)
    squares = [count * group.rigid_rms**2 for count, group in zip(counts, scene.groups, strict=False)]
    measured = any(group.rigid_max > 0 for group in scene.groups)
    rms = float(np.sqrt(sum(squares) / max(counts.sum(), 1))) / scene.extent if measured else None
    bending = 0 if scene.residual_rows is None else len(scene.residual_rows)
    return Quality(_psnr(splits, "val"), _psnr(splits, "test"), rms, bending)


def _evaluation(scene: Scene, path: Path | None) -> dict[str, Any]:
    """The splits of the evaluation beside a scene file; empty where there is none of this scene."""
    if path is None:
        return {}
    for place in (path.with_suffix(".evaluation.json"), path.with_name("evaluation.json")):
        try:
            if place.stat().st_mtime < path.stat().st_mtime:
                continue
            found = strict_json.read(place, errors.SceneFileError)
            if found["scene"] == scene.name and found["train"]["gaussians"] == len(scene.means):
                return found["splits"]
        except (OSError, errors.SceneFileError, KeyError, TypeError):  # not there, or no evaluation
            continue
    return {}


def _psnr(splits: dict[str, Any], split: str) -> float | None:
    try:
        value = splits[split][MODE]["psnr"]
    except (KeyError, TypeError):
        return None
    return float(value) if isinstance(value, int | float) else None
