"""Decision on the refinement of the cameras, from the images that the training has so far explained.

Pictures of some views are linearised in the corrections of their cameras (`render.camera_fit`). Corrections are fitted
to one half of the pixels and measured on the other half, both ways. A part of the corrections (poses, focal lengths,
time offsets, colours) is trained if the error on the pixels that were not fitted grows clearly without it.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence

import numpy as np
import torch

from ...config.config import Config
from ...raster.arrays import to_host
from ...render import camera_fit
from ...render.camera_fit import Normal, Shot, Units
from ...scene.cameras import Camera
from ...scene.sampling import spacing, spread
from .. import train_views
from ..normalization import TARGET_DISTANCE
from ..trainer import Trainer
from .refinement import PARTS

log = logging.getLogger(__name__)

SHORTEST = 100  # minimum steps of a run for an examination; shorter runs explain too little of the images
FOLLOW_UPS = 8  # number of examinations of refined parts while times enter
ROUNDS = 3  # number of examinations once all times have entered
POSES, VIEWS = 12, 3  # maximum number of poses that are examined, and of views of each
TIME_PIXEL = 0.1  # time in which moving things go about a pixel, spacings of the observed times
RIDGE = 1e-3  # relative increase of the diagonal of the normal equations
_COLUMNS: dict[str, str] = dict(zip(PARTS, ("pose", "focal", "time", "color"), strict=True))


def steps(config: Config) -> tuple[int, ...]:
    """Return the steps after which the cameras are examined.

    There are none in runs of fewer than `SHORTEST` steps, or if the user has switched all parts off.

    The first examination is before the second time enters, when Gaussians have not yet adapted to wrong cameras.
    """
    if config.train.iterations < SHORTEST or all(getattr(config.needs, part) == "off" for part in PARTS):
        return ()
    begin, full = config.curriculum.steps(config.train.iterations)
    every = max(1, full - begin)
    found = [begin] + [full + k * every for k in range(ROUNDS)]
    return tuple(step for step in dict.fromkeys(max(step, 1) for step in found) if step < config.train.iterations)


def after_step(trainer: Trainer) -> None:
    """Examine the cameras of a run if an examination is due; parts that are refined are examined more often."""
    examinations, iteration = steps(trainer.config), trainer.iteration
    if iteration in examinations:
        decide(trainer, _possible(trainer))
    elif trainer.refinement.active and examinations[0] < iteration < examinations[-1]:
        begin, full = trainer.config.curriculum.steps(trainer.config.train.iterations)
        if (iteration - begin) % max(1, (full - begin) // FOLLOW_UPS) == 0:
            decide(trainer, [part for part in _possible(trainer) if part in trainer.refinement.parts])


def threshold(part: str, config: Config) -> float:
    """Return the minimum gain of a part, dB."""
    return config.refine.threshold_time if part == "time_offsets" else config.refine.threshold


def decide(trainer: Trainer, possible: Sequence[str]) -> None:
    """Examine some parts, begin the refinement of those that help, and improve the corrections of the others."""
    refinement, config = trainer.refinement, trainer.config
    examined = spread(range(refinement.rig.poses), POSES)
    halves = {row: found for row in examined if possible and (found := _halves(trainer, row, possible)) is not None}
    gains = _gains(list(halves.values()), possible)
    found = np.array([gains.get(part, math.nan) for part in PARTS])
    refinement.gains = found if refinement.gains is None else np.fmax(refinement.gains, found)
    forced = {part for part in possible if getattr(config.needs, part) == "on"}
    helpful = {part for part in possible if gains[part] > threshold(part, config)}
    taken = [part for part in PARTS if part in forced | helpful | refinement.parts]
    log.info("cameras: gains %s; refined: %s", _text(found), ", ".join(taken) or "nothing")
    if not taken:
        return
    which = _indices([part for part in taken if part in possible])
    changes = {row: (a + b).solve(which, RIDGE) for row, (a, b) in halves.items()}
    refinement.begin(taken, to_host(trainer.gaussians.means), trainer.iteration, changes)


def _possible(trainer: Trainer) -> list[str]:
    """Return the parts that the rig and the times in training determine and the user has not switched off."""
    rig, (first, last) = trainer.refinement.rig, trainer.curriculum.entered
    enough = {
        "camera_poses": rig.poses > 1,
        "focal_lengths": rig.lenses > 1 or rig.poses > 2,
        "time_offsets": rig.lenses > 1 and last > first,
        "camera_colours": rig.lenses > 1,
    }
    return [part for part in PARTS if enough[part] and getattr(trainer.config.needs, part) != "off"]


def _indices(parts: Sequence[str]) -> np.ndarray:
    return camera_fit.columns(**{_COLUMNS[part]: True for part in parts})


@torch.no_grad()
def _halves(trainer: Trainer, row: int, parts: Sequence[str]) -> tuple[Normal, Normal] | None:
    """Return the normal equations of the two halves of a pose's pixels; None if no view of it is in training yet."""
    refinement, (first, last) = trainer.refinement, trainer.curriculum.entered
    mine = [
        int(index)
        for index in np.flatnonzero(refinement.rig.pose_of == row)
        if first <= train_views.nearest_knot(trainer.times, trainer.given_views[index].t) <= last
    ]
    if not mine:
        return None
    mine.sort(key=lambda index: trainer.given_views[index].t)
    units, which = Units(TARGET_DISTANCE, TIME_PIXEL * spacing(trainer.times)), _indices(parts)
    a, b = [], []
    for number, index in enumerate(spread(mine, VIEWS)):
        view = trainer.given_views[index]

        def draw(camera: Camera, t: float, given: Camera = view.camera) -> np.ndarray:
            return to_host(trainer.render(camera, t, behind=given))

        shot = Shot(view.camera, view.t, view.image.astype(np.float32) / 255)
        halves = camera_fit.normal_halves(draw, shot, refinement.correction(row), units, which, odd=number % 2)
        a.append(halves[0])
        b.append(halves[1])
    return sum(a[1:], a[0]), sum(b[1:], b[0])


def _gains(halves: Sequence[tuple[Normal, Normal]], parts: Sequence[str]) -> dict[str, float]:
    """Return the increase of the error on pixels that were not fitted if one part is left out, dB."""
    if not halves:
        return {}
    whole = _error(halves, parts)
    return {part: 10 * math.log10(_error(halves, [p for p in parts if p != part]) / whole) for part in parts}


def _error(halves: Sequence[tuple[Normal, Normal]], parts: Sequence[str]) -> float:
    which, total = _indices(parts), 1e-12
    for a, b in halves:
        total += max(b.after(a.solve(which, RIDGE)), 0.0) + max(a.after(b.solve(which, RIDGE)), 0.0)
    return total


def _text(gains: np.ndarray) -> str:
    return ", ".join(f"{part} {gain:+.2f} dB" for part, gain in zip(PARTS, gains, strict=True) if not math.isnan(gain))
