"""Fits of the bodies of a scene."""

import types

import numpy as np
import pytest

from r5dgs_core.contact import identify, scene_bodies, scene_world, world
from r5dgs_core.motion import models
from r5dgs_core.shapes import solid
from tests.support import contact_scenes

pytest.importorskip("mujoco", reason="mujoco is not installed; it comes with the extra 'contact'")
GRAVITY = np.array([0, 0, -contact_scenes.G])


def fitter(model, monkeypatch):
    """Fitter of a box with a motion, as it is simulated, and that shape: its upper part."""
    monkeypatch.setattr(identify.Fitter, "run", lambda self: None)
    scene = contact_scenes.scene((model, np.array([0, 0.2, 0.6])))
    (body,), _ = scene_bodies.of(scene)
    shape = world.Body(solid.of(np.maximum(body.solid.vertices, [-9, -9, 0.5])))
    return scene_world._fit(scene, body, shape, world.Plane(-GRAVITY / contact_scenes.G, 0.0), GRAVITY, 1.4)[0], shape


def test_a_body_is_fitted_about_the_centre_of_the_shape_that_is_simulated(monkeypatch):
    found, shape = fitter(contact_scenes.falling()[0], monkeypatch)
    np.testing.assert_allclose(found.track.places[-1], shape.solid.center, atol=1e-9)


def test_the_step_of_a_fit_does_not_depend_on_the_direction_of_the_motion(monkeypatch):
    braked = (models.MotionModel("translation", acceleration=np.array([x, 0, -4.0])) for x in (20.0, -20.0))
    steps = [fitter(model, monkeypatch)[0].simulation.stepping.step for model in braked]
    assert steps[0] == pytest.approx(steps[1], rel=1e-6)


@pytest.mark.parametrize("misfit", [np.nan, 1e3])
def test_a_misfit_that_is_large_or_not_a_number_is_a_reason(misfit):
    assert scene_world._misfit(types.SimpleNamespace(misfit=misfit)) == "contacts do not explain its poses"
    assert scene_world._misfit(None).startswith("fewer than 3 poses") and not scene_world._misfit(
        types.SimpleNamespace(misfit=1.0)
    )
