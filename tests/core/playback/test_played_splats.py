"""Gaussians at a time, for renderers that know neither motion nor shading."""

import dataclasses

import numpy as np
import pytest

from r5dgs_core.motion import rotations
from r5dgs_core.playback import played_splats, scene_player
from r5dgs_core.scene import spherical_harmonics
from tests.support.scenes import TIMES, make_scene


def colors(sh, towards):
    return np.maximum(spherical_harmonics.to_rgb(sh.astype(np.float64), towards), 0)


@pytest.mark.parametrize("t", [0.02, 0.4, 0.75, 1.2])
@pytest.mark.parametrize("degree", [0, 1, 3])
@pytest.mark.parametrize("turns_harmonics", [True, False])
@pytest.mark.parametrize("objects", [None, (2, -1), (3,), ()])
def test_played_gaussians_have_the_colours_of_their_frame(t, degree, turns_harmonics, objects):
    scene, random = make_scene(60, sh_degree=degree), np.random.default_rng(1)
    rows = np.array([1, 30, 31, 55], np.int32)
    turns = rotations.rotvecs_to_quats(0.5 * random.normal(size=(4, len(TIMES), 3))).astype(np.float32)
    turns[:, -1] = 1, 0, 0, 0
    bent = np.zeros((4, len(TIMES), 3), np.float32)
    scene = dataclasses.replace(
        scene.with_arrays(residual_rows=rows, residual_offsets=bent, residual_quats=turns, residual_log_scales=bent),
        harmonics_turn=turns_harmonics,
    )
    player = scene_player.Player(scene)
    frame, splats = player.frame(t), played_splats.at(player, t, objects)
    kept = np.isin(scene.gaussians.object_ids, [-1, 0, 1, 2, 3] if objects is None else objects)
    for name in ("means", "quats", "log_scales", "opacity_logits", "object_ids"):
        np.testing.assert_array_equal(getattr(splats, name), getattr(frame, name)[kept])
    since = frame.group_quats[scene.gaussians.motion_ids]
    if t < 0.75 and turns_harmonics:
        since[frame.turned_rows] = frame.turned_quats
    towards = random.normal(size=(60, 3))
    towards /= np.linalg.norm(towards, axis=-1, keepdims=True)
    back = rotations.rotate(rotations.conjugate(since), towards)
    wanted = colors(scene.gaussians.sh, back) * frame.shading_factor[:, None]
    np.testing.assert_allclose(colors(splats.sh, towards[kept]), wanted[kept], atol=2e-6)
