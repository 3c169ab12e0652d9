"""Import of another project's run folder as a scene (`r5dgs import`). Documentation: docs/user/import.md."""

from __future__ import annotations

import dataclasses
import logging
import math
from pathlib import Path
from typing import Any

import numpy as np

from .. import __version__
from ..data import dataset as datasets
from ..data import frame_rate
from ..data import origin as origins
from ..data.dataset import Dataset
from ..errors import CheckpointError, ConfigError
from ..scene import cameras, spherical_harmonics, validation
from ..scene.scene import Scene
from . import assembly, cameras_json, deformable, freegave, gaussian_splatting, run_folder, trace, weights
from .foreign_run import ForeignRun
from .run_folder import RunFolder

MAX_KNOTS = 10_000  # limit without --knots
ROUNDING = 1e-9  # minimum motion, as a share of the extent
_log = logging.getLogger(__name__)


@dataclasses.dataclass(frozen=True)
class Options:
    """User options of an import.

    Attributes:
        iteration: Iteration to read; None for the last.
        data: Data set that the run was trained on; gives cameras, times and world axes.
        knots: Number of times at which the deformation is sampled; None for the data set's times, or
            `data.frame_rate.DEFAULT` per unit of time.
        t_max: Last time of the deformation; None for that of the run, else of the data set, else 1.
        world: Axes of the world, a key of `cameras.WORLD_TO_BLENDER`.
        still: Motion that is dropped, as a share of the scene's extent.
    """

    iteration: int | None = None
    data: Path | None = None
    knots: int | None = None
    t_max: float | None = None
    world: str | None = None
    still: float = assembly.STILL

    def __post_init__(self) -> None:
        if self.knots is not None and self.knots < 2:
            raise ConfigError(f"--knots {self.knots}: expected at least 2, the first and the last time")
        if self.t_max is not None and not (math.isfinite(self.t_max) and self.t_max > 0):
            raise ConfigError(f"--t-max {self.t_max:g}: expected a positive time")
        if not (math.isfinite(self.still) and self.still >= 0):
            raise ConfigError(f"--still {self.still:g}: expected a share of the scene's extent, 0 or more")
        if self.world is not None and self.world not in cameras.WORLD_TO_BLENDER:
            raise ConfigError(f"--world {self.world}: expected one of {', '.join(cameras.WORLD_TO_BLENDER)}")


def read(run: RunFolder, t_max: float | None = None) -> ForeignRun:
    """Read a run folder with the reader of its layout.

    Args:
        t_max: Last time of the deformation, if given by the user.

    Raises:
        CheckpointError, SceneFileError: A file is missing, damaged, holds code, or is of an unknown layout.
    """
    if not run.deforms:
        return gaussian_splatting.read(run)
    if "vel.pth" not in run.files:
        return dataclasses.replace(deformable.read(run), t_max=t_max)
    t_max = run.max_time() if t_max is None else t_max
    velocity = weights.load(run.weights("vel.pth"))
    return (freegave if freegave.BANK in velocity else trace).read(run, velocity, t_max)


def import_run(folder: Path, options: Options = Options(), progress: assembly.Progress | None = None) -> Scene:
    """Convert a run folder of 3DGS, Gaussian Grouping, Deformable-3DGS, TRACE or FreeGave to a scene.

    Args:
        progress: Called with the number of sampled Gaussians and their total.

    Raises:
        R5dgsError: The folder or the data set cannot be used; the message names the reason.
    """
    run = run_folder.open_run(folder, options.iteration)
    dataset = None if options.data is None else datasets.read(options.data, min_registered=0.0).relative_to(np.zeros(3))
    foreign = read(run, options.t_max)
    motion, times = None, np.zeros(1)
    if foreign.state is not None:
        times = _times(run, foreign, dataset, options)
        motion = assembly.sample(foreign, times, max(options.still, ROUNDING) * _extent(foreign), progress)
    white = bool(run.config.get("white_background", foreign.dynamics is not None))
    scene = assembly.make_scene(
        foreign,
        motion,
        times,
        name=run.folder.resolve().name,
        frames_per_unit=frame_rate.DEFAULT if dataset is None else dataset.frames_per_unit,
        world_convention=_world(run, foreign, dataset, options),
        cameras=cameras_json.read(run.folder / "cameras.json") if dataset is None else dataset.cameras,
        background_sh=spherical_harmonics.rgb_to_dc(np.full((1, 3), float(white))).astype(np.float32),
        provenance={
            "imported": {
                "layout": run_folder.TITLES[foreign.kind],
                "folder": str(run.folder.resolve()),
                "iteration": run.iteration,
                "settings": {key: _plain(value) for key, value in run.config.items()},
            },
            "versions": {"r5dgs": __version__},
        },
    )
    scene = _among_cameras(scene, run.folder)
    validation.check(scene, str(run.folder))
    return scene


def _among_cameras(scene: Scene, folder: Path) -> Scene:
    """Move the scene's origin to its cameras if they are far from the world's origin."""
    if not scene.cameras:
        return scene
    origin = origins.find(np.stack([camera.center for camera in scene.cameras]), f"{folder}: cameras")
    if not origin.any():
        return scene
    _log.warning(
        "%s: the run is far from the origin of its world, so its positions are stored to %.2g units only. "
        "Train it nearer to the origin for sharp pictures",
        folder,
        np.spacing(np.float32(np.abs(origin).max())),
    )
    return dataclasses.replace(
        scene.with_arrays(means=(scene.gaussians.means.astype(np.float64) - origin).astype(np.float32), origin=origin),
        cameras=tuple(cameras.translated(camera, -origin) for camera in scene.cameras),
    )


def _times(run: RunFolder, foreign: ForeignRun, dataset: Dataset | None, options: Options) -> np.ndarray:
    """Knots, the last at t_max. [S]"""
    t_max = foreign.t_max
    if t_max is None:
        t_max = 1.0 if dataset is None else dataset.t_max
    if t_max <= 0:
        raise CheckpointError(f"{run.folder}: expected motion up to a time after 0, found t_max {t_max:g}")
    if options.knots is not None:
        return np.linspace(0.0, t_max, options.knots)
    if dataset is None:
        knots = max(2, round(frame_rate.DEFAULT * t_max) + 1)
        if knots > MAX_KNOTS:
            raise CheckpointError(
                f"{run.folder}: the last time {t_max:g} requires more than {MAX_KNOTS} knots; give their number "
                "with --knots, or the time with --t-max"
            )
        return np.linspace(0.0, t_max, knots)
    seen = dataset.times[dataset.times < t_max - 1e-6]
    return np.concatenate([seen if len(seen) else [0.0], [t_max]])


def _extent(foreign: ForeignRun) -> float:
    """Diagonal of the box that contains the middle 98 % of the centres, as in `Scene.extent`."""
    if len(foreign.splats.means) == 0:
        return 1.0
    low, high = np.quantile(foreign.splats.means, [0.01, 0.99], axis=0)
    return max(float(np.linalg.norm(high - low)), 1e-12)


def _world(run: RunFolder, foreign: ForeignRun, dataset: Dataset | None, options: Options) -> str:
    """World axes: from the user or the data set; else Blender's for runs trained on Blender data, else COLMAP's."""
    if options.world is not None:
        return options.world
    if dataset is not None:
        return dataset.world_convention
    source = run.config.get("source_path")
    blender = bool(run.config.get("is_blender", foreign.dynamics is not None))
    if not blender and isinstance(source, str) and source:
        blender = (Path(source) / "transforms_train.json").is_file()
    world = "blender" if blender else "colmap"
    _log.info("%s: assuming the world axes of %s; change them with --world", run.folder, world)
    return world


def _plain(value: Any) -> Any:
    """Convert a setting to JSON types."""
    whole = isinstance(value, int) and abs(value) < 1 << 63
    if value is None or whole or (isinstance(value, float) and math.isfinite(value)):
        return value
    if isinstance(value, str):
        return value.encode("utf-8", "backslashreplace").decode()
    return [_plain(item) for item in value] if isinstance(value, list | tuple) else f"{value!a:.200}"
