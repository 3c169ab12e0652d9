"""Stability cases on training: a few steps on extreme but valid data.

A case passes if all trained values are finite. Data that cannot be trained may be refused by a `TrainingError` or
`DatasetError` with the reason.
"""

from __future__ import annotations

import functools
import json
import logging
import tempfile
from pathlib import Path

import numpy as np

from ..errors import DatasetError, TrainingError
from .cases import Case

_SIZE = (32, 24)
_ANGLE = 0.9
_SETTINGS = (
    "train.iterations=12",
    "identity.iterations=4",
    "train.probe_every=0",
    "init.object_points=30",
    "init.background_points=60",
    "init.sweep_depths=8",
)


def _write(root: Path, *, scale: float, far: float, views: int, constant: bool, turn: float) -> None:
    """Write a data set of a two-coloured disk that moves before a gray background, with its masks.

    Args:
        root: Folder to write.
        scale: World units per unit of the scene.
        far: Distance of the scene from the world's origin, in the scene's units.
        views: Cameras on a circle.
        constant: All pixels are the same.
        turn: Angle of the disk per unit of time, rad.
    """
    from ..data import images

    width, height = _SIZE
    v, u = np.mgrid[:height, :width] + 0.5
    frames = []
    for k in range(views):
        angle = 2 * np.pi * k / max(views, 1)
        back = np.array([np.cos(angle), np.sin(angle), 0.3])
        back /= np.linalg.norm(back)
        right = np.cross([0, 0, 1.0], back)
        right /= np.linalg.norm(right)
        matrix = np.eye(4)
        matrix[:3, :3] = np.stack([right, np.cross(back, right), back], axis=-1)
        matrix[:3, 3] = scale * (4 * back + [far, 0, 0])
        for i, t in enumerate((0.0, 0.5, 1.0)):
            x, y = u - 0.5 * width - 4 * t * np.cos(angle), v - 0.5 * height
            inside = x * x + y * y < 30
            half = x * np.cos(turn * t) + y * np.sin(turn * t) > 0
            color = np.where(inside[..., None], np.where(half[..., None], [0.9, 0.2, 0.1], [0.1, 0.3, 0.9]), 0.6)
            name = f"train/{k:02d}_{i}"
            images.write_png(root / f"{name}.png", np.full_like(color, 0.5) if constant else color)
            images.write_png(root / "object_mask" / f"{name}.png", inside.astype(np.uint8))
            frames.append({"file_path": name, "time": t, "view": f"cam{k}", "transform_matrix": matrix.tolist()})
    content = {"camera_angle_x": _ANGLE, "frames_per_unit": 30.0, "frames": frames}
    (root / "transforms_train.json").write_text(json.dumps(content))


def _trained(
    *,
    scale: float = 1.0,
    far: float = 0.0,
    views: int = 4,
    constant: bool = False,
    turn: float = 0.0,
    settings: tuple[str, ...] = (),
) -> float:
    """Return the number of non-finite values in the last state of a short training."""
    from ..config import config
    from ..train import checkpoint, run
    from ..train.representations import residual

    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "data"
        _write(root, scale=scale, far=far, views=views, constant=constant, turn=turn)
        try:
            done = run.train(root, Path(folder) / "run", config.load(None, [*_SETTINGS, *settings]))
        except (DatasetError, TrainingError) as error:
            logging.getLogger(__name__).info("refused: %s", error)
            return 0.0
        tensors = checkpoint.load(done.folder).tensors
        trained = [tensor for name, tensor in tensors.items() if name != residual.GAINS]  # NaN there: not measured
        return float(sum(int((~tensor.isfinite()).sum()) for tensor in trained if tensor.is_floating_point()))


def _warm() -> None:
    """Compile the kernels by a first training, before the timed part of a case."""
    from ..render import warm_up

    warm_up.warm_up()
    _first()


@functools.cache
def _first() -> None:
    _trained()


CASES: tuple[Case, ...] = tuple(
    Case(
        "training",
        name,
        "train.run.train",
        "numbers that are not finite",
        0.0,
        "all finite",
        functools.partial(_trained, **options),
        prepare=_warm,
    )
    for name, options in (
        ("a world of 1e-6 units", {"scale": 1e-6}),
        ("a world of 1e6 units", {"scale": 1e6}),
        ("1e7 units from the origin", {"far": 1e7}),
        ("one camera", {"views": 1}),
        ("images of one colour", {"constant": True}),
        ("1e4 rad per unit of time", {"turn": 1e4}),
        ("one Gaussian per object", {"settings": ("init.object_points=1", "init.background_points=1")}),
    )
)
