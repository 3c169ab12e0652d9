"""The backend of docs/developer/extending.md: one class and one line in the registry, used by all rooms."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from r5dgs_core import errors
from r5dgs_core.raster import backends, rasterize_splats
from r5dgs_core.raster.backend import Backend
from r5dgs_core.render import scene_renderer, segment_weights
from tests.support import pages, scenes
from tests.support.splats import camera, splats


@pytest.fixture(autouse=True)
def points(monkeypatch):
    pages.load("Rasterizer backend", "r5dgs_core.raster.points", monkeypatch)
    monkeypatch.setitem(backends.MODULES, "points", "points")


def single(*args, **kwargs):
    return [tensor.float() for tensor in splats(*args, **kwargs)]


def test_a_backend_draws_by_its_name_and_auto_does_not_change():
    scene = single(40, 3)
    drawn = rasterize_splats(*scene, camera(), torch.full((3,), 0.5), backend="points")
    covered = drawn.alpha > 0
    assert 0 < covered.sum() <= 40 and (drawn.image[~covered] == 0.5).all()
    colors = {tuple(color) for color in scene[4].tolist()}
    assert all(tuple(color) in colors for color in drawn.image[covered].tolist())
    assert backends.choose("auto", scene[0]).name != "points"


def test_a_scene_is_rendered_with_its_colours_and_sky():
    scene = scenes.make_scene(60, sh_degree=2)
    from r5dgs_core.playback import scene_player

    frame = scene_player.Player(scene).frame(0.5)
    drawn, solid = (
        scene_renderer.render_frame(scene, frame, scenes.orbit_camera(0.4), backend=backend)
        for backend in ("points", "reference")
    )
    behind = scene_renderer.sky(scene, scenes.orbit_camera(0.4))
    empty = drawn.alpha == 0
    np.testing.assert_allclose(drawn.color[empty], behind[empty], atol=1e-6)
    assert drawn.ids is not None and solid.ids is not None
    assert set(np.unique(drawn.ids)) <= set(scene.gaussians.object_ids) | {-1}


def test_weights_of_segments_follow_from_its_gradients():
    segments = torch.zeros(40, 48, dtype=torch.int64)
    weights = segment_weights.segment_weights(*single(40, 3)[:4], camera(), segments, 1, backend="points")
    drawn = rasterize_splats(*single(40, 3), camera(), backend="points")
    assert weights.sum() == (drawn.alpha > 0).sum() and set(weights.data) == {1.0}


def test_a_backend_that_cannot_draw_is_skipped_with_its_reason(monkeypatch, caplog):
    class Broken(Backend):
        name = "broken"

        def why_unavailable(self, like):
            return "no licence; remedy: buy one"

    backends._warn_once.cache_clear()
    monkeypatch.setitem(sys.modules, "r5dgs_core.raster.broken", SimpleNamespace(BACKEND=Broken()))
    monkeypatch.setattr(backends, "MODULES", {"broken": "broken", **backends.MODULES})
    for _ in range(2):
        assert backends.choose("auto", torch.zeros(1, 3)).name == "cpu"
    assert caplog.text.count("no licence") == 1
    with pytest.raises(errors.BackendError, match="'broken': no licence; remedy"):
        backends.choose("broken", torch.zeros(1, 3))
