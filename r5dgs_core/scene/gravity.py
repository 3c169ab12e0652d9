"""Gravity of a scene, from the motions of its falling bodies or from its units."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from ..motion.models import MotionModel
from . import cameras, world_axes
from .scene import Scene

STANDARD = 9.80665  # m / s^2
_FLIGHTS = ("translation", "ballistic_spin", "free_top", "bounce")  # kinds whose acceleration may be gravity
_DOWNWARD = 0.94  # least cosine between the acceleration of a falling body and the downward axis: 20 degrees
_FALL = 0.5  # height of the fall in the observed time, in radii of the body, below which gravity is not measured
_AGREES = 0.1  # relative difference of observed motions from the gravity of the units up to which they agree with it


def of(scene: Scene) -> np.ndarray | None:
    """Return the acceleration of falling bodies, or None if it is unknown: no body falls, and units are missing. [3]

    The units give its exact value; a few observed poses give it within some per cent. If they differ by more, the
    observed motions count, as a scene may be in slow motion. Bodies that hardly fall in the observed time do not count:
    a ball that rolls over a table seems to rise or fall by the errors of its poses. Gravity is vertical if the world
    has an up axis, as the tilt of a few observed poses is mostly noise, on which a ball would roll for ever.
    """
    up = cameras.WORLD_TO_BLENDER[scene.world_convention][2]
    found = of_motions(_seen(scene), up)
    seconds, meters = scene.units.seconds_per_unit, scene.units.meters_per_unit
    known = None if seconds is None or meters is None else STANDARD * seconds**2 / meters
    if found is None:
        return None if known is None else -known * up
    if scene.world_convention in world_axes.UP_AXIS:
        found = (found @ up) * up
    seen = float(np.linalg.norm(found))
    return found if known is None or abs(seen - known) > _AGREES * known else known / seen * found


def _seen(scene: Scene) -> Iterator[MotionModel]:
    """Motions of the bodies that their accelerations move visibly in the observed time."""
    half_square = 0.5 * float(np.ptp(scene.tracks.times)) ** 2 if len(scene.tracks.times) else 0.0
    for group in scene.groups:
        model = group.smooth or group.model
        if group.role == "body" and half_square * float(np.linalg.norm(model.acceleration)) >= _FALL * model.radius:
            yield model


def of_motions(models: Iterable[MotionModel], up: np.ndarray) -> np.ndarray | None:
    """Return the median acceleration of the falling bodies among motions past t_max without contacts, or None. [3]

    Args:
        models: The motions.
        up: Upward unit vector. [3]
    """
    found = np.array([model.acceleration for model in models if falls(model, up)]).reshape(-1, 3)
    norms = np.linalg.norm(found, axis=1)
    found = found[norms > norms.max(initial=0.0) / 2]  # something holds the others back
    return np.median(found, axis=0) if len(found) else None


def falls(model: MotionModel, up: np.ndarray) -> bool:
    """Return True if the acceleration of a motion may be gravity."""
    a, length = model.acceleration, float(np.linalg.norm(model.acceleration))
    return model.kind in _FLIGHTS and not model.frequency and length > 0 and float(-a @ up) > _DOWNWARD * length
