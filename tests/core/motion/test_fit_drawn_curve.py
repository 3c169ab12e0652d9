"""Curves of a motion model are recognised; others are approximated, and the returned error is the true one."""

import numpy as np
import pytest

from r5dgs_core.motion import fit_drawn_curve, models, rotations
from r5dgs_core.motion.models import MotionModel

TAUS = np.linspace(0, 0.5, 41)[1:]
RATES = {
    "velocity": (0.5, 0.2, -0.4),
    "acceleration": (0, 0.3, -2.5),
    "angular_velocity": (0.4, -1.0, 9.0),
    "angular_acceleration": (0.3, 0.1, -3.5),
    "center_offset": (0.1, 0.2, 0.0),
}
CASES = (
    ("static", ()),
    ("translation", ("velocity", "acceleration")),
    ("constant_twist", ("velocity", "angular_velocity")),
    ("ballistic_spin", ("velocity", "acceleration", "angular_velocity")),
    ("ballistic_spin", tuple(RATES)),
    ("ballistic_spin", ("angular_velocity", "center_offset")),  # a hinge, and a fast one
)


@pytest.mark.parametrize(("kind", "names"), CASES)
@pytest.mark.parametrize("sign", [1, -1])
def test_models_are_recovered_and_extrapolate_alike(kind, names, sign):
    truth = MotionModel(kind, radius=0.3, **{name: RATES[name] for name in names})
    quats, moves = models.evaluate(truth, TAUS)
    found, error = fit_drawn_curve.fit(TAUS, sign * quats, moves, 0.3, 1e-6)
    assert error < 1e-6
    later = np.array([0.6, 0.8])
    assert fit_drawn_curve.pose_errors(*models.evaluate(found, later), *models.evaluate(truth, later), 0.3).max() < 1e-4


def test_the_simplest_kind_within_the_tolerance_is_chosen():
    moves = np.outer(TAUS, (1.0, 0, 0)) + 1e-5 * np.sin(40 * TAUS)[:, None]
    quats = rotations.identity(len(TAUS))
    assert fit_drawn_curve.fit(TAUS, quats, moves, 0.3, 1e-4)[0].kind == "translation"
    assert fit_drawn_curve.fit(TAUS, quats, 1e-5 * moves, 0.3, 1e-4)[0].is_static


def test_the_fit_to_an_arbitrary_curve_returns_its_true_error():
    moves = np.stack([0.2 * np.sin(25 * TAUS), 0.3 * TAUS, np.abs(TAUS - 0.2)], -1)
    quats = rotations.rotvecs_to_quats(np.stack([0 * TAUS, np.sin(9 * TAUS), TAUS], -1))
    found, error = fit_drawn_curve.fit(TAUS, quats, moves, 0.3, 1e-4)
    assert error > 1e-2
    assert error == pytest.approx(fit_drawn_curve.pose_errors(*models.evaluate(found, TAUS), quats, moves, 0.3).max())
    still = fit_drawn_curve.pose_errors(
        rotations.identity(len(TAUS)), np.zeros((len(TAUS), 3)), quats, moves, 0.3
    ).max()
    assert error < 0.7 * still


def test_one_pose_is_enough_for_a_velocity():
    found, error = fit_drawn_curve.fit(np.array([0.5]), rotations.identity(1), np.array([[1.0, 0, 0]]), 0.3, 1e-9)
    assert error < 1e-6 and models.evaluate(found, 0.5)[1] == pytest.approx([1, 0, 0])
