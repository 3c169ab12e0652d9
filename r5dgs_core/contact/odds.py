"""Probabilities of events in the predicted motion of a scene, from sampled futures."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from ..scene import predictability, world_axes
from ..scene.scene import Scene
from . import futures, recording, scene_bodies, scene_future, world
from .recording import Recording
from .scene_world import SceneWorld, Wishes

_ABOVE = 0.1  # height over or below its plane, in sizes, above which a body has left it


@dataclass(frozen=True)
class Odds:
    """Probabilities up to the end of the prediction.

    Attributes:
        name: Name of the object.
        rests: It comes to rest.
        leaves: It is off the plane that supports it at the end.
        hits: It touches an object before any other, by name; objects that it never touches are left out.
        turns_over: It ends on another face than in the shown prediction, turns about the vertical aside; None for
            balls, which have no faces, and without a known vertical.
    """

    name: str
    rests: float
    leaves: float
    hits: dict[str, float]
    turns_over: float | None


def of(scene: Scene, count: int, seed: int = 0) -> list[Odds]:
    """Return the odds of the bodies for which contacts are simulated; none if no motion needs contacts.

    Args:
        scene: The scene; motions with contacts that it stores are predicted again.
        count: Number of sampled futures.
        seed: Their seed. Futures whose simulation fails are left out.

    Raises:
        BackendError: Contacts are needed and MuJoCo is not installed.
    """
    wishes = Wishes(samples=count, seed=seed)
    smooth = scene_bodies.without_contacts(scene)
    found = scene_future.predict(smooth, dataclasses.replace(wishes, samples=1))
    made, duration = found.world, predictability.horizon(scene) - scene.t_max
    if made is None or duration <= 0:
        return []
    runs, sampled = made.draft(scene.t_max, duration), []
    for state, materials in made.draws(scene.t_max, list(found.materials), wishes):
        runs.set_materials(materials)
        future = recording.record(runs, state, duration)
        if not runs.failed:
            sampled.append(future)
    if not sampled:
        return []
    assert found.recording is not None
    times, quats = found.recording.times, found.recording.quats
    shown = quats[min(int(np.searchsorted(times, duration)), len(times) - 1)]
    up = world_axes.UP_AXIS.get(scene.world_convention) if made.world.plane is None else made.world.plane.normal
    numbers = [number for number, body in enumerate(made.bodies) if body.name in found.taken]
    return [_odds(made, number, sampled, shown[number], up) for number in numbers]


def _odds(made: SceneWorld, number: int, sampled: list[Recording], shown: np.ndarray, up: np.ndarray | None) -> Odds:
    """Odds of a body; ``shown`` is its rotation at the end of the shown prediction [4], ``up`` a unit vector [3]."""
    firsts = [_first(number, future) for future in sampled]
    hits = {
        made.bodies[other].name: firsts.count(other) / len(sampled)
        for other in sorted({first for first in firsts if first is not None})
    }
    rests = sum(bool(future.slow[number]) for future in sampled) / len(sampled)
    leaves = sum(_is_off(made, number, future) for future in sampled) / len(sampled)
    turns_over = None
    if up is not None and made.world.bodies[number].ball_radius is None:
        ends = np.array([future.quats[-1, number] for future in sampled])
        turns_over = float(futures.on_other_face(ends, shown, up).mean())
    return Odds(made.bodies[number].name, rests, leaves, hits, turns_over)


def _first(number: int, future: Recording) -> int | None:
    """Body that a body touches first, or None."""
    for touch in future.touches:
        if number in touch.bodies and min(touch.bodies) >= 0:
            return touch.bodies[0] if touch.bodies[1] == number else touch.bodies[1]
    return None


def _is_off(made: SceneWorld, number: int, future: Recording) -> bool:
    body, plane = made.world.bodies[number], made.world.plane
    if plane is None:
        return False
    gap = world.gaps(body, plane, future.places[-1, number], future.quats[-1, number])
    return bool(abs(gap) > _ABOVE * body.solid.size)
