"""A new kind of motion is one file and one name in the registry: the example of docs/developer/extending.md works."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import r5dgs_core
from tests.support import pages

PACKAGE = Path(r5dgs_core.__file__).parent
NAME = "rolling"
USE = """
import dataclasses
import json

import numpy as np

from r5dgs_core.motion import fit_drawn_curve, models, rotation_centers, rotations
from r5dgs_core.motion.models import MotionModel
from r5dgs_core.motion_fit import model_selection

u, w, tau = np.array([0.0, 0.1, -0.5]), np.array([1.1, 0.4, 0.2]), np.linspace(0.0, 2.0, 12)
wheel = MotionModel("rolling", angular_velocity=w, center_offset=u, radius=0.3)

# Poses: one by one, stacked, and their derivative.
quats, moves, spins, speeds = models.evaluate_with_rates(wheel, tau)
contact = speeds + np.cross(spins, u)
assert np.allclose(contact, 0) and np.allclose(rotations.quats_to_rotvecs(quats), w * tau[:, None])
assert not moves[0].any() and wheel.turns and not wheel.is_static
ahead, behind = (models.evaluate(wheel, tau[1:] + h)[1] for h in (1e-6, -1e-6))
assert np.allclose((ahead - behind) / 2e-6, speeds[1:], atol=1e-6)
stack = models.Stack([models.STATIC, wheel, dataclasses.replace(wheel, angular_velocity=2 * w)])
assert np.allclose(stack.poses(tau[5])[1], [np.zeros(3), moves[5], models.evaluate(wheel, 2 * tau[5])[1]])

# File and edits.
assert MotionModel.from_dict(json.loads(json.dumps(wheel.to_dict()))) == wheel
turn = rotations.quats_to_rotmats(rotations.rotvecs_to_quats(np.array([0.3, -1.0, 0.5])))
assert np.allclose(models.evaluate(wheel.transformed(turn, 2.0), tau)[1], 2 * moves @ turn.T)
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
    """Folder with a copy of the package that has the kind of the page: one more file, one more name."""
    shutil.copytree(PACKAGE, tmp_path / "r5dgs_core", ignore=shutil.ignore_patterns("__pycache__"))
    (code,) = pages.blocks(pages.EXTENDING, "Motion model")
    folder = tmp_path / "r5dgs_core/motion/models"
    (folder / f"{NAME}.py").write_text(code)
    registry = (folder / "__init__.py").read_text()
    names = re.search(r"_NAMES = \(\n(?:.*\n)*?\)", registry).group()
    (folder / "__init__.py").write_text(registry.replace(names, f'{names[:-1]}    "{NAME}",\n)'))
    return tmp_path


def test_the_example_of_the_page_adds_a_motion_model(extended):
    done = subprocess.run([sys.executable, "-c", USE], cwd=extended, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
