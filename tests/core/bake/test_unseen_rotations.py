"""Rotations without a trace in the images: all of a plain ball, those of a plain vase about its axis, else none."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from r5dgs_core.bake import unseen_rotations
from r5dgs_core.bake.unseen_rotations import Surface
from r5dgs_core.motion import rotations, se3

LIGHT = np.array([0.5, -0.3, 0.8]) / np.linalg.norm([0.5, -0.3, 0.8])
AXIS = np.array([0.6, 0.0, 0.8])


def surfaces(lengths, albedo, seed=0, cut=0.0):
    """A body at eight knots in four views each.

    Args:
        lengths: Axes of its outline; the last one is along `AXIS`.
        albedo: Function of directions in the body [P, 3] to colours.
        cut: Share of views whose outline is cut by something in front.
    """
    draw = np.random.default_rng(seed)
    frame = np.stack([np.array([0.8, 0.0, -0.6]), np.array([0.0, 1.0, 0.0]), AXIS], axis=1)
    moments = frame @ np.diag(np.square(lengths)) @ frame.T
    found = []
    for _ in range(8):
        turn = rotations.normalize(draw.normal(size=4))
        matrix = rotations.quats_to_rotmats(turn)
        planes = np.stack([np.linalg.svd(draw.normal(size=(1, 3)))[2][1:] for _ in range(4)])
        world = planes @ (matrix @ moments @ matrix.T) @ np.swapaxes(planes, 1, 2)
        world[draw.uniform(size=4) < cut] *= np.array([[1.0, 0.0], [0.0, 0.3]])
        d = draw.normal(size=(600, 3))
        d /= np.linalg.norm(d, axis=1, keepdims=True)
        shade = 0.55 + 0.45 * np.maximum(d @ LIGHT, 0)
        found.append(Surface(d, albedo(d @ matrix) * shade[:, None], planes, world, turn))
    return found


def plain(d):
    return np.tile([0.7, 0.5, 0.3], (len(d), 1))


def banded(d):
    """Two colours, by the height along the axis."""
    return np.where((np.abs(d @ AXIS) < 0.5)[:, None], [0.8, 0.2, 0.2], [0.3, 0.6, 0.8])


def patched(d):
    draw = np.random.default_rng(1)
    seeds = draw.normal(size=(14, 3))
    return draw.uniform(0.1, 0.9, (14, 3))[(d @ (seeds / np.linalg.norm(seeds, axis=1, keepdims=True)).T).argmax(1)]


def coarse(d):
    """Colours that change so slowly that at one time they could be shade."""
    return 0.5 + 0.15 * np.sin(2 * d @ np.array([[1.0, 0.3, 0.0], [0.2, 0.8, 0.5], [0.0, -0.6, 1.0]]) + [0.5, 1.0, 2.0])


@pytest.mark.parametrize("cut", [0.0, 0.3])
def test_a_plain_ball_shows_no_rotation(cut):
    found = unseen_rotations.find(surfaces((1, 1, 1), plain, cut=cut))
    assert found is not None and len(found.axes) == 3 and found.texture < unseen_rotations.TEXTURE
    assert found.text() == "rotation about any axis: cannot be seen"


@pytest.mark.parametrize("albedo", [plain, banded])
@pytest.mark.parametrize("lengths", [(1, 1, 2), (1, 1, 0.5)])
def test_a_vase_does_not_show_the_rotation_about_its_axis(albedo, lengths):
    found = unseen_rotations.find(surfaces(lengths, albedo))
    assert found is not None and found.axes.shape == (1, 3)
    assert abs(found.axes[0] @ AXIS) > 0.999
    assert found.text().startswith("rotation about its axis")


@pytest.mark.parametrize(
    ("lengths", "albedo"), [((1, 1, 1), patched), ((1, 1, 2), patched), ((1, 0.7, 1.5), plain), ((1, 1, 1), banded)]
)
def test_texture_and_shape_show_rotations(lengths, albedo):
    found = unseen_rotations.find(surfaces(lengths, albedo))
    assert found is None


def test_a_body_that_nothing_shows_has_no_unseen_axis():
    assert unseen_rotations.find([]) is None


def test_without_spin_the_axis_and_the_centre_move_as_before():
    center, spin = np.array([0.1, 0.2, -0.3]), np.linspace(-5, 0, 9)
    turns = Rotation.from_rotvec(np.linspace(-0.8, 0, 9)[:, None] * [0.0, 1.0, 0.0]) * Rotation.from_rotvec(
        spin[:, None] * AXIS
    )
    quats = turns.as_quat()[:, [3, 0, 1, 2]]
    poses = np.concatenate([quats, np.random.default_rng(0).normal(size=(9, 3))], axis=1)
    poses[-1, 4:] = 0
    for axes in (AXIS[None], np.eye(3)):
        found = se3.without_spin(poses, axes, center)
        moved = [rotations.rotate(p[:, :4], np.broadcast_to(center, (9, 3))) + p[:, 4:] for p in (poses, found)]
        np.testing.assert_allclose(moved[1], moved[0], atol=1e-12)
        np.testing.assert_allclose(found[-1], [1, 0, 0, 0, 0, 0, 0], atol=1e-12)
    found = se3.without_spin(poses, AXIS[None], center)
    pointed = [rotations.rotate(p[:, :4], np.broadcast_to(AXIS, (9, 3))) for p in (poses, found)]
    np.testing.assert_allclose(pointed[1], pointed[0], atol=1e-12)
    assert np.abs(found[:, 1:4] @ AXIS).max() < 1e-12


def test_coarse_texture_is_seen_once_it_turns():
    moving = surfaces((1, 1, 1), coarse)
    assert unseen_rotations.find(moving) is None
    assert unseen_rotations.find(moving[:1] * 4) is not None
