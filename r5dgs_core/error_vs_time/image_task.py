"""Task "images": error and time of each playback mode against true images, with true future poses beside them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from .. import timing
from ..data.dataset import Dataset, View
from ..evaluation import evaluate, ground_truth_poses, lpips
from ..motion import se3
from ..playback import scene_player
from ..render import scene_renderer
from ..scene import sampling
from ..scene.scene import Scene
from .report_rows import Row
from .task import Goal, Measured, Panel, Request, Task, decibels

KINDS = ("psnr", "psnr_objects", "ssim", "flip", "lpips", "miou")
FRAMES = 6  # timed views
ORACLE = "true poses"
TRUE_POSES = (
    "motion is given, not predicted. This is no upper limit: appearance learned with a track compensates for "
    "errors of the track"
)
_SAME = 1e-6  # tolerance for equal times


def measure(
    scene: Scene,
    dataset: Dataset,
    splits: Sequence[str],
    rounds: int,
    *,
    clock: str = "wall",
    backend: str = "auto",
    perceptual: lpips.Lpips | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[list[Row], list[str]]:
    """Return the rows of the task "images".

    Args:
        scene: The scene.
        dataset: Its data set.
        splits: Splits to measure; error kinds of all but the first have "@" and the split's name appended.
        rounds: Timing rounds.
        clock: Clock of the rows' ``ms``, from `timing.CLOCKS`.
        backend: Rasterizer.
        perceptual: Network for LPIPS, or None.
        progress: Called with the number of measured images and the total.

    Returns:
        The rows, and the reasons for missing measurements.
    """
    rows, absent = [], []
    known = scene_player.modes(scene)
    moves: dict[str, evaluate.Move] = {mode: scene_player.Player(scene, mode).frame for mode in known}
    if len(moves) == 1:
        absent.append("images of other modes than rigid: the scene holds no dynamics of its Gaussians")
    oracle, why = true_move(scene, dataset, [view.t for split in splits for view in dataset.views(split)])
    if oracle is None:
        absent.append(f"images with true poses: {why}")
    else:
        moves[ORACLE] = oracle
    plans = _plans(scene, dataset, splits, moves, absent)
    total = sum(len(dataset.views(split)) * len(plan) for split, plan in plans.items())
    count = evaluate.counter(progress, total)
    missing: dict[str, None] = {}
    for number, (split, plan) in enumerate(plans.items()):
        views = dataset.views(split)
        if not views:
            continue
        name = "" if number == 0 else f"@{split}"
        times = _times(scene, views, {k: m for k, m in plan.items() if k != ORACLE}, rounds, backend, clock)
        for mode, move in plan.items():
            found = evaluate.measure_views(scene, views, move, backend=backend, perceptual=perceptual, measured=count)
            missing |= dict.fromkeys(kind for kind in KINDS if found[kind] is None)
            errors = {f"{kind}{name}": found[kind] for kind in KINDS if found[kind] is not None}
            shared = {"task": "images", "setting": split, "count": found["images"]}
            shared |= _label(mode) | times.get(mode, {})
            rows += [Row(error_kind=kind, error=float(error), **shared) for kind, error in errors.items()]
    if missing:
        absent.append(f"images: not computed: {', '.join(missing)} (requirements: docs/reference/evaluation.md)")
    return rows, absent


def _label(mode: str) -> dict[str, Any]:
    """Columns that name a mode, or the true poses."""
    if mode == ORACLE:  # not a selectable method, so neither timed nor on the Pareto front
        return {"mode": "rigid", "method": ORACLE, "note": TRUE_POSES}
    return {"mode": mode, "method": "playback"}


def _plans(
    scene: Scene, dataset: Dataset, splits: Sequence[str], moves: dict[str, evaluate.Move], absent: list[str]
) -> dict[str, dict[str, evaluate.Move]]:
    """Return the moves to measure in each split, and append the reasons for missing ones to ``absent``."""
    plans = {}
    for split in splits:
        past = any(view.t > scene.t_max for view in dataset.views(split))
        plans[split] = moves if past else {k: m for k, m in moves.items() if k in ("rigid", ORACLE)}
        if not dataset.views(split):
            absent.append(f"images of {split}: the data set has none")
        elif not past and len(moves) > len(plans[split]):
            absent.append(f"images of {split} in other modes than rigid: all modes are the same up to t_max")
    return plans


def true_move(scene: Scene, dataset: Dataset, times: Sequence[float]) -> tuple[evaluate.Move | None, str]:
    """Return a function that plays the scene with every body in its true pose past t_max.

    A body whose rotation the images do not determine, such as a ball without texture, keeps the scene's rotation and
    moves along its true path.

    Args:
        scene: The scene.
        dataset: Its data set.
        times: Times at which frames will be requested.

    Returns:
        A function from one of the times and an origin to the frame, or None and the reason.
    """
    if dataset.ground_truth is None:
        return None, "the data set has no true poses (ground_truth.json)"
    bodies = ground_truth_poses.bodies(scene, dataset.ground_truth, every=True)
    if not bodies:
        return None, "none of the objects with true poses is one of the scene, or none of the poses was observed"
    known = bodies[0].times
    lost = [t for t in times if np.abs(known - t).min() > _SAME]
    if lost:
        return None, f"the data set has no true poses at t = {lost[0]:g}"
    player = scene_player.Player(scene)

    def move(t: float, origin: np.ndarray | None = None) -> scene_player.Frame:
        quats, displacements = (x.copy() for x in player.group_poses(t))
        if t <= scene.t_max:
            return player.frame(t, origin)
        k = int(np.abs(known - t).argmin())
        for body in bodies:
            if body.group.role == "body" and not body.turn_seen:
                displacements[body.group.id] = body.path[k] - body.group.pivot
            elif body.group.role == "body":
                q, d = se3.matrix_to_pose(body.group.pivot, body.motion[k])
                quats[body.group.id], displacements[body.group.id] = q, d
        for group in scene.groups:
            if group.follows is not None and group.follow_matrix is not None:
                displacements[group.id] = group.follow_matrix @ displacements[group.follows]
        return player.frame_at_poses(quats, displacements, t, origin)

    return move, ""


def _times(
    scene: Scene, views: Sequence[View], moves: dict[str, evaluate.Move], rounds: int, backend: str, clock: str
) -> dict[str, dict[str, Any]]:
    """Return the columns of a `Row` that hold times per frame, of motion and of color rasterization, by mode."""
    some = sampling.spread(views, FRAMES)
    calls: dict[tuple[str, str], Callable[[], object]] = {}
    for mode, move in moves.items():
        frames = [move(view.t, view.camera.center) for view in some]
        calls[mode, "motion"] = lambda move=move: [move(view.t, view.camera.center) for view in some]
        calls[mode, "raster"] = lambda frames=frames: [
            scene_renderer.render_frame(scene, frame, view.camera, backend=backend)
            for frame, view in zip(frames, some, strict=True)
        ]
    times = {key: found.scaled(1 / len(some)) for key, found in timing.take(calls, rounds).items()}
    columns = {}
    for mode in moves:
        motion, raster = times[mode, "motion"], times[mode, "raster"]
        split = {"ms_motion": motion.ms(clock), "ms_raster": raster.ms(clock)}
        columns[mode] = {**split, **(motion + raster).columns(clock)}
    return columns


def _measure(request: Request) -> Measured:
    options = {"clock": request.clock, "backend": request.backend, "progress": request.count}
    given = request.scene, request.data, request.splits, request.rounds
    return measure(*given, perceptual=request.perceptual, **options)


def _beyond_true_poses(rows: Sequence[Row], pick: Row) -> str:
    """Return the comparison with true poses, which appearance learned with a wrong track may surpass."""
    for row in rows:
        if row.method == ORACLE and row.error_kind == pick.error_kind:
            side = "above" if pick.error > row.error else "below"
            return f"; {abs(pick.error - row.error):.2f} dB {side} true poses ({row.error:.2f} dB)"
    return ""


TASK = Task(
    "images",
    "Images: pictures of each mode against true images",
    _measure,
    Panel(
        "psnr",
        "error of pixels, 8-bit levels (rms)",
        lambda row, scene: f"Modes on {row.count} images of {row.setting}: motion + rasterization",
        lambda row: row.mode,
        floor=1e-3,
        reference=ORACLE,
        reference_name="with true poses",
    ),
    Goal("psnr", 0.3, decibels, lambda row: row.mode, remark=_beyond_true_poses),
    needs_data=True,
    counts=True,
)
