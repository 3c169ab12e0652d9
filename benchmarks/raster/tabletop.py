"""Generated scene that resembles trained ones: a table in front of two walls, with six moving bodies.

Gaussians lie flat on surfaces, most are nearly opaque, colors depend on the view (degree 3), and each body has a rigid
track and a motion past t_max. The seed is fixed, so the scene is the same on every machine.
"""

from __future__ import annotations

import math

import numpy as np

from r5dgs_core.motion import models, rotations
from r5dgs_core.scene import spherical_harmonics
from r5dgs_core.scene.cameras import Camera
from r5dgs_core.scene.scene import Gaussians, MotionGroup, Scene, SceneObject, Tracks

BODIES = 6
T_MAX = 0.7
TIMES = np.linspace(0.0, T_MAX, 12)
SH_SPREAD = (0.0, 0.08, 0.04, 0.02)  # standard deviation of the coefficients of each degree; as after training


def build(count: int, camera: Camera) -> Scene:
    """A scene of ``count`` Gaussians, a third of them on the bodies, with one camera."""
    random = np.random.default_rng(0)
    per_body = count // (3 * BODIES)
    n_walls = count // 4
    n_table = count - BODIES * per_body - 2 * (n_walls // 2)
    surfaces = [
        _rectangle(random, n_table, (0, 0, 0), (1.4, 0, 0), (0, 1.4, 0), (0.55, 0.42, 0.30)),
        _rectangle(random, n_walls // 2, (0, 1.4, 0.7), (1.4, 0, 0), (0, 0, 0.7), (0.75, 0.75, 0.70)),
        _rectangle(random, n_walls // 2, (-1.4, 0, 0.7), (0, 1.4, 0), (0, 0, 0.7), (0.60, 0.65, 0.75)),
    ]
    centers = []
    for k in range(BODIES):
        angle = 2 * math.pi * k / BODIES
        radii = random.uniform(0.14, 0.26, 3)
        centers.append(np.array([0.75 * math.cos(angle), 0.75 * math.sin(angle), radii[2]]))
        surfaces.append(_ellipsoid(random, per_body, centers[-1], radii, random.uniform(0.1, 0.9, 3)))
    means, normals, sizes, colors = (np.concatenate(column) for column in zip(*surfaces, strict=True))
    counts = [count - BODIES * per_body] + [per_body] * BODIES
    ids = np.repeat(np.arange(BODIES + 1), counts).astype(np.int32)

    sh = np.concatenate(
        [SH_SPREAD[degree] * random.normal(size=(count, 2 * degree + 1, 3)) for degree in range(4)], axis=1
    )
    sh[:, 0] = spherical_harmonics.rgb_to_dc(np.clip(colors + 0.05 * random.normal(size=(count, 3)), 0, 1))
    widths = sizes[:, None] * np.exp(0.3 * random.normal(size=(count, 3)))
    widths[:, 2] *= 0.1  # along the normal
    starts = np.cumsum([0, *counts[:-1]])
    groups, tracks = [MotionGroup(0, 0, "pinned", 0, np.zeros(3), models.STATIC)], [_poses(models.STATIC)]
    for k, center in enumerate(centers):
        model = models.MotionModel(
            "ballistic_spin",
            velocity=[*random.normal(0, 0.4, 2), 0.5],
            acceleration=[0, 0, -0.8],
            angular_velocity=random.normal(0, 1.5, 3),
            radius=0.2,
        )
        groups.append(MotionGroup(k + 1, k + 1, "body", int(starts[k + 1]), center, model))
        tracks.append(_poses(model))
    names = ["background"] + [f"body {k + 1}" for k in range(BODIES)]
    return Scene(
        name="tabletop",
        gaussians=Gaussians(
            means=means.astype(np.float32),
            quats=_facing(normals).astype(np.float32),
            log_scales=np.log(widths).astype(np.float32),
            opacity_logits=random.normal(2.5, 1.5, count).astype(np.float32),
            sh=sh.astype(np.float32),
            object_ids=ids,
            motion_ids=ids.copy(),
        ),
        tracks=Tracks(TIMES, np.stack(tracks)),
        objects=tuple(
            SceneObject(k, name, (), "", (0.5, 0.5, 0.5), int(starts[k]), counts[k]) for k, name in enumerate(names)
        ),
        groups=tuple(groups),
        t_max=T_MAX,
        frames_per_unit=60.0,
        world_convention="blender",
        cameras=(camera,),
        background_sh=np.zeros((1, 3), np.float32),
    )


def _rectangle(random, count, center, half_u, half_v, color):
    """Centres, normals, sizes and colours on a rectangle with a chequered pattern."""
    u, v = np.asarray(half_u, np.float64), np.asarray(half_v, np.float64)
    at = random.uniform(-1, 1, (count, 2))
    means = np.asarray(center) + at[:, :1] * u + at[:, 1:] * v
    normal = np.cross(u, v)
    area = 4 * np.linalg.norm(normal)
    squares = np.floor(4 * at).sum(1) % 2
    colors = np.asarray(color) * (0.8 + 0.4 * squares[:, None])
    return means, np.tile(normal, (count, 1)), np.full(count, math.sqrt(area / count)), colors


def _ellipsoid(random, count, center, radii, color):
    """Centres, normals, sizes and colours on an ellipsoid."""
    directions = random.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    area = 4 * math.pi * float(np.mean(radii)) ** 2
    stripes = np.floor(6 * directions[:, 2]) % 2
    colors = np.asarray(color) * (0.7 + 0.5 * stripes[:, None])
    return center + directions * radii, directions / radii, np.full(count, math.sqrt(area / count)), colors


def _facing(normals: np.ndarray) -> np.ndarray:
    """Unit quaternions that turn z into the normals. [N, 3] -> [N, 4]"""
    n = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    n = np.where(n[:, 2:] < 0, -n, n)  # a flat Gaussian has no front, so the turn is at most a right angle
    return rotations.normalize(np.stack([1 + n[:, 2], -n[:, 1], n[:, 0], np.zeros(len(n))], 1))


def _poses(model: models.MotionModel) -> np.ndarray:
    """Observed poses that the model continues. [S, 7]"""
    quats, displacements, _, _ = models.curve(model, TIMES - T_MAX)
    return np.concatenate([rotations.normalize(quats), displacements], -1)
