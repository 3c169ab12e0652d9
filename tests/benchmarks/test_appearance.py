"""The benchmark of appearance past t_max: shares that add up, what they are made of, and what freezing freezes."""

import numpy as np
import pytest

from r5dgs_core.playback import scene_player
from tests.support import benchmark_modules, scenes


@pytest.fixture
def appearance(monkeypatch):
    """The benchmark as a module."""
    with benchmark_modules.importing(monkeypatch) as load:
        yield load("appearance")


def test_shares_add_up_to_the_error_and_their_excess_to_the_distance_from_val(appearance):
    draws = np.random.default_rng(0)
    errors, pixels = draws.random((2, 5)) + 0.1, draws.integers(50, 900, (2, 5)).astype(float)
    errors[0] *= 3
    parts = [{1: np.array([0.0, 0, e[2] - light, light])} for e, light in zip(errors, (0.05, 0.02), strict=True)]
    test, val = (appearance.Sums(errors[k], pixels[k], parts[k]) for k in range(2))
    fitted = errors[0].sum() + 0.2
    rows = appearance.table(fitted, test, val)
    assert sum(row["share"] for row in rows) == pytest.approx(1)
    as_val = (errors[1] / pixels[1] * pixels[0]).sum()
    assert sum(row["excess_db"] for row in rows) == pytest.approx(10 * np.log10(fitted / as_val))
    assert rows[0]["cause"] == "poses" and rows[0]["share"] == pytest.approx(0.2 / fitted)


def test_a_change_of_colour_that_is_affine_counts_as_shading_whole(appearance):
    draws = np.random.default_rng(1)
    truth = draws.random((2, 12, 12, 3))
    change = np.eye(3) + 0.2 * draws.normal(size=(3, 3))
    shown = [appearance.Picture(None, t @ change + 0.1, None, t, None) for t in truth]
    everywhere = [np.ones((12, 12), bool)] * 2
    assert sum(p.squares.sum() for p in shown) > 1
    assert appearance.recolored(shown, everywhere) == pytest.approx(0, abs=1e-9)
    few = [np.zeros((12, 12), bool), np.eye(12, dtype=bool)]
    assert appearance.recolored(shown, few) == pytest.approx(shown[1].squares[few[1]].sum())


def test_what_is_frozen_stays_as_at_t_max_and_all_else_goes_on(appearance):
    scene = scenes.make_scene(seed=2)
    t = scene.t_max + 0.2
    bind, free = scene_player.frame(scene, scene.t_max), scene_player.frame(scene, t)
    shadow = np.isin(scene.gaussians.motion_ids, [g.id for g in scene.groups if g.role == "shadow"])
    for shading in (False, True):
        for shadows in (False, True):
            _, move = appearance.frozen(scene, shading, shadows)
            frame = move(t)
            np.testing.assert_allclose(frame.means[shadow], (bind if shadows else free).means[shadow], atol=1e-6)
            np.testing.assert_allclose(frame.means[~shadow], free.means[~shadow], atol=1e-6)
            expected = (bind if shading else free).shading_factor
            np.testing.assert_allclose(frame.shading_factor, expected, atol=1e-6)
    assert np.abs(free.means - bind.means)[shadow].max() > 1e-3
    assert np.abs(free.shading_factor - bind.shading_factor).max() > 1e-3


def test_a_gaussian_is_seen_from_where_nothing_hides_it(appearance):
    scene = scenes.make_scene(n=200, objects=1, seed=3)
    frame, camera = scene_player.frame(scene, scene.t_max), scenes.orbit_camera(0.3)
    seen = appearance.visibility(scene, frame, camera)
    assert seen.min() >= 0 and seen.max() > 0.5 and np.isfinite(seen).all()
    sight = appearance.Sight.__new__(appearance.Sight)
    sight.scene = scene
    for angle, known in ((0.3, True), (0.3 + np.pi, False)):
        sight.directions = appearance._towards(frame, scenes.orbit_camera(angle))[None]
        share = sight.share(frame, camera)
        drawn = appearance.draw(scene, frame, camera) != appearance.draw(scene, frame, camera)[0, 0]
        assert (share[drawn.any(-1)] > 0.5).mean() > 0.9 if known else share.max() < 0.1
