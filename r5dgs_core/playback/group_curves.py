"""Motion of a group as cubic keys: exact at the observed knots, reduced past t_max.

The curves are those of the group's anchor: in the frame of its parent if the group is a part, else in the world.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ..motion import cubic_curves, models, rotations
from ..motion import key_reduction as reduction
from ..motion.cubic_curves import Curves
from ..scene import row_runs
from ..scene.scene import Scene
from . import group_dynamics, observed_motion

TOLERANCE = 3e-6  # error of reduced keys at the members, as a fraction of the scene's extent


def observed(scene: Scene, motion_id: int) -> Curves:
    """Return one key per knot and per jump between knots, which is exactly the playback up to t_max."""
    group = scene.groups[motion_id]
    return observed_motion.curves(scene, group, *group_dynamics.local_knots(scene, group))


def future(
    scene: Scene,
    motion_id: int,
    most: int = reduction.MAX_INTERVALS,
    other_models: Sequence[models.MotionModel] | None = None,
) -> tuple[reduction.Sampler, models.MotionModel, float | None]:
    """Sampler of a group's motion past t_max, at scene times.

    Args:
        scene: The scene; without parts if there are other models.
        motion_id: Motion group.
        most: Maximum number of intervals between keys, as for `key_reduction.reduce`.
        other_models: Models of all groups (`group_dynamics.models_of`) in place of the fitted ones, or None.

    Returns:
        The sampler, the model behind it (that of the leader if the group follows one), and the time past t_max at which
        it stops, or None.
    """
    group = scene.groups[motion_id]
    if group.follows is None or group.follow_matrix is None:
        model = group.own_model if other_models is None else other_models[motion_id]
        stop = None if group.joint is None else group.joint.stop_time
        return stopped(reduction.model_sampler(model, scene.t_max, most), scene.t_max, stop), model, stop
    model = scene.groups[group.follows].model if other_models is None else other_models[group.follows]
    leader = reduction.model_sampler(model, scene.t_max, most)
    follow = np.asarray(group.follow_matrix, np.float64)

    def sample(at: np.ndarray) -> reduction.Samples:
        _, displacements, _, velocities = leader(at)
        quats = rotations.identity(len(at))
        return quats, displacements @ follow.T, np.zeros_like(quats), velocities @ follow.T

    return sample, model, None


def stopped(sample: reduction.Sampler, start: float, stop_time: float | None) -> reduction.Sampler:
    """Sampler of a motion since ``start`` that rests from ``stop_time`` on, if it is not None."""
    if stop_time is None:
        return sample

    def held(at: np.ndarray) -> reduction.Samples:
        quats, displacements, quat_slopes, slopes = sample(np.minimum(at, start + stop_time))
        moving = (at < start + stop_time)[:, None]
        return quats, displacements, quat_slopes * moving, slopes * moving

    return held


def kinks(model: models.MotionModel, start: float, end: float, stop_time: float | None) -> list[float]:
    """Scene times at which the slopes of a motion since ``start`` jump, and that at which it stops."""
    found = start + models.kinks(model, end - start)
    if stop_time is not None and 0 < stop_time < end - start:
        found = np.append(found[found < start + stop_time], start + stop_time)
    return found.tolist()


def curves(
    scene: Scene,
    motion_id: int,
    end: float,
    reach: float,
    other_models: Sequence[models.MotionModel] | None = None,
) -> Curves:
    """Keys from the first knot to a scene time; up to t_max if it is not later. Slopes may jump at t_max and at kinks.

    Args:
        scene: The scene.
        motion_id: Motion group.
        end: Last scene time.
        reach: Reach of the group, from `reaches`.
        other_models: As for `future`.
    """
    past = observed(scene, motion_id)
    if end <= scene.t_max:
        return past
    sample, model, stop = future(scene, motion_id, other_models=other_models)
    jumps = kinks(model, scene.t_max, end, stop)
    ahead = reduction.reduce(sample, scene.t_max, end, TOLERANCE * scene.extent, reach, jumps)
    return cubic_curves.join(past, ahead)


def reaches(scene: Scene) -> np.ndarray:
    """Largest distance of a member from the anchor of each motion group. [G] float64"""
    result = np.zeros(len(scene.groups))
    for start, stop, g in row_runs.runs(scene.gaussians.motion_ids):
        pivot = scene.groups[g].home
        squares = np.zeros(stop - start)
        for axis in range(3):  # one column at a time, because numpy is slow for rows of three
            arms = scene.gaussians.means[start:stop, axis] - pivot[axis]
            squares += arms * arms
        result[g] = max(result[g], math.sqrt(float(squares.max())))
    return result
