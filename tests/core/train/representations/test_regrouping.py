"""Gaussians move to the group that explains their motion, unexplained ones are counted, and shadows follow."""

import numpy as np
import pytest

from r5dgs_core.motion import rotations
from r5dgs_core.train.representations import field_to_groups, regrouping

KNOTS = np.linspace(-1, 0, 9)
NORMAL = np.array([0.0, 0, 1])
LEFT, RIGHT, SHADOW = 1, 2, 3
CENTERS = {0: np.zeros(3), LEFT: np.array([-0.6, 0, 1.0]), RIGHT: np.array([0.6, 0, 1.0])}
SLANT = np.eye(3) - np.outer(NORMAL, NORMAL) + np.outer([0.5, 0, 0], NORMAL)


def carried(points, group):
    """Positions at each knot of points of the last knot, as members of a group. [n, 9, 3]"""
    path = np.repeat(points[:, None], len(KNOTS), 1)
    rise = np.stack([0 * KNOTS, 0.3 * KNOTS, 0.8 * KNOTS**2], axis=1)
    if group == SHADOW:
        return path + rise @ SLANT.T
    center = CENTERS[group]
    if group == LEFT:
        turns = rotations.rotvecs_to_quats(KNOTS[:, None] * np.array([0, 0, 1.2]))
        return center + rotations.rotate(turns, path - center) + rise
    return path + KNOTS[:, None] * np.array([0, 0.7, 0]) if group == RIGHT else path


def scene(seed=0, members=200):
    """Members of two bodies and of the shadow of the first: path, groups, opacities."""
    draw = np.random.default_rng(seed)
    parts, ids = [], []
    for group in (LEFT, RIGHT, SHADOW):
        points = draw.normal(size=(members, 3))
        points *= 0.5 * draw.random((members, 1)) ** (1 / 3) / np.linalg.norm(points, axis=1, keepdims=True)
        points = CENTERS[LEFT] * [1, 1, 0] + points * [1, 1, 0] if group == SHADOW else CENTERS[group] + points
        parts.append(carried(points, group))
        ids += [group] * members
    path = np.concatenate(parts)
    return path + 0.002 * draw.normal(size=path.shape), np.array(ids), np.full(len(ids), 0.9)


def fit_to(path, opacities):
    observed = np.ones((3, len(KNOTS)), bool)
    return lambda ids: field_to_groups._groups(path, ids, opacities, np.array([0, 5, 7]), observed, [LEFT], NORMAL)


def tidy(path, ids, opacities):
    return regrouping.regroup_until_stable(path, ids, opacities, fit_to(path, opacities))


def spread_of(groups, truth):
    """Largest distance of a group's track from the true motion of points about its centre."""
    arms = 0.4 * np.eye(3)
    worst = 0.0
    for group in (LEFT, RIGHT):
        track = groups[group]
        points = track.center + arms
        moved = track.center + rotations.rotate(track.quats[:, None], arms) + track.displacements[:, None]
        worst = max(worst, float(np.abs(moved - np.swapaxes(truth(points, group), 0, 1)).max()))
    return worst


def test_gaussians_explained_by_their_group_stay_in_it():
    path, ids, opacities = scene()
    found, groups, moves = tidy(path, ids, opacities)
    np.testing.assert_array_equal(found, ids)
    assert (moves.moved, moves.moving) == (0, len(ids))
    assert spread_of(groups, carried) < 0.005


@pytest.mark.parametrize(("wrong", "count"), [(LEFT, "to_bodies"), (RIGHT, "to_bodies"), (SHADOW, "to_shadows")])
def test_gaussians_explained_by_another_group_move_to_it(wrong, count):
    path, ids, opacities = scene()
    truth, start = ids.copy(), ids.copy()
    start[np.flatnonzero(ids == wrong)[:25]] = {LEFT: RIGHT, RIGHT: LEFT, SHADOW: LEFT}[wrong]
    # Bodies touch: no further from the members of the right group than they may be.
    found, groups, moves = tidy(path, start, opacities)
    np.testing.assert_array_equal(found, truth)
    assert getattr(moves, count) == moves.moved == 25
    assert spread_of(groups, carried) < 0.005


def test_members_of_the_background_that_move_with_a_body_join_it_and_those_that_rest_leave_it():
    path, ids, opacities = scene()
    start = ids.copy()
    halo, stuck = np.flatnonzero(ids == RIGHT)[:20], np.flatnonzero(ids == RIGHT)[20:40]
    start[halo] = 0
    path[stuck] = path[stuck][:, -1:]
    found, _, moves = tidy(path, start, opacities)
    assert (found[halo] == RIGHT).all() and (found[stuck] == 0).all()
    assert (moves.to_bodies, moves.to_rest) == (20, 20)


def test_distant_gaussians_with_equal_motion_keep_their_group():
    path, ids, opacities = scene()
    far = np.flatnonzero(ids == RIGHT)[:10]
    path[far] = carried(path[far][:, -1] + np.array([4.0, 0, 0]), LEFT)
    found, groups, moves = tidy(path, ids, opacities)
    np.testing.assert_array_equal(found, ids)
    assert moves.moved == 0 and spread_of(groups, carried) < 0.01


def test_faint_members_have_little_weight():
    path, ids, opacities = scene()
    draw = np.random.default_rng(1)
    faint = draw.random(len(ids)) < 0.4
    opacities[faint] = 0.05
    wild = path + faint[:, None, None] * np.cumsum(draw.normal(size=path.shape), axis=1)
    wild[:, -1] = path[:, -1]
    _, groups, _ = tidy(wild, ids, opacities)
    assert spread_of(groups, carried) < 0.01


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_neither_size_nor_place_of_the_world_matters(scale):
    path, ids, opacities = scene()
    draw = np.random.default_rng(2)
    start = np.where(draw.random(len(ids)) < 0.1, draw.integers(0, 4, len(ids)), ids)
    one = tidy(path, start, opacities)
    other = tidy(scale * (path + [3.0, -2, 0]), start, opacities)
    np.testing.assert_array_equal(one[0], other[0])
    assert one[2] == other[2] and one[2].moved > 20


def test_regrouping_twice_changes_nothing():
    path, ids, opacities = scene()
    draw = np.random.default_rng(3)
    start = np.where(draw.random(len(ids)) < 0.15, draw.integers(0, 4, len(ids)), ids)
    found, _, moves = tidy(path, start, opacities)
    again, _, still = tidy(path, found, opacities)
    np.testing.assert_array_equal(again, found)
    assert moves.moved > 0 and still.moved == 0


def test_the_number_of_blocks_has_no_effect(monkeypatch):
    path, ids, opacities = scene()
    start = np.roll(ids, 17)
    expected = tidy(path, start, opacities)
    monkeypatch.setattr(regrouping, "AT_ONCE", 7)
    found = tidy(path, start, opacities)
    np.testing.assert_array_equal(found[0], expected[0])
    assert found[2] == expected[2]


def test_groups_without_members_are_ignored():
    path, ids, opacities = scene()
    keep = ids != RIGHT
    found, groups, moves = tidy(path[keep], ids[keep], opacities[keep])
    np.testing.assert_array_equal(found, ids[keep])
    assert len(groups) == 4 and moves.moved == 0
    nobody = tidy(path[:0], ids[:0], opacities[:0])
    assert len(nobody[0]) == 0 and nobody[2].moving == 0


def test_a_shadow_follows_its_caster_unless_it_rests_at_the_end():
    path, ids, opacities = scene()
    mine = ids == SHADOW
    assert field_to_groups.follows(
        path[mine], opacities[mine], fit_to(path, opacities)(ids)[LEFT].displacements, NORMAL
    )
    stayed = path.copy()
    stayed[mine, -4:] = stayed[mine, -1:]
    _, groups, moves = tidy(stayed, ids, opacities)
    assert moves.resting_shadows == 1
    np.testing.assert_array_equal(groups[SHADOW].displacements, 0)
    assert np.any(tidy(path, ids, opacities)[1][SHADOW].displacements)


@pytest.mark.parametrize("turn", [0.0, 0.9])
def test_floor_gaussians_imitate_a_shadow_if_they_move_like_one(turn):
    path, ids, opacities = scene()
    floor = carried(np.random.default_rng(4).uniform([-3, -3, 0], [3, 3, 0], (50, 3)), 0)
    path, opacities = np.concatenate([path, floor]), np.append(opacities, np.full(50, 0.9))
    ids = np.append(np.where(ids == SHADOW, 0, ids), np.zeros(50, int))
    tilt = rotations.rotvecs_to_quats(np.array([turn, 0, 0]))
    path, normal = rotations.rotate(tilt, path), rotations.rotate(tilt, NORMAL)
    observed = np.ones((3, len(KNOTS)), bool)
    groups = field_to_groups._groups(path, ids, opacities, np.array([0, 5, 7]), observed, [], normal)
    casters = regrouping.imitators(path, ids, opacities, groups, normal)
    expected = np.zeros(len(ids), int)
    expected[400:600] = LEFT
    assert (casters != expected).sum() <= 5 and not casters[expected == 0].any()
