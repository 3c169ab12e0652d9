"""A new kind of motion is one file and one name, and a new rate one line: the example of the page works."""

import subprocess
import sys

import pytest

from tests.support import new_kind

USE = """
import dataclasses
import json
import sys

import numpy as np

from r5dgs_core import errors
from r5dgs_core.motion import fit_drawn_curve, models, rotation_centers, rotations
from r5dgs_core.motion.models import MotionModel
from r5dgs_core.motion_fit import model_selection
from r5dgs_core.scene import scene_file
sys.path.append(sys.argv[1])
from tests.support import scenes

u, w, tau = np.array([0.0, 0.1, -0.5]), np.array([1.1, 0.4, 0.2]), np.linspace(0.0, 2.0, 12)
wheel = MotionModel("rolling", angular_velocity=w, center_offset=u, radius=0.3)

# Poses: one by one, stacked, and their derivative.
quats, moves, spins, speeds = models.evaluate_with_rates(wheel, tau)
contact = speeds + np.cross(spins, u)
assert np.allclose(contact, 0) and np.allclose(rotations.quats_to_rotvecs(quats), w * tau[:, None])
assert not moves[0].any() and wheel.turns and not wheel.is_static
ahead, behind = (models.evaluate(wheel, tau[1:] + h)[1] for h in (1e-6, -1e-6))
assert np.allclose((ahead - behind) / 2e-6, speeds[1:], atol=1e-6)
stack = models.MotionStack([models.STATIC, wheel, dataclasses.replace(wheel, angular_velocity=2 * w)])
assert np.allclose(stack.poses(tau[5])[1], [np.zeros(3), moves[5], models.evaluate(wheel, 2 * tau[5])[1]])

# File and edits.
assert MotionModel.from_dict(json.loads(json.dumps(wheel.to_dict()))) == wheel
turn = rotations.quats_to_rotmats(rotations.rotvecs_to_quats(np.array([0.3, -1.0, 0.5])))
assert np.allclose(models.evaluate(wheel.transformed(turn, 2.0), tau)[1], 2 * moves @ turn.T)
belt = MotionModel("rolling", belt_velocity=[0.3, 0.0, -0.2])
assert not belt.is_static and MotionModel.from_dict(belt.to_dict()) == belt and not belt.is_basic
assert np.allclose(models.evaluate(belt, tau)[1], belt.belt_velocity * tau[:, None])
assert np.allclose(belt.transformed(turn, 2.0).belt_velocity, 2 * turn @ belt.belt_velocity)
scene = scenes.make_scene()
groups = list(scene.groups)
groups[1] = dataclasses.replace(groups[1], model=belt)
scene = dataclasses.replace(scene, groups=tuple(groups))
scene_file.write(scene, "belt.r5dgs")
assert scene_file.read("belt.r5dgs").groups[1].model == belt
groups[1] = dataclasses.replace(groups[1], model=dataclasses.replace(belt, belt_velocity=[1e16, 0, 0]))
try:
    scene_file.write(dataclasses.replace(scene, groups=tuple(groups)), "far.r5dgs")
except errors.SceneFileError as error:
    assert "belt_velocity" in str(error)
else:
    raise AssertionError("the rate has no limit")
assert rotation_centers.center(wheel) is None and np.allclose(rotation_centers.axis(wheel), w / np.linalg.norm(w))

# Fits to edited curves and to observed poses.
drawn, error = fit_drawn_curve.fit(tau[1:], quats[1:], moves[1:], 0.3, 1e-6)
assert drawn.kind == "rolling" and error < 1e-6
times = np.linspace(-1.5, 0.0, 16)
quats, moves, _, _ = models.curve(wheel, times)
found = model_selection.fit(times, quats, moves, radius=0.3, candidates=("translation", "spin", "rolling"))
assert found.chosen == "rolling"
assert np.allclose(found.model.angular_velocity, w, atol=1e-4)

# Names and fields.
kind = models.KINDS["rolling"]
assert list(models.KINDS)[-1] == "rolling" and kind.word == "roll"
assert all(hasattr(wheel, name) for name in kind.fields)
"""


@pytest.fixture
def extended(tmp_path):
    """Folder with a copy of the program that has the kind and the rate of the page."""
    return new_kind.add(tmp_path)


def test_the_example_of_the_page_adds_a_motion_model(extended):
    done = subprocess.run(
        [sys.executable, "-c", USE, str(new_kind.ROOT)],
        cwd=extended,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
