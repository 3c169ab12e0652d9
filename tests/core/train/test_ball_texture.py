"""Rotations of a ball from its texture: drift is undone, in fixed light, and a ball without texture shows nothing."""

import numpy as np
import pytest

from r5dgs_core.motion import rotations
from r5dgs_core.train import ball_repair, ball_texture
from r5dgs_core.train.ball_texture import SurfacePixels

TIMES = np.linspace(0, 0.75, 9)
SPIN = np.array([1.5, -4.0, 2.0])
EYES = np.array([[1, 0, 0.5], [-0.5, 0.8, 0.5], [-0.5, -0.8, 0.5]]) / np.linalg.norm([1, 0, 0.5])


def true_quats():
    return rotations.rotvecs_to_quats(TIMES[:, None] * SPIN)


def pixels(contrast=1.0, shown=lambda s, eye: True, seed=0):
    """Noisy pixels of a ball with patches of some contrast, in fixed light."""
    rng = np.random.default_rng(seed)
    seeds, tints = rng.normal(size=(14, 3)), rng.uniform(0.1, 0.9, (14, 3))
    seeds /= np.linalg.norm(seeds, axis=1, keepdims=True)
    knots, directions, colors = [], [], []
    for s, quat in enumerate(true_quats()):
        for k, eye in enumerate(EYES):
            if not shown(s, k):
                continue
            ways = rng.normal(size=(260, 3))
            ways /= np.linalg.norm(ways, axis=1, keepdims=True)
            ways = ways[ways @ eye > 0.4]
            near = np.exp(12 * rotations.rotate(rotations.conjugate(quat)[None], ways) @ seeds.T)
            patch = near / near.sum(1, keepdims=True)
            light = 0.5 + 0.5 * np.maximum(ways @ [0.6, 0, 0.8], 0)
            colors.append(
                (0.5 + contrast * (patch @ tints - 0.5)) * light[:, None] + 0.01 * rng.normal(size=ways.shape)
            )
            directions.append(ways)
            knots.append(np.full(len(ways), s))
    return SurfacePixels(np.concatenate(knots), np.concatenate(directions), np.clip(np.concatenate(colors), 0, 1))


def errors(quats):
    """Angles to the true rotations, degrees, after the best of the constant frames of the times. [S]"""
    off = rotations.multiply(rotations.conjugate(true_quats()), quats)
    every = np.degrees(rotations.angle_between(off[:, None], off[None]))
    return every[np.median(every, axis=1).argmin()]


def drifted(rate):
    """True rotations that drift by an angle per time, degrees."""
    turns = np.radians(rate) * np.arange(len(TIMES))[:, None] * np.array([0.6, 0.8, 0.0])
    return rotations.multiply(rotations.rotvecs_to_quats(turns), true_quats())


@pytest.mark.parametrize("rate", [1.0, 6.0])
def test_drift_is_undone(rate):
    found = ball_texture.align(pixels(), drifted(rate), TIMES)
    assert errors(drifted(rate)).max() > 4 * rate - 1e-6
    assert errors(found.quats).max() < 2
    assert found.error < 0.9 * found.before and found.error < 0.3 * found.plain


def test_a_gap_in_most_views_does_not_matter():
    found = ball_texture.align(pixels(shown=lambda s, k: k == 0 or not 3 <= s <= 5), drifted(5.0), TIMES)
    assert errors(found.quats).max() < 3


def test_true_rotations_are_kept():
    found = ball_texture.align(pixels(), true_quats(), TIMES)
    assert errors(found.quats).max() < 2
    assert found.error > 0.9 * found.before


def test_shade_alone_explains_a_ball_without_texture():
    found = ball_texture.align(pixels(contrast=0.0), true_quats(), TIMES)
    assert found.error > ball_repair.TEXTURED * found.plain


def test_the_frame_of_the_world_does_not_matter():
    turn = rotations.rotvecs_to_quats(np.array([0.3, -1.2, 0.5]))
    given = pixels()
    moved = SurfacePixels(given.knots, rotations.rotate(turn[None], given.directions), given.colors)
    first = ball_texture.align(given, drifted(4.0), TIMES)
    second = ball_texture.align(moved, rotations.multiply(turn, drifted(4.0)), TIMES)
    assert np.degrees(rotations.angle_between(rotations.multiply(turn, first.quats), second.quats)).max() < 0.5


def test_colors_are_those_of_the_texture():
    given = pixels()
    found = ball_texture.align(given, true_quats(), TIMES)
    turned = rotations.rotate(rotations.conjugate(found.quats)[given.knots], given.directions)
    drawn = found.colors(turned)
    shade = 0.5 + 0.5 * np.maximum(given.directions @ [0.6, 0, 0.8], 0)
    wanted = given.colors / shade[:, None]
    assert np.corrcoef(drawn.ravel(), wanted.ravel())[0, 1] > 0.85
