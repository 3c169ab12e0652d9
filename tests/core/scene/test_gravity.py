"""Gravity from falling bodies, or from the units of a scene."""

import dataclasses

import numpy as np
import pytest

from r5dgs_core.motion import knots
from r5dgs_core.motion.models import MotionModel
from r5dgs_core.scene import cameras, gravity
from r5dgs_core.scene.units import Units
from tests.support import scenes

THROWN = MotionModel("translation", velocity=[1.0, 0, 1.0], acceleration=[0.3, 0, -3.0])
SLIDING = MotionModel("translation", velocity=[1.0, 0, 0], acceleration=[0, 0.01, -0.1])


def with_motions(*models, convention="blender", units=None):
    """Scene whose bodies have motions along the axes of Blender; the others are at rest."""
    made = scenes.make_scene(n=300, objects=3, shadows=False)
    turn = cameras.WORLD_TO_BLENDER[convention].T
    pairs = zip(made.groups[1:], (*models, *[MotionModel()] * 3), strict=False)
    groups = [dataclasses.replace(group, model=model.transformed(turn, 1.0)) for group, model in pairs]
    return dataclasses.replace(
        made, groups=(made.groups[0], *groups), world_convention=convention, units=units or Units()
    )


@pytest.mark.parametrize("convention", ["blender", "opengl"])
def test_it_is_that_of_falling_bodies_along_the_up_axis(convention):
    scene = with_motions(THROWN, SLIDING, convention=convention, units=Units(1.0, 1.0))
    np.testing.assert_allclose(cameras.WORLD_TO_BLENDER[convention] @ gravity.of(scene), [0, 0, -3.0], atol=1e-12)


def test_without_an_up_axis_it_has_the_direction_of_the_fall():
    scene = with_motions(THROWN, convention="colmap")
    np.testing.assert_allclose(cameras.WORLD_TO_BLENDER["colmap"] @ gravity.of(scene), [0.3, 0, -3.0], atol=1e-12)


def test_bodies_with_contacts_count_by_their_smooth_motion():
    made = with_motions(THROWN)
    still = np.zeros((1, 3))
    rest = ((np.array([[1.0, 0, 0, 0]]), still), (still, still), (still, still))
    contact = MotionModel("trajectory", knots=knots.pack(np.zeros(1), *rest))
    bounced = dataclasses.replace(made.groups[1], model=contact, smooth=THROWN)
    scene = dataclasses.replace(made, groups=(made.groups[0], bounced, *made.groups[2:]))
    np.testing.assert_allclose(gravity.of(scene), [0, 0, -3.0])


def test_without_a_fall_it_is_the_earths_in_the_units_of_the_scene_or_unknown():
    orbit = MotionModel("translation", acceleration=[-3.0, 0, -1.0])
    np.testing.assert_allclose(gravity.of(with_motions(orbit, units=Units(2.0, 0.5))), [0, 0, -9.80665 * 4 / 0.5])
    assert gravity.of(with_motions(orbit, units=Units(meters_per_unit=1.0))) is None


@pytest.mark.parametrize(
    ("meters", "pull"), [(9.80665 / 3.2, 3.2), (9.80665 / 4.0, 3.0)], ids=["agrees", "slow motion"]
)
def test_units_tell_it_more_exactly_than_motions_that_agree_with_them(meters, pull):
    scene = with_motions(THROWN, units=Units(1.0, meters))
    np.testing.assert_allclose(gravity.of(scene), [0, 0, -pull], rtol=1e-9)


def test_a_ball_that_rolls_tells_nothing_of_gravity_although_its_heights_drift():
    drifting = MotionModel("translation", velocity=[1.0, 0, 0], acceleration=[0, 0, -0.2], radius=0.2)
    assert gravity.of(with_motions(drifting)) is None
    np.testing.assert_allclose(gravity.of(with_motions(drifting, units=Units(1.0, 1.0))), [0, 0, -9.80665])
    assert gravity.of(with_motions(dataclasses.replace(drifting, acceleration=np.array([0, 0, -2.0])))) is not None
