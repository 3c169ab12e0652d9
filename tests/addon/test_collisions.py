"""Scenes of colliding bodies: Bullet's motion obeys the parameters that are written beside it."""

import dataclasses
import importlib
import json
import sys
from pathlib import Path

import numpy as np
import pytest

from r5dgs_core.data import dataset

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
G, STEP = 9.81, 1.2 / 60  # units per second squared; seconds per frame
ROOMS = ("building", "collisions", "build_collisions")


@pytest.fixture
def examples(monkeypatch):
    """The builders of `examples/` as modules, forgotten afterwards."""
    monkeypatch.syspath_prepend(str(EXAMPLES))
    yield importlib.import_module
    for name in [name for name in sys.modules if name.split(".")[0] in ROOMS]:
        del sys.modules[name]


@pytest.fixture
def built(request, examples, blender):
    """Parameters of a scene and the places of its bodies at the 61 frames; the scene is the open file."""
    drawn, actors = examples("build_collisions").build(request.param)
    return drawn, [np.array([actor.law(frame / 60)[0] for frame in range(61)]) for actor in actors]


def test_every_kind_is_drawn_twice_and_no_two_scenes_are_alike(examples):
    parameters = examples("collisions.parameters")
    drawn = [parameters.draw(number) for number in range(len(parameters.KINDS))]
    assert len(drawn) == 12 and len({one.bodies for one in drawn}) == 12
    assert {parameters.KINDS.count(kind) for kind in parameters.KINDS} == {2}
    assert drawn == [parameters.draw(number) for number in range(12)]
    assert drawn[0].bodies != parameters.draw(0, seed=5).bodies


@pytest.mark.parametrize("built", [0], indirect=True)
def test_a_ball_bounces_with_its_restitution_and_never_sinks_in_deeper_than_a_step(built):
    drawn, (path,) = built
    ball = drawn.bodies[0]
    bottom = path[:, 2] - ball.size[0]
    assert bottom.min() > -0.03
    top = bottom[18:40].max()  # between both impacts
    first = ball.place[2] - ball.size[0] + ball.velocity[2] ** 2 / (2 * G)
    assert np.sqrt(top / first) == pytest.approx(ball.restitution, abs=0.03)


@pytest.mark.parametrize("built", [3], indirect=True)
def test_a_box_slides_as_far_as_its_friction_says(built):
    drawn, (path,) = built
    box = drawn.bodies[0]
    way = np.linalg.norm(path[-1, :2] - path[0, :2])
    assert way == pytest.approx(np.hypot(*box.velocity[:2]) ** 2 / (2 * box.friction * G), rel=0.03)
    assert np.allclose(path[-1], path[-3], atol=1e-3)


@pytest.mark.parametrize("built", [2, 4, 5], indirect=True)
def test_bodies_move_uniformly_until_the_end_of_the_observation_but_for_the_ground(built):
    """Collisions with other bodies, and the edge of the table, come later."""
    drawn, paths = built
    speeds = [np.diff(path[:, :2], axis=0) / STEP for path in paths]
    seen = round(0.6 * 60)
    assert all(np.linalg.norm(speed[:seen] - speed[0], axis=1).max() < 0.05 for speed in speeds)
    assert any(np.linalg.norm(np.diff(path, 2, axis=0)[seen:] / STEP, axis=1).max() > 0.15 for path in paths)


@pytest.mark.parametrize("built", [4], indirect=True)
def test_a_captured_scene_has_its_truth_and_its_units(built, examples, blender, tmp_path):
    script, stage = examples("build_collisions"), examples("building.stage")
    drawn, _ = built
    service, folder = stage.capture_service(), tmp_path / "set"
    settings = script.settings(service, drawn, folder, size=48, samples=1, views=2)
    settings = dataclasses.replace(settings, denoise=False, frame_step=20, test_every=1, rig_novel=0)
    result = service.capture(blender.context, settings)
    script.write_truth(drawn, folder)
    assert result.unseen == ()
    read = dataset.read(folder)
    assert read.units.seconds_per_unit == 1.2 and read.units.meters_per_unit == 1.0
    truth = json.loads((folder / "material.json").read_text())
    assert truth["bodies"][0]["restitution"] == drawn.bodies[0].restitution
    matrices = read.ground_truth.matrices
    assert matrices.shape[0] == 1 and matrices[0, -1, 2, 3] < matrices[0, 0, 2, 3] - 0.1  # it fell off the table
