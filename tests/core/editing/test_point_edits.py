"""Edited points look like their Gaussians, moved by the edit."""

import dataclasses

import numpy as np
import pytest

from r5dgs_core.editing import point_edits
from r5dgs_core.editing.point_edits import PointEdit
from r5dgs_core.motion import rotations
from r5dgs_core.playback import affine_transform
from r5dgs_core.playback.residuals import Residuals
from tests.support import scenes


@pytest.fixture(scope="module")
def scene():
    """A scene with shading, harmonics of degree 2, and residuals of every fifth Gaussian."""
    made, random = scenes.make_scene(n=300, objects=3, sh_degree=2, seed=3), np.random.default_rng(1)
    fade = (made.t_max - made.tracks.times)[None, :, None]
    offsets, turns, growths = (random.normal(size=(60, 1, 3)) * fade for _ in range(3))
    return made.with_arrays(
        residual_rows=np.arange(0, 300, 5, dtype=np.int32),
        residual_offsets=offsets.astype(np.float32),
        residual_quats=rotations.rotvecs_to_quats(turns).astype(np.float32),
        residual_log_scales=growths.astype(np.float32),
    )


@pytest.fixture
def rng():
    return np.random.default_rng(0)


ROWS = np.arange(40, 120)


def some_map(scales=(1.3, 1.3, 1.3)):
    """A turn, a scale and a shift. [4, 4]"""
    matrix = np.eye(4)
    matrix[:3, :3] = rotations.quats_to_rotmats(rotations.normalize(np.array([0.7, 0.3, -0.5, 0.4]))) * scales
    matrix[:3, 3] = (0.3, -1.0, 2.0)
    return matrix


def mapped(points, matrix):
    return (points @ matrix[:3, :3].T + matrix[:3, 3]).astype(np.float32)


def drawn(extended, place, t=None):
    """Return the points of an edit as they are placed in the extended scene."""
    bend = None if t is None else affine_transform.bend_of(Residuals(extended), t, place.start, place.count)
    return affine_transform.place(extended, place.start, place.count, place.matrix, bend=bend)


def covariances(splats):
    turns = rotations.quats_to_rotmats(splats.quats.astype(np.float64))
    return turns * np.exp(2 * splats.log_scales)[:, None] @ np.swapaxes(turns, -1, -2)


def assert_same(actual, expected, atol=2e-5):
    for name in ("means", "log_scales", "opacity_logits", "sh"):
        np.testing.assert_allclose(getattr(actual, name), getattr(expected, name), atol=atol, err_msg=name)
    np.testing.assert_allclose(covariances(actual), covariances(expected), atol=atol)


def test_an_edit_without_changes_uses_the_scenes_own_rows(scene):
    base = np.concatenate(
        [scene.gaussians.sh[ROWS, 0], 1 / (1 + np.exp(-scene.gaussians.opacity_logits[ROWS, None]))], axis=-1
    )
    same = PointEdit(
        ROWS,
        scene.gaussians.means[ROWS],
        scene.gaussians.quats[ROWS],
        np.exp(scene.gaussians.log_scales[ROWS]),
        base,
        scene.gaussians.sh[ROWS, 1:4],
    )
    extended, (place,) = point_edits.extend(scene, [same])
    assert extended is scene and (place.start, place.count) == (40, 80)
    np.testing.assert_array_equal(place.matrix, np.eye(4))


@pytest.mark.parametrize("scales", [(1.3, 1.3, 1.3), (1.0, 2.0, 0.5), (-1.0, 1.0, 1.0)])
def test_an_affine_map_of_all_centres_is_taken_out_of_the_points(scene, scales):
    matrix = some_map(scales)
    extended, (place,) = point_edits.extend(scene, [PointEdit(ROWS, mapped(scene.gaussians.means[ROWS], matrix))])
    assert extended is scene and (place.start, place.count) == (40, 80)
    np.testing.assert_allclose(place.matrix, matrix, atol=1e-5)


def test_a_map_is_found_though_some_points_were_moved_on_their_own(scene, rng):
    matrix, means = some_map(), mapped(scene.gaussians.means[ROWS], some_map())
    means[:20] += rng.normal(size=(20, 3)).astype(np.float32)
    extended, (place,) = point_edits.extend(scene, [PointEdit(ROWS, means)])
    actual, expected = drawn(extended, place), affine_transform.place(scene, 40, 80, matrix)
    assert_same(actual, dataclasses.replace(expected, means=means))


def test_points_that_share_no_map_keep_their_shapes(scene, rng):
    means = rng.normal(size=(80, 3)).astype(np.float32)
    extended, (place,) = point_edits.extend(scene, [PointEdit(ROWS, means)])
    expected = affine_transform.place(scene, 40, 80, np.eye(4))
    assert_same(drawn(extended, place), dataclasses.replace(expected, means=means))


def test_points_that_stay_in_place_keep_their_shapes_though_most_are_turned(scene):
    matrix, means = some_map(), mapped(scene.gaussians.means[ROWS], some_map())
    means[:20] = scene.gaussians.means[ROWS[:20]]
    extended, (place,) = point_edits.extend(scene, [PointEdit(ROWS, means)])
    actual = drawn(extended, place)
    expected = affine_transform.join(
        [affine_transform.place(scene, 40, 20, np.eye(4)), affine_transform.place(scene, 60, 60, matrix)]
    )
    assert_same(actual, expected)


def test_points_flattened_onto_a_plane_are_no_affine_map(scene):
    means = scene.gaussians.means[ROWS] * np.array([1, 1, 0], np.float32)
    extended, (place,) = point_edits.extend(scene, [PointEdit(ROWS, means)])
    np.testing.assert_array_equal(drawn(extended, place).means, means)


def test_a_turned_plane_of_points_turns_its_shapes(scene):
    flat = scene.with_arrays(means=scene.gaussians.means * np.array([1, 1, 0], np.float32))
    matrix = some_map()
    _, (place,) = point_edits.extend(flat, [PointEdit(ROWS, mapped(flat.gaussians.means[ROWS], matrix))])
    np.testing.assert_allclose(place.matrix, matrix, atol=1e-5)


def test_copies_have_a_map_each(scene):
    first, second = np.eye(4), some_map()
    means = np.concatenate([mapped(scene.gaussians.means[ROWS], second), scene.gaussians.means[ROWS]])
    extended, (place,) = point_edits.extend(scene, [PointEdit(np.tile(ROWS, 2), means)])
    expected = affine_transform.join(
        [affine_transform.place(scene, 40, 80, second), affine_transform.place(scene, 40, 80, first)]
    )
    assert_same(drawn(extended, place), expected, atol=5e-5)


def test_shading_and_bending_follow_copies(scene):
    t, matrix = 0.4 * scene.t_max, some_map()
    means = np.concatenate([scene.gaussians.means[ROWS], mapped(scene.gaussians.means[ROWS], matrix)])
    extended, (place,) = point_edits.extend(scene, [PointEdit(np.tile(ROWS, 2), means)])
    bend = affine_transform.bend_of(Residuals(scene), t, 40, 80)
    expected = affine_transform.join([affine_transform.place(scene, 40, 80, m, bend=bend) for m in (np.eye(4), matrix)])
    assert_same(drawn(extended, place, t=t), expected, atol=2e-4)
    without = affine_transform.join([affine_transform.place(scene, 40, 80, m) for m in (np.eye(4), matrix)])
    assert np.abs(expected.means - without.means).max() > 0.01  # they bend


def test_deleted_points_leave_the_numbers_of_the_others(scene):
    rows = ROWS[::3]
    extended, (place,) = point_edits.extend(scene, [PointEdit(rows, scene.gaussians.means[rows])])
    part = slice(place.start, place.start + place.count)
    for name in ("means", "quats", "log_scales", "opacity_logits", "sh", "object_ids"):
        np.testing.assert_array_equal(extended.arrays()[name][part], scene.arrays()[name][rows], err_msg=name)
        np.testing.assert_array_equal(extended.arrays()[name][:300], scene.arrays()[name], err_msg=name)


def test_given_shapes_and_colours_are_used_as_given(scene, rng):
    quats = rng.normal(size=(80, 4))
    scales = np.exp(scene.gaussians.log_scales[ROWS])
    scales[:10] *= 3
    base = np.concatenate([scene.gaussians.sh[ROWS, 0] + 0.3, np.full((80, 1), 0.25)], axis=-1)
    edit = PointEdit(ROWS, None, quats, scales, base, scene.gaussians.sh[ROWS, 1:4] * 2)
    extended, (place,) = point_edits.extend(scene, [edit])
    found = drawn(extended, place)
    np.testing.assert_allclose(found.quats, rotations.normalize(quats), atol=1e-6)
    np.testing.assert_allclose(np.exp(found.log_scales), scales, rtol=1e-5)
    np.testing.assert_array_equal(found.log_scales[10:], scene.gaussians.log_scales[ROWS[10:]])
    np.testing.assert_allclose(1 / (1 + np.exp(-found.opacity_logits)), 0.25, rtol=1e-5)
    np.testing.assert_allclose(found.sh[:, 0], scene.gaussians.sh[ROWS, 0] + 0.3, atol=1e-6)
    np.testing.assert_allclose(found.sh[:, 1:4], 2 * scene.gaussians.sh[ROWS, 1:4], atol=1e-6)
    np.testing.assert_array_equal(found.sh[:, 4:], scene.gaussians.sh[ROWS, 4:])


def test_no_points_are_left_of_an_edit_without_rows(scene):
    extended, (place,) = point_edits.extend(scene, [PointEdit(ROWS[:0])])
    assert place.count == 0 and len(extended.gaussians.means) == 300


@pytest.mark.parametrize(
    "edit",
    [
        PointEdit(np.array([300])),
        PointEdit(np.array([-1])),
        PointEdit(np.array([1, 2]), means=np.zeros((3, 3))),
        PointEdit(np.array([1]), means=np.full((1, 3), np.nan)),
    ],
)
def test_impossible_points_are_refused(scene, edit):
    with pytest.raises(ValueError, match="points: expected"):
        point_edits.extend(scene, [edit])
