"""Balls and boxes of known size, made of Gaussians, with floaters and fringes."""

import numpy as np

from r5dgs_core.motion import rotations


def ball(radius=1.0, count=800, center=(0.0, 0.0, 0.0), seed=0):
    """Flat Gaussians on a sphere: means, quats, scales, opacities."""
    rng = np.random.default_rng(seed)
    towards = rng.normal(size=(count, 3))
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    size = 0.5 * radius * np.sqrt(4 * np.pi / count)
    scales = np.tile([size, size, 0.02 * radius], (count, 1))
    return np.array(center) + radius * towards, _facing(towards), scales, np.full(count, 0.7)


def box(sides=(1.0, 0.6, 0.4), count=1200, seed=0):
    """Flat Gaussians on the surface of a box: means, quats, scales, opacities."""
    rng, sides = np.random.default_rng(seed), np.array(sides)
    areas = sides.prod() / sides
    face = rng.choice(3, count, p=areas / areas.sum())
    sign = rng.choice([-1, 1], count)
    towards = np.eye(3)[face] * sign[:, None]
    size = 0.5 * np.sqrt(2 * areas.sum() / count)
    room = np.maximum(sides / 2 - 1.5 * size, 0.0)  # of the centres, so that the faces do not overhang
    means = rng.uniform(-room, room, (count, 3))
    means[np.arange(count), face] = sign * sides[face] / 2
    scales = np.tile([size, size, 0.01 * sides.max()], (count, 1))
    return means, _facing(towards), scales, np.full(count, 0.7)


def with_floaters(gaussians, size=1.0, seed=1):
    """Add a distant cloud of dense Gaussians, single ones nearby, and a wide faint fringe."""
    means, quats, scales, opacities = gaussians
    rng = np.random.default_rng(seed)
    more = [
        (rng.normal(scale=0.1, size=(30, 3)) + 4, 0.05, 0.9),
        (rng.normal(scale=1.5, size=(12, 3)), 0.01, 0.9),
        (means[:: len(means) // 20], 0.3, 0.011),
    ]
    for where, scale, opacity in more:
        means = np.concatenate([means, size * where if opacity > 0.5 else where])
        quats = np.concatenate([quats, rotations.identity(len(where))])
        scales = np.concatenate([scales, np.full((len(where), 3), size * scale)])
        opacities = np.concatenate([opacities, np.full(len(where), opacity)])
    return means, quats, scales, opacities


def _facing(normals):
    """Quaternions that turn +z to the normals."""
    half = normals + [0, 0, 1]
    half[np.linalg.norm(half, axis=1) < 1e-6] = [1, 0, 0]
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    return np.concatenate([half @ np.array([[0.0], [0], [1]]), np.cross([0, 0, 1], half)], axis=1)
