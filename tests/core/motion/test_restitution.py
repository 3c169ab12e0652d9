import math

import pytest

from r5dgs_core.motion import restitution


@pytest.mark.parametrize("e", [0.05, 0.1, 0.3, math.exp(-2), 0.5, 0.7, 0.9, 0.98])
def test_the_damping_of_a_restitution_has_that_restitution(e):
    assert restitution.of_damping(restitution.damping_of(e)) == pytest.approx(e, abs=1e-6)


def test_restitution_falls_with_the_damping_and_passes_critical_damping_smoothly():
    damping = [0.0, 0.01, 0.1, 0.5, 0.999, 1.0, 1.001, 2.0, 20.0]
    found = [restitution.of_damping(z) for z in damping]
    assert found == sorted(found, reverse=True) and found[0] == 1.0
    assert found[4] - found[6] < 1e-3 and found[5] == pytest.approx(math.exp(-2))


def test_restitutions_outside_of_the_simulated_range_are_clipped():
    assert restitution.damping_of(0.0) == restitution.damping_of(restitution.LEAST)
    assert restitution.reference(1.0, 100.0) == restitution.reference(restitution.MOST, 100.0)
    stiffness, damping = restitution.reference(0.5, 200.0)
    assert stiffness == -40000 and damping < 0
