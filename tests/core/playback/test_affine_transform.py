"""Transformed Gaussians match the renderer's picture of Gaussians under the same map."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from r5dgs_core.motion import rotations
from r5dgs_core.playback import affine_transform, residuals, scene_player
from r5dgs_core.render import posed_scene, scene_renderer
from r5dgs_core.scene import spherical_harmonics
from r5dgs_core.scene.instance import Instance
from r5dgs_core.scene.splats import Splats
from tests.support.scenes import make_scene

TURN = rotations.quats_to_rotmats(rotations.normalize(np.array([0.3, -0.5, 0.7, 0.2])))


def matrix_of(linear, offset=(0.3, -2.0, 1.0)):
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = linear, offset
    return matrix


def directions(n=200):
    vectors = np.random.default_rng(1).normal(size=(n, 3))
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def random_sh(degree, n=5):
    return np.random.default_rng(degree).normal(size=(n, (degree + 1) ** 2, 3))


def covariances(splats):
    axes = rotations.quats_to_rotmats(splats.quats.astype(np.float64)) * np.exp(splats.log_scales)[:, None]
    return axes @ np.swapaxes(axes, -1, -2)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("mirror", [1.0, -1.0])
@given(scale=st.floats(0.01, 50))
def test_colours_turn_exactly_with_turned_mirrored_and_scaled_bodies(degree, mirror, scale):
    linear = scale * TURN @ np.diag([1, mirror, 1])
    sh, d = random_sh(degree), directions()
    before = d @ np.linalg.inv(linear).T
    before /= np.linalg.norm(before, axis=-1, keepdims=True)
    seen = spherical_harmonics.to_rgb(spherical_harmonics.transform(sh, linear)[:, None], d)
    np.testing.assert_allclose(seen, spherical_harmonics.to_rgb(sh[:, None], before), atol=1e-10)


def test_turning_harmonics_agrees_with_the_core():
    sh, quat = random_sh(3), rotations.rotmats_to_quats(TURN)
    np.testing.assert_allclose(
        spherical_harmonics.transform(sh, TURN), spherical_harmonics.rotate(sh, quat), atol=1e-12
    )


def test_no_other_coefficients_fit_a_stretched_body_better():
    linear, sh, d = np.diag([1.0, 1.4, 0.8]), random_sh(3, 1), directions(4000)
    before = d @ np.linalg.inv(linear).T
    wanted = spherical_harmonics.to_rgb(sh[:, None], before / np.linalg.norm(before, axis=-1, keepdims=True))

    def error(coefficients):
        return float(((spherical_harmonics.to_rgb(coefficients[:, None], d) - wanted) ** 2).mean())

    ours = error(spherical_harmonics.transform(sh, linear))
    assert ours < 0.5 * error(spherical_harmonics.transform(sh, affine_transform.nearest_rotation(linear)))
    assert ours < 1.1 * error(np.linalg.lstsq(spherical_harmonics.basis(d, 3), wanted[0], rcond=None)[0][None])


STRETCHED = TURN @ np.diag([1.0, 3.0, 0.2]) @ TURN


@pytest.mark.parametrize("linear", [2.5 * TURN, TURN @ np.diag([1.0, -1, 1]), STRETCHED, 1e-3 * STRETCHED])
def test_covariances_are_mapped_exactly(linear):
    splats = affine_transform.bind_state(make_scene(n=60), slice(None))
    moved = affine_transform.transform(splats, matrix_of(linear))
    wanted = linear @ covariances(splats) @ linear.T
    np.testing.assert_allclose(covariances(moved), wanted, rtol=2e-5, atol=1e-5 * np.abs(wanted).max())
    np.testing.assert_allclose(np.linalg.norm(moved.quats, axis=-1), 1, atol=1e-6)
    np.testing.assert_allclose(moved.means, splats.means @ linear.T + [0.3, -2.0, 1.0], atol=1e-5)


def test_a_transform_and_its_inverse_change_nothing():
    splats = affine_transform.bind_state(make_scene(n=60, sh_degree=3), slice(None))
    matrix = matrix_of(1.7 * TURN)
    back = affine_transform.transform(affine_transform.transform(splats, matrix), np.linalg.inv(matrix))
    for name in ("means", "log_scales", "sh"):
        np.testing.assert_allclose(getattr(back, name), getattr(splats, name), atol=2e-6, err_msg=name)
    np.testing.assert_allclose(np.abs((back.quats * splats.quats).sum(-1)), 1, atol=1e-6)


@pytest.mark.parametrize("tint", [None, (0.2, 1.5, 0.7)])
def test_a_placed_range_has_the_colours_that_the_renderer_gives_it(tint):
    scene = make_scene(n=200, sh_degree=3, shading=True)
    matrix, start, count = matrix_of(0.6 * TURN), 60, 120
    placed = affine_transform.place(scene, start, count, matrix, tint=tint)
    posed = posed_scene.pose_instances(scene, [Instance(start, count, matrix)])
    wanted = scene_renderer.colors(posed, scene.cameras[0]) * (1 if tint is None else np.array(tint))
    towards = placed.means - scene.cameras[0].center
    seen = spherical_harmonics.to_rgb(
        placed.sh.astype(np.float64), towards / np.linalg.norm(towards, axis=-1, keepdims=True)
    )
    np.testing.assert_allclose(np.maximum(seen, 0), wanted, atol=2e-5)
    np.testing.assert_array_equal(placed.means, posed.means)
    np.testing.assert_array_equal(placed.object_ids, scene.gaussians.object_ids[start : start + count])


def test_a_placed_range_is_lit_as_playback_lights_it():
    scene = make_scene(n=200, shading=True)
    frame = scene_player.Player(scene).frame(0.2)
    group = scene.groups[1]
    rows = np.flatnonzero(scene.gaussians.motion_ids == 1)
    turn = rotations.quats_to_rotmats(frame.group_quats[1])
    matrix = matrix_of(turn, group.pivot + frame.group_displacements[1] - turn @ group.pivot)
    placed = affine_transform.place(scene, int(rows[0]), len(rows), matrix)
    colour = (
        np.maximum(0.5 + spherical_harmonics.C0 * scene.gaussians.sh[rows, 0], 0) * frame.shading_factor[rows, None]
    )
    np.testing.assert_allclose(np.maximum(0.5 + spherical_harmonics.C0 * placed.sh[:, 0], 0), colour, atol=1e-6)


def test_the_light_rotates_with_the_world():
    scene = make_scene(n=200, shading=True)
    world, matrix = matrix_of(0.5 * TURN), matrix_of(TURN @ TURN)
    placed = affine_transform.place(scene, 60, 120, world @ matrix, world=world)
    np.testing.assert_allclose(placed.sh, affine_transform.place(scene, 60, 120, matrix).sh, atol=1e-6)
    assert np.abs(placed.sh - affine_transform.place(scene, 60, 120, world @ matrix).sh).max() > 1e-2


@pytest.mark.parametrize("t", [0.02, 0.4, 0.75])
@pytest.mark.parametrize("turns_harmonics", [True, False])
def test_deformed_gaussians_match_the_renderer(t, turns_harmonics):
    scene, random = make_scene(n=200, sh_degree=3, shading=True), np.random.default_rng(1)
    rows, knots = np.array([70, 71, 120, 190]), len(scene.tracks.times)
    offsets, growths = random.normal(scale=0.1, size=(2, 4, knots, 3)).astype(np.float32)
    turns = rotations.rotvecs_to_quats(0.5 * random.normal(size=offsets.shape)).astype(np.float32)
    offsets[:, -1], growths[:, -1], turns[:, -1] = 0, 0, (1, 0, 0, 0)
    scene = dataclasses.replace(
        scene.with_arrays(
            residual_rows=rows.astype(np.int32),
            residual_offsets=offsets,
            residual_quats=turns,
            residual_log_scales=growths,
        ),
        harmonics_turn=turns_harmonics,
    )
    matrix, start, count = matrix_of(0.6 * TURN), 60, 120
    bend = affine_transform.bend_of(residuals.Residuals(scene), t, start, count)
    assert (bend is None) == (t == 0.75)
    placed = affine_transform.place(scene, start, count, matrix, bend=bend)
    posed = posed_scene.pose_instances(scene, [posed_scene.Instance(start, count, matrix, t=t)])
    for name in ("means", "log_scales"):
        np.testing.assert_allclose(getattr(placed, name), getattr(posed, name), atol=2e-6, err_msg=name)
    np.testing.assert_allclose(np.abs((placed.quats * posed.quats).sum(-1)), 1, atol=1e-6)
    towards = placed.means - scene.cameras[0].center
    seen = spherical_harmonics.to_rgb(
        placed.sh.astype(np.float64), towards / np.linalg.norm(towards, axis=-1, keepdims=True)
    )
    np.testing.assert_allclose(np.maximum(seen, 0), scene_renderer.colors(posed, scene.cameras[0]), atol=3e-5)


def test_joining_keeps_order_and_fills_lower_degrees_with_nothing():
    low, high = (affine_transform.bind_state(make_scene(n=n, sh_degree=d), slice(None)) for n, d in ((30, 0), (20, 2)))
    both = affine_transform.join([low, high])
    assert both.sh.shape == (50, 9, 3)
    assert not both.sh[:30, 1:].any()
    np.testing.assert_array_equal(both.means[30:], high.means)
    np.testing.assert_array_equal(both.object_ids[:30], low.object_ids)
    without = affine_transform.join(
        [low, Splats(high.means, high.quats, high.log_scales, high.opacity_logits, high.sh)]
    )
    assert without.identities is None and without.object_ids is None
    assert affine_transform.join([]).means.shape == (0, 3)


def test_the_nearest_rotation_of_a_stretched_turn_is_the_turn():
    random = np.random.default_rng(2)
    turns = rotations.quats_to_rotmats(rotations.normalize(random.normal(size=(5, 4))))
    roots = random.normal(size=(5, 3, 3))
    stretched = turns @ (roots @ np.swapaxes(roots, -1, -2) + 0.1 * np.eye(3))
    np.testing.assert_allclose(affine_transform.nearest_rotation(stretched), turns, atol=1e-9)
    np.testing.assert_allclose(affine_transform.nearest_rotation(stretched * [-1, 1, 1]), turns, atol=1e-9)
    np.testing.assert_allclose(affine_transform.nearest_rotation(stretched[0]), turns[0], atol=1e-9)


def test_a_map_that_flattens_space_is_refused():
    splats = affine_transform.bind_state(make_scene(n=10, objects=0, unassigned=0), slice(None))
    for bad in (matrix_of(np.diag([1.0, 0, 1])), np.full((4, 4), np.nan), np.eye(3)):
        with pytest.raises(ValueError):
            affine_transform.transform(splats, bad)
