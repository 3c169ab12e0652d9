"""Build a scene of colliding bodies with Blender's rigid bodies, and capture it into a training data set.

    python examples/build_collisions.py 0 --dataset DIR [--size 128] [--samples 8]
    blender -b --python examples/build_collisions.py -- 0 --blend bounce.blend     with Blender

Scenes 0 to 11: balls that bounce, boxes that tumble, collisions of two and three bodies, boxes that slide, balls that
roll off a table. The parameters are drawn by a seed; `material.json` in the data set has the true ones.
"""

from __future__ import annotations

import dataclasses
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType

import bpy
from mathutils import Quaternion, Vector

sys.path.insert(0, str(Path(__file__).resolve().parent))
from building import bullet, materials, motion, shapes, stage, toys
from collisions import parameters
from collisions.parameters import BodyParameters, SceneParameters

_STEPS = 4  # of Bullet per frame
_IMPACT, _NEAR = 0.6, 0.03  # speed of an impact, units per second, that must have its restitution up to this
_ATTEMPTS = 100


def draw(number: int, seed: int) -> tuple[SceneParameters, list[bullet.Path]]:
    """Draw the parameters of a scene until Bullet lets all balls bounce off the ground as they should, and simulate it.

    The open file has the scene's objects afterwards, at their first poses.
    """
    for attempt in range(_ATTEMPTS):
        drawn = parameters.draw(number, seed, attempt)
        supports = _surroundings(drawn)
        bodies = [_body(one) for one in drawn.bodies]
        paths = bullet.simulate(bodies, supports, parameters.SECONDS, _STEPS)
        balls = [(body, path) for body, path in zip(bodies, paths, strict=True) if body.shape == "SPHERE"]
        if all(abs(e - body.restitution) < _NEAR for body, path in balls for e in bullet.impacts(path, _IMPACT)):
            return drawn, paths
    raise SystemExit(f"scene {number}, seed {seed}: Bullet was wrong about the impacts in all {_ATTEMPTS} attempts")


def build(number: int, seed: int = parameters.SEED) -> tuple[SceneParameters, list[motion.Actor]]:
    """Build a scene into the open file. Returns its parameters, and its objects in the order of their ids."""
    drawn, paths = draw(number, seed)
    actors = [motion.Actor(bpy.data.objects[one.name], path.law) for one, path in zip(drawn.bodies, paths, strict=True)]
    motion.perform(actors)
    return drawn, actors


def _surroundings(drawn: SceneParameters) -> list[bpy.types.Object]:
    """Start a scene with its lights and supports, and return these."""
    stage.new((0.74, 0.85, 1.0), 0.62)
    stage.sun(2.1, (32.0, -18.0, 20.0), angle_deg=14.0, color=(1.0, 0.95, 0.86))
    wood = materials.planks("planks", ((0.46, 0.33, 0.21), (0.38, 0.26, 0.16), (0.25, 0.16, 0.09)), 0.42)
    supports = [shapes.box("Ground", (9.0, 9.0, 0.4), [wood])]
    supports[0].location = (0.0, 0.0, -0.2)
    if drawn.table is not None:
        x, y, length, width, height = drawn.table
        cloth = materials.checks("cloth", ((0.62, 0.60, 0.55), (0.10, 0.22, 0.42)), 0.15)
        supports.append(shapes.box("Table", (length, width, height), [cloth]))
        supports[1].location = (x, y, 0.5 * height)
    return supports


def _body(one: BodyParameters) -> bullet.RigidBody:
    ball = len(one.size) == 1
    if ball:
        ob, volume = toys.beach_ball(one.name, one.size[0]), 4.19 * one.size[0] ** 3
    else:
        ob, volume = toys.crate(one.name, one.size), one.size[0] * one.size[1] * one.size[2]
    vectors = (Vector(x) for x in (one.velocity, one.spin))
    turn = Quaternion(Vector(one.turn[0]), one.turn[1])
    shape, mass = "SPHERE" if ball else "BOX", 500 * one.density * volume
    return bullet.RigidBody(ob, shape, mass, one.friction, one.restitution, Vector(one.place), turn, *vectors)


def settings(
    capture: ModuleType, drawn: SceneParameters, directory: Path, *, size: int = 128, samples: int = 8, views: int = 8
):
    """Settings of a capture, as the ``CaptureSettings`` of the capture service.

    Args:
        capture: The service.
        drawn: Parameters of the scene.
        directory: New folder of the data set.
        size: Width and height of the images.
        samples: Cycles samples per pixel.
        views: Observed cameras.
    """
    return capture.CaptureSettings(
        directory=directory,
        resolution_x=size,
        resolution_y=size,
        samples=samples,
        frame_step=2,
        t_max=parameters.T_MAX,
        val_every=6,
        test_every=2,
        test_views=1,
        rig="ARC",
        rig_observed=views,
        rig_novel=2,
        rig_target=(0.0, 0.0, 0.6),
        rig_radius=4.6,
        rig_elevation_deg=drawn.elevation_deg,
        rig_elevation_spread_deg=12.0,
        rig_azimuth_deg=drawn.azimuth_deg,
        rig_arc_deg=200.0,
        rig_fov_deg=40.0,
        objects="PASS_INDEX",
    )


def write_truth(drawn: SceneParameters, directory: Path) -> None:
    """Write the parameters, and the units into the files of the views."""
    (directory / "material.json").write_text(json.dumps(dataclasses.asdict(drawn), indent=1) + "\n")
    for path in directory.glob("transforms_*.json"):
        content = json.loads(path.read_text())
        content |= {"seconds_per_unit": parameters.SECONDS, "meters_per_unit": 1.0}
        path.write_text(json.dumps(content, indent=1) + "\n")


def main(arguments: Sequence[str]) -> None:
    """Build a scene, and save or capture it."""
    parser = stage.parser("build_collisions.py", __doc__.split("\n", 1)[0])
    parser.add_argument("number", type=int, choices=range(len(parameters.KINDS)), help="which scene")
    parser.add_argument("--seed", type=int, default=parameters.SEED, help="seed of the parameters")
    stage.add_rendering(parser, samples=8, views=8)
    chosen = parser.parse_args(arguments)
    drawn, _ = build(chosen.number, chosen.seed)
    stage.use_threads(chosen.threads)
    if chosen.blend is not None:
        stage.save(chosen.blend)
    if chosen.dataset is not None:
        service = stage.capture_service()
        options = {name: getattr(chosen, name) for name in ("size", "samples", "views")}
        stage.capture(service, settings(service, drawn, chosen.dataset, **options))
        write_truth(drawn, chosen.dataset)


if __name__ == "__main__":
    main(stage.arguments())
