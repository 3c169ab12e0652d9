"""Fits of cameras to their images recover a known correction, and only the parameters that were asked for."""

import numpy as np
import pytest

from r5dgs_core.playback import scene_player
from r5dgs_core.render import camera_fit, scene_renderer
from r5dgs_core.scene import cameras
from r5dgs_core.scene.camera_correction import Correction
from tests.support import tiny_datasets

UNITS = camera_fit.Units(4.0, 0.015)
TRUE = Correction(
    rotvec=np.array([0.004, -0.005, 0.01]),
    shift=np.array([0.02, 0.01, -0.03]),
    log_focal=0.01,
    time=0.02,
    gain=np.diag([1.1, 1.0, 0.9]),
    offset=np.array([0.02, 0.0, -0.01]),
)


@pytest.fixture(scope="module")
def draw():
    scene = tiny_datasets.make_truth()
    player = scene_player.Player(scene)

    def picture(camera, t):
        return scene_renderer.render_frame(scene, player.frame(t, camera.center), camera).color

    return picture


@pytest.fixture(scope="module")
def shots(draw):
    given = tiny_datasets.orbit_camera(0.4, 96, 72)
    return [
        camera_fit.Shot(given, t, TRUE.seen(draw(TRUE.camera(given), t + TRUE.time)))
        for t in tiny_datasets.OBSERVED[1:5]
    ]


def test_all_parameters_are_recovered(draw, shots):
    which = camera_fit.columns(pose=True, focal=True, time=True, color=True)
    found = camera_fit.fit(draw, shots, UNITS, which, Correction())
    point = np.random.default_rng(0).normal([0, 0, 0.4], 0.6, (200, 3))
    a, b = (cameras.project(c.camera(shots[0].camera), point)[0] for c in (TRUE, found))
    assert np.sqrt(((a - b) ** 2).sum(1).mean()) < 0.05
    assert found.time == pytest.approx(TRUE.time, abs=1e-3)
    np.testing.assert_allclose(found.gain, TRUE.gain, atol=0.02)


def test_only_the_wanted_parameters_change(draw, shots):
    found = camera_fit.fit(draw, shots, UNITS, camera_fit.columns(color=True), Correction())
    assert (found.rotvec == 0).all() and (found.shift == 0).all() and found.time == found.log_focal == 0
    assert found.changes_colors


def test_tiles_share_the_pixels(draw, shots):
    which = camera_fit.columns(pose=True)
    tiles = camera_fit.normal_tiles(draw, shots[0], Correction(), UNITS, which, tiles=5)
    assert len(tiles) == 25 and all(tile.pixels > 200 for tile in tiles)
    whole = camera_fit.normal_tiles(draw, shots[0], Correction(), UNITS, which, tiles=1)[0]
    together = camera_fit.added(tiles)
    assert together.pixels == whole.pixels == 96 * 72
    np.testing.assert_allclose(together.matrix, whole.matrix, rtol=1e-9, atol=1e-9)


def test_invalid_pixels_do_not_count(draw, shots):
    valid = np.zeros((72, 96), bool)
    valid[:10] = True
    shot = camera_fit.Shot(shots[0].camera, shots[0].t, shots[0].image, valid)
    tiles = camera_fit.normal_tiles(draw, shot, Correction(), UNITS, camera_fit.columns(color=True))
    assert sum(tile.pixels for tile in tiles) == 960


def test_the_linearised_error_falls_to_that_of_the_solution(draw, shots):
    which = camera_fit.columns(pose=True, color=True)
    whole = camera_fit.normal_tiles(draw, shots[0], Correction(), UNITS, which, tiles=1)[0]
    change = whole.solve(which)
    assert whole.after(change) < 0.5 * whole.error
    assert whole.after(np.zeros(len(change))) == pytest.approx(whole.error)
