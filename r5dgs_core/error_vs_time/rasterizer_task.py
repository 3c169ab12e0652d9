"""Task "raster": error and time of rasterizer thresholds, against the picture with the finest thresholds."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from .. import timing
from ..data import dataset as datasets
from ..evaluation import evaluate, metrics
from ..playback import scene_player
from ..raster import RasterSettings, backends
from ..render import scene_renderer
from ..scene import sampling
from ..scene.cameras import Camera
from ..scene.scene import Scene
from .report_rows import Row, spread
from .task import Goal, Measured, Panel, Request, Task, levels

FINEST = {"alpha_min": 1e-4, "transmittance_min": 1e-30}
SETTINGS: tuple[dict[str, float], ...] = (
    {},
    {"alpha_min": 1 / 1000},
    {"alpha_min": 2 / 255},
    {"alpha_min": 4 / 255},
    {"alpha_min": 8 / 255},
    {"alpha_min": 16 / 255},
    {"transmittance_min": 1e-3},
    {"transmittance_min": 1e-2},
    {"transmittance_min": 0.05},
    {"transmittance_min": 0.2},
    {"alpha_min": 4 / 255, "transmittance_min": 1e-2},
)
VIEWS = 4  # compared and timed views


def measure(
    scene: Scene, views: Sequence[datasets.View], rounds: int, *, clock: str = "wall", backend: str = "auto"
) -> tuple[list[Row], list[str]]:
    """Return the rows of the task "raster", in mode "rigid".

    Args:
        scene: The scene.
        views: Views with true images; if empty, the cameras of the scene at t_max are used.
        rounds: Timing rounds.
        clock: Clock of the rows' ``ms``, from `timing.CLOCKS`.
        backend: Rasterizer.

    Returns:
        The rows, and the reasons for missing measurements.
    """
    absent, player = [], scene_player.Player(scene)
    shots: list[tuple[Camera, float]] = [(view.camera, view.t) for view in views]
    shots = shots or [(camera, scene.t_max) for camera in scene.cameras]
    if not shots:
        return [], ["raster: neither the scene nor a data set gives a camera"]
    kept = sampling.spread(range(len(shots)), VIEWS)
    shots = [shots[i] for i in kept]
    frames = [player.frame(t, camera.center) for camera, t in shots]
    truths = [datasets.load_image(views[i], evaluate.truth_background(scene)) for i in kept] if views else []
    if not views:
        absent.append("raster: PSNR against true images needs a data set")
    used = backends.choose(backend, scene.gaussians.means).name
    base = RasterSettings(near_plane=scene.near_plane)

    def draw(changes: dict[str, float]) -> list[np.ndarray]:
        settings = dataclasses.replace(base, **changes)
        outputs = [
            scene_renderer.render_frame(scene, frame, camera, backend=backend, settings=settings)
            for frame, (camera, _) in zip(frames, shots, strict=True)
        ]
        return [np.clip(output.color, 0, 1) for output in outputs]

    labels = {"finest": FINEST, **{_name(changes): changes for changes in SETTINGS}}
    calls: dict[str, Callable[[], object]] = {name: lambda c=changes: draw(c) for name, changes in labels.items()}
    times = {name: found.scaled(1 / len(shots)) for name, found in timing.take(calls, rounds).items()}
    exact, rows = draw(FINEST), []
    for name, changes in labels.items():
        pictures = draw(changes)
        shared = {
            "task": "raster",
            "mode": "rigid",
            "method": used,
            "setting": name,
            "count": len(shots),
            "ms_raster": times[name].ms(clock),
            **times[name].columns(clock),
        }
        if changes is not FINEST:
            distances = [255 * metrics.mse(p, e) ** 0.5 for p, e in zip(pictures, exact, strict=True)]
            rows.append(Row(error_kind="difference", **spread(np.array(distances)), **shared))
        if truths:
            quality = np.array([metrics.psnr(p, truth) for p, truth in zip(pictures, truths, strict=True)])
            numbers = {**spread(quality, more_is_better=True), "error": float(quality.mean())}
            rows.append(Row(error_kind="psnr", **numbers, **shared))
    return rows, absent


def _name(changes: dict[str, float]) -> str:
    """Return a label of the settings, with alpha thresholds in 8-bit levels."""
    words = {"alpha_min": "alpha", "transmittance_min": "stop"}
    parts = [
        f"{words[key]} {round(255 * value, 2):g}/255" if key == "alpha_min" else f"{words[key]} {value:g}"
        for key, value in changes.items()
    ]
    return ", ".join(parts) or "3DGS (alpha 1/255, stop 0.0001)"


def _measure(request: Request) -> Measured:
    views = () if request.dataset is None else request.dataset.views(request.splits[0])
    return measure(request.scene, views, request.rounds, clock=request.clock, backend=request.backend)


TASK = Task(
    "raster",
    "Rasterizer: thresholds against the finest picture",
    _measure,
    Panel(
        "difference",
        "difference to the finest picture, 8-bit levels (rms)",
        lambda row, scene: f"Thresholds of the rasterizer ({row.count} pictures)",
        lambda row: row.setting,
        floor=1e-4,
        series=lambda row: (row.mode, row.setting.split()[0]),
    ),
    Goal("difference", 0.5, levels, lambda row: row.setting),
)
