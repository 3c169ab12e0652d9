"""Decision on the refinement of the cameras, from the images that the training has so far explained.

Pictures of some views are linearised in the corrections of their cameras (`render.camera_fit`). A part of the
corrections (poses, focal lengths, time offsets, colours) is trained if opposite sides of the pictures agree that it is
needed (`agreement`).
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence

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
from . import agreement, gauge, patch_trial
from .agreement import Evidence, Examined
from .refinement import CLOCKS, PARTS, POSES

log = logging.getLogger(__name__)

SHORTEST = 100  # minimum steps of a run for an examination; shorter runs explain too little of the images
FOLLOW_UPS = 8  # number of examinations of refined parts while times enter
ROUNDS = 3  # number of examinations once all times have entered
MOST_POSES, VIEWS = 12, 3  # maximum number of poses that are examined, and of views of each
TIME_PIXEL = 0.1  # time in which moving things go about a pixel, spacings of the observed times


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
    elif examinations and _follows(trainer) and examinations[0] < iteration < examinations[-1]:
        begin, full = trainer.config.curriculum.steps(trainer.config.train.iterations)
        if (iteration - begin) % max(1, (full - begin) // FOLLOW_UPS) == 0:
            decide(trainer, [part for part in _possible(trainer) if part in trainer.refinement.parts])


def _follows(trainer: Trainer) -> bool:
    """True if refined parts are examined more often: not after poses are settled."""
    return trainer.refinement.active and not trainer.refinement.settled


def least_size(part: str, config: Config) -> float:
    """Return the minimum size of a part, in the units of `agreement.Evidence`."""
    section = config.refine
    return {"time_offsets": section.intervals, "camera_colours": section.colors}.get(part, section.pixels)


def decide(trainer: Trainer, possible: Sequence[str]) -> None:
    """Examine some parts, begin the refinement of those that help, and improve the corrections of the others."""
    refinement, config = trainer.refinement, trainer.config
    examined = spread(range(refinement.rig.poses), MOST_POSES)
    tiles = {row: found for row in examined if possible and (found := _tiles(trainer, row, possible)) is not None}
    if not tiles:
        return
    points = to_host(trainer.gaussians.means)
    some = points[:: max(1, len(points) // gauge.POINTS)]
    poses = [Examined(refinement.rig.cameras[row], found) for row, found in tiles.items()]
    evidence = agreement.examine(poses, possible, _units(trainer), some, spacing(trainer.times))
    refinement.learn({part: (one.size, one.gain) for part, one in evidence.items()})
    forced = {part for part in possible if getattr(config.needs, part) == "on"}
    helpful = {part for part, one in evidence.items() if one.size > least_size(part, config)}
    wrong = POSES in possible and POSES in forced | helpful | refinement.parts
    due = not refinement.settled and trainer.iteration in steps(config)
    patched = patch_trial.adjust(trainer, some) if wrong and due else None
    if patched is not None:
        refinement.change(patched.changes, final=patched.final)
        helpful = helpful - {CLOCKS} | patched.changes.keys()
    # Not at once when all times have entered: the motion at the last of them has to be trained first.
    if CLOCKS in refinement.settled and trainer.iteration in steps(config)[2:3]:
        later = patch_trial.adjust_clocks(trainer, some)
        if later is not None:
            refinement.change({CLOCKS: later}, final=True)
    taken = [part for part in PARTS if part in forced | helpful | refinement.parts]
    log.info("cameras, step %d: %s; refined: %s", trainer.iteration, _text(evidence), ", ".join(taken) or "nothing")
    if not taken:
        return
    fitted = [part for part in taken if part in possible]
    if patched is not None or refinement.settled:
        fitted = [part for part in fitted if part == "camera_colours"]
    which = agreement.indices(fitted)
    changes = {row: camera_fit.added(found).solve(which, agreement.RIDGE) for row, found in tiles.items()}
    refinement.begin(taken, points, trainer.iteration, changes)


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


def _units(trainer: Trainer) -> Units:
    return Units(TARGET_DISTANCE, TIME_PIXEL * spacing(trainer.times))


@torch.no_grad()
def _tiles(trainer: Trainer, row: int, parts: Sequence[str]) -> list[Normal] | None:
    """Return the normal equations of the tiles of a pose's pictures; None if no view of it is in training yet."""
    refinement, (first, last) = trainer.refinement, trainer.curriculum.entered
    mine = [
        int(index)
        for index in np.flatnonzero(refinement.rig.pose_of == row)
        if first <= train_views.nearest_knot(trainer.times, trainer.given_views[index].t) <= last
    ]
    if not mine:
        return None
    mine.sort(key=lambda index: trainer.given_views[index].t)
    views, which = [], agreement.indices(parts)
    for index in spread(mine, VIEWS):
        view = trainer.given_views[index]

        def draw(camera: Camera, t: float, given: Camera = view.camera) -> np.ndarray:
            return to_host(trainer.render(camera, t, behind=given))

        left_out = view.unexplained
        valid = None if left_out is None else ~left_out
        shot = Shot(view.camera, view.t, view.image.astype(np.float32) / 255, valid)
        views.append(camera_fit.normal_tiles(draw, shot, refinement.correction(row), _units(trainer), which))
    return [camera_fit.added(tile) for tile in zip(*views, strict=True)]


def _text(evidence: Mapping[str, Evidence]) -> str:
    return ", ".join(f"{part} {one.size:.3g} ({one.gain:+.2f} dB)" for part, one in evidence.items())
