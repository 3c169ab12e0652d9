"""Rendered scenes: masks show the bodies in their true places, and the motions are what the table of scenes says."""

import numpy as np
import pytest

from r5dgs_core.scene import cameras
from tests.support import benchmark_modules


@pytest.fixture
def rendered(monkeypatch):
    with benchmark_modules.importing(monkeypatch) as load:
        yield load("futures.rendered_scenes")


@pytest.mark.parametrize("name", ["balls", "sliders", "spinners", "arm"])
def test_masks_show_the_bodies_in_their_true_places(name, rendered):
    bodies, camera = rendered.SCENES[name](np.random.default_rng(5)), rendered.camera(3)
    solids = rendered.solids(bodies, 0.4)
    _, ids = rendered.ray_tracer.render(camera, solids, rendered.ray_tracer.floor(np.random.default_rng(0)))
    for body in bodies:
        place = cameras.project(camera, body.path(0.4)[0][None])[0][0]
        rows, columns = np.nonzero(ids == body.object_id)
        assert len(rows) > 30
        assert np.hypot(columns.mean() + 0.5 - place[0], rows.mean() + 0.5 - place[1]) < 4


def test_a_body_that_enters_late_is_not_drawn_before(rendered):
    bodies = rendered.SCENES["hidden"](np.random.default_rng(0))
    seen = [{solid.object_id for solid in rendered.solids(bodies, t)} for t in (0.29, 0.31)]
    assert seen == [{0, 2}, {0, 1, 2}]


def test_a_ball_touches_the_floor_in_every_bounce_and_never_sinks_below_it(rendered):
    body = rendered.SCENES["balls"](np.random.default_rng(1))[2]
    heights = np.array([body.path(t)[0][2] - 0.32 for t in np.linspace(0, 0.75, 3001)])
    low = (heights[1:-1] < heights[:-2]) & (heights[1:-1] <= heights[2:])
    assert low.sum() == 2
    assert heights.min() > -1e-9 and heights[1:-1][low].max() < 0.01


def test_colliding_balls_touch_once_and_keep_their_momentum(rendered):
    first, second, _ = rendered.SCENES["balls"](np.random.default_rng(2))
    times = np.linspace(0, 1, 2001)
    a, b = (np.array([body.path(t)[0] for t in times]) for body in (first, second))
    gaps = np.linalg.norm(a - b, axis=1)
    assert np.isclose(gaps.min(), 0.68, atol=2e-3)
    momentum = np.diff(a + b, axis=0)
    assert np.allclose(momentum, momentum[0], atol=1e-9)
    assert np.linalg.norm(np.diff(a, axis=0)[-1] - np.diff(a, axis=0)[0]) > 1e-4
