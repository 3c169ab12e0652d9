"""The spread of a motion equals that of motions with random rates from its covariance."""

from dataclasses import replace

import numpy as np
import pytest

from r5dgs_core.motion import confidence, models, rotations

RATES = ("velocity", "acceleration", "angular_velocity", "angular_acceleration")
NAMES = tuple(f"{name}.{axis}" for name in RATES for axis in "xyz")


def with_covariance(model, seed=0, size=1e-3, names=NAMES):
    rng = np.random.default_rng(seed)
    root = rng.normal(scale=size, size=(len(names), len(names)))
    return replace(model, covariance=root @ root.T, covariance_names=names)


@pytest.mark.parametrize(
    "model",
    [
        models.MotionModel("translation", velocity=[1, 0, 0], radius=0.4),
        models.MotionModel("ballistic_spin", velocity=[1, 0, 0], angular_velocity=[0, 1, 2], radius=0.4),
        models.MotionModel("world_twist", velocity=[0, 1, 0], angular_velocity=[0, 0, 1], radius=0.4),
        models.MotionModel("translation", acceleration=[0, 0, 1], frequency=3.0, radius=0.4),
    ],
)
def test_it_is_the_spread_of_sampled_motions(model):
    names = (*NAMES, "frequency") if model.frequency else NAMES
    model = with_covariance(model, names=names)
    drawn_models = []
    for draw in np.random.default_rng(1).multivariate_normal(np.zeros(len(names)), model.covariance, 1500):
        shifts = {name: getattr(model, name) + draw[3 * k : 3 * k + 3] for k, name in enumerate(RATES)}
        if model.frequency:
            shifts["frequency"] = model.frequency + draw[-1]
        drawn_models.append(replace(model, covariance=None, covariance_names=(), **shifts))
    stack = models.MotionStack(drawn_models)
    for tau in (0.2, 0.6):
        quat, center = models.evaluate(model, tau)
        quats, centers = stack.poses(tau)
        angles = rotations.angle_between(quats, quat)
        expected = np.sqrt(np.mean(((centers - center) ** 2).sum(-1) + 2 / 3 * (model.radius * angles) ** 2))
        np.testing.assert_allclose(confidence.position_sigma(model, np.array([tau])), expected, rtol=0.08)
    assert confidence.position_sigma(model, np.zeros(1)) == 0


def test_a_certain_velocity_grows_the_spread_with_the_square_of_time():
    model = with_covariance(models.MotionModel("translation", velocity=[1, 2, 3], acceleration=[0, 0, 1]))
    known = confidence.with_exact_fields(model, {"velocity"})
    sigma = confidence.position_sigma(known, np.array([0.1, 0.2, 0.4]))
    np.testing.assert_allclose(sigma / sigma[0], [1, 4, 16], rtol=1e-5)


def test_exact_and_unknown_rates_have_no_spread():
    tau = np.linspace(0, 1, 5)
    assert not confidence.position_sigma(models.MotionModel("translation", velocity=[1, 0, 0]), tau).any()
    model = with_covariance(models.MotionModel("ballistic_spin", angular_velocity=[1, 0, 0]))
    assert not confidence.position_sigma(confidence.with_exact_fields(model, set(RATES)), tau).any()
    assert confidence.with_exact_fields(model, set()) is model
