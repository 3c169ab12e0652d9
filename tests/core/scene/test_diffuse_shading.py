"""Shading in fixed light: one rotation for all Gaussians gives the factors of the same rotation for each."""

import numpy as np
import pytest

from r5dgs_core.motion import rotations
from r5dgs_core.scene import diffuse_shading
from tests.support.scenes import make_scene


def test_one_turn_lights_gaussians_as_the_same_turn_for_each():
    scene = make_scene(objects=5, sh_degree=1)
    turns = rotations.quats_to_rotmats(rotations.normalize(np.random.default_rng(4).normal(size=(30, 4))))
    rest, vectors, light = diffuse_shading.rest_factors(scene)[:30], scene.shading.vectors[:30], scene.shading.light
    wanted = [max(r + (turn.T @ light - light) @ v, 0) for r, v, turn in zip(rest, vectors, turns, strict=True)]
    changes = diffuse_shading.light_change(light, turns)
    np.testing.assert_allclose(diffuse_shading.factors(rest, vectors, changes), wanted, atol=1e-6)
    for k in range(30):
        one = diffuse_shading.factors(rest[k : k + 1], vectors[k : k + 1], changes[k])
        assert one == pytest.approx(wanted[k], abs=1e-6)
