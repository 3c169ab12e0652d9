"""Processor time of contacts of many bodies, and the errors of their places.

    python -m benchmarks.contact_cost [--kind ball|box] [--count N] [--seed S]

Bodies are thrown onto a floor and observed in 25 poses with noise of 0.2 % of their size and 0.01 rad; most bounce once
in that time and again after it. Prints the processor seconds that `scene_future.predict` takes, the number of
bodies that get contacts, and the median and largest error of a place at the end of the prediction, in sizes.
"""

from __future__ import annotations

import argparse
import dataclasses
import time

import numpy as np

from r5dgs_core.contact import scene_future, simulation, stepping, world
from r5dgs_core.motion import models, rotations
from r5dgs_core.motion_fit import model_selection
from r5dgs_core.scene.hull import Hull
from r5dgs_core.scene.scene import Scene, Tracks
from r5dgs_core.shapes import solid
from tests.support import contact_scenes, contacts

SIZE, UP = contact_scenes.SIZE, np.array([0.0, 0.0, 1.0])
TIMES, END = np.linspace(0, 1.0, 25), 4 / 3  # END is up to where scenes are predicted
NOISE, TURN_NOISE = 0.002 * SIZE, 0.01


def thrown(kind: str, count: int, rng: np.random.Generator) -> tuple[simulation.Simulation, world.State]:
    """Simulation of up to ten bodies over a floor, and their states at time 0."""
    spots = [np.array([x, y, 0]) for x in (-1.8, -0.9, 0, 0.9, 1.8) for y in (-1.0, 0.2)][:count]
    bodies = []
    for spot in spots:
        make = {"ball": contacts.ball, "box": contacts.box}[kind]
        body = make(np.zeros(3), friction=rng.uniform(0.2, 0.5), restitution=rng.uniform(0.6, 0.8))
        corners = SIZE / contacts.SIZE * body.solid.vertices + spot + rng.uniform(0.65, 0.85) * UP
        bodies.append(dataclasses.replace(body, solid=solid.of(corners)))
    place = world.World(tuple(bodies), world.Plane(UP, 0.0), -contact_scenes.G * UP)
    state = world.at_rest(place)
    state.velocities[:], state.spins[:] = rng.uniform(-0.3, 0.3, (count, 3)), rng.normal(0, 2, (count, 3))
    return simulation.Simulation(place, stepping.choose(3.0, SIZE, contact_scenes.G, 2.0)), state


def observed(bodies: tuple[world.Body, ...], quats: np.ndarray, places: np.ndarray) -> Scene:
    """Scene of bodies that were seen in poses [S, B, 4], [S, B, 3] and move on by the laws that are fitted to them."""
    laws, poses, hulls = [], [np.tile([1.0, 0, 0, 0, 0, 0, 0], (len(TIMES), 1))], []
    for k, body in enumerate(bodies):
        last = quats[-1, k], places[-1, k]
        turns, moved = rotations.multiply(quats[:, k], rotations.conjugate(last[0])), places[:, k] - last[1]
        least = 0.003 * SIZE, 0.004
        laws.append(model_selection.fit(TIMES, turns, moved, radius=SIZE / 2, up=UP, least_noise=least))
        poses.append(np.concatenate([rotations.make_continuous(turns), moved], axis=1))
        arms = body.solid.vertices - body.solid.center
        hulls.append(Hull(k + 1, k + 1, rotations.rotate(last[0][None], arms) + last[1]))
    made = contact_scenes.with_units(contact_scenes.scene(*((law.model, places[-1, k]) for k, law in enumerate(laws))))
    histories = [made.groups[0].history, *(law.history for law in laws)]
    groups = (dataclasses.replace(group, history=own) for group, own in zip(made.groups, histories, strict=True))
    tracks = Tracks(TIMES, np.array(poses))
    return dataclasses.replace(made, hulls=tuple(hulls), groups=tuple(groups), tracks=tracks, t_max=float(TIMES[-1]))


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kind", choices=("ball", "box"), default="ball")
    parser.add_argument("--count", type=int, choices=range(1, 11), default=10)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    rng = np.random.default_rng(args.seed)
    runs, state = thrown(args.kind, args.count, rng)
    quats, places = runs.poses(state, np.append(TIMES, END))
    turns = rotations.rotvecs_to_quats(rng.normal(0, TURN_NOISE, places[:-1].shape))
    noisy = rotations.multiply(turns, quats[:-1]), places[:-1] + rng.normal(0, NOISE, places[:-1].shape)
    scene = observed(runs.world.bodies, *noisy)
    began = time.process_time()
    found = scene_future.predict(scene)
    seconds = time.process_time() - began
    ends = [g.pivot + models.evaluate(g.model, END - scene.t_max)[1] for g in found.groups[1:]]
    errors = np.linalg.norm(np.array(ends) - places[-1], axis=1) / SIZE
    print(f"{args.count} x {args.kind}: {seconds:.2f} s, {len(found.taken)} with contacts, ", end="")
    print(f"errors {np.median(errors):.3f}, at most {errors.max():.3f} sizes")


if __name__ == "__main__":
    main()
