"""Synthetic scenes of boxes over a floor, with poses from a simulation."""

from __future__ import annotations

import dataclasses

import numpy as np

from r5dgs_core.motion import models
from r5dgs_core.scene.hull import Hull
from r5dgs_core.scene.scene import Gaussians, MotionGroup, Scene, SceneObject, Tracks
from tests.support import contacts
from tests.support.scenes import looking_camera

SIZE = 0.4
G = 4.0  # world units per unit of time squared
TIMES = np.linspace(0, 0.6, 13)


def box_points(center: np.ndarray, rng: np.random.Generator, count: int = 400) -> np.ndarray:
    """Points on the surface of a box. [count, 3]"""
    points = rng.uniform(-1, 1, (count, 3))
    axis = np.argmax(np.abs(points), axis=1)
    points[np.arange(count), axis] = np.sign(points[np.arange(count), axis])
    return center + 0.5 * SIZE * points


def scene(*bodies: tuple[models.MotionModel, np.ndarray], up_to: float = 1.4) -> Scene:
    """Scene of boxes with motions about t_max, which they also had before, over a floor at z = 0.

    Args:
        bodies: Motion and centre at t_max of each box. [3]
        up_to: Frame rate is such that the horizon is near this time.
    """
    rng = np.random.default_rng(0)
    grid = np.stack(np.meshgrid(*[np.linspace(-2.4, 2.4, 100)] * 2), -1).reshape(-1, 2)
    pieces = [np.concatenate([grid, np.full((len(grid), 1), -0.01)], axis=1)]
    groups = [MotionGroup(0, 0, "pinned", 0, np.zeros(3), models.STATIC)]
    poses = [np.tile([1.0, 0, 0, 0, 0, 0, 0], (len(TIMES), 1))]
    objects, hulls = [SceneObject(0, "background", (), "", (0.5, 0.5, 0.5), 0, len(grid))], []
    for number, (model, center) in enumerate(bodies, start=1):
        pieces.append(box_points(center, rng))
        quats, moved, _, _ = models.curve(model, TIMES - TIMES[-1])
        poses.append(np.concatenate([quats, moved], axis=1))
        start = sum(len(piece) for piece in pieces[:-1])
        groups.append(MotionGroup(number, number, "body", start, np.asarray(center), model))
        objects.append(SceneObject(number, f"box {number}", (), "", (1.0, 0.5, 0.2), start, len(pieces[-1])))
        corners = contacts.box(np.asarray(center), (SIZE,) * 3).solid.vertices
        hulls.append(Hull(number, number, corners))
    means = np.concatenate(pieces).astype(np.float32)
    ids = np.repeat(np.arange(len(pieces)), [len(piece) for piece in pieces]).astype(np.int32)
    flat = np.log([0.03, 0.03, 0.01])
    scales = np.where((ids == 0)[:, None], flat, np.log(0.03)).astype(np.float32)
    count = len(means)
    return Scene(
        name="boxes",
        gaussians=Gaussians(
            means=means,
            quats=np.tile([1.0, 0, 0, 0], (count, 1)).astype(np.float32),
            log_scales=scales,
            opacity_logits=np.full(count, 4.0, np.float32),
            sh=np.full((count, 1, 3), 0.3, np.float32),
            object_ids=ids,
            motion_ids=ids,
        ),
        objects=tuple(objects),
        groups=tuple(groups),
        tracks=Tracks(TIMES, np.array(poses)),
        t_max=float(TIMES[-1]),
        frames_per_unit=60.0,
        world_convention="blender",
        cameras=tuple(
            looking_camera(place, -np.array(place), 0.9, 96, 72, f"camera {k}")
            for k, place in enumerate([(4, 1, 3.0), (-2, 4, 3.5), (-3, -3, 3.0)])
        ),
        background_sh=np.array([[0.9, 1.0, 1.2]], np.float32),
        shading=None,
        provenance={},
        needs=(),
        hulls=tuple(hulls),
    )


def falling(height: float = 0.6, across: float = 0.5) -> tuple[models.MotionModel, np.ndarray]:
    """A spinning box in free fall at a height, and its centre."""
    model = models.MotionModel(
        "ballistic_spin",
        velocity=[across, 0, -1.5],
        acceleration=[0, 0, -G],
        angular_velocity=[0.5, 1.0, 0.2],
        radius=0.5 * SIZE,
    )
    return model, np.array([0.0, 0.2, height])


def resting(x: float = 1.0) -> tuple[models.MotionModel, np.ndarray]:
    """A box that rests on the floor, and its centre."""
    return models.MotionModel(radius=0.5 * SIZE), np.array([x, 0.2, 0.5 * SIZE])


def sliding(speed: float, x: float = 0.0) -> tuple[models.MotionModel, np.ndarray]:
    """A box that slides at a constant speed, and its centre."""
    model = models.MotionModel("translation", velocity=[speed, 0, 0], radius=0.5 * SIZE)
    return model, np.array([x, 0.2, 0.5 * SIZE])


def with_units(made: Scene) -> Scene:
    """The scene with units in which gravity is `G`."""
    units = dataclasses.replace(made.units, seconds_per_unit=1.0, meters_per_unit=9.81 / G)
    return dataclasses.replace(made, units=units)


def with_hull(made: Scene, number: int, center: list[float], sides: list[float]) -> Scene:
    """The scene with the hull of a box replaced by a box with other sides."""
    corners = contacts.box(np.array(center), tuple(sides)).solid.vertices
    hulls = tuple(
        dataclasses.replace(hull, vertices=corners) if hull.object_id == number else hull for hull in made.hulls
    )
    return dataclasses.replace(made, hulls=hulls)
