"""`r5dgs extrapolate`: pushes, materials and objects by words."""

import dataclasses

import numpy as np
import pytest

from r5dgs_core import errors
from r5dgs_core.cli.commands import extrapolate
from r5dgs_core.motion import models
from r5dgs_core.scene import scene_file
from tests.support import contact_scenes

pytest.importorskip("mujoco", reason="mujoco is not installed; it comes with the extra 'contact'")


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    made = contact_scenes.scene(contact_scenes.falling(), contact_scenes.resting(2.0))
    return scene_file.write(made, tmp_path_factory.mktemp("scenes") / "scene.r5dgs")


@pytest.fixture(scope="module")
def pushed(path):
    out = path.with_name("pushed.r5dgs")
    extrapolate.run_extrapolate(
        path, out, push=[("box 2", "0,1,0")], bounce=["box 1=0.8"], friction=["box 1=0.1"], samples=3
    )
    return out


def test_a_pushed_body_slides_off_and_another_falls_with_the_given_material(path, pushed):
    scene = scene_file.read(pushed)
    assert [group.model.kind for group in scene.groups] == ["static", "trajectory", "trajectory"]
    moved = models.evaluate(scene.groups[2].model, 0.5)[1]
    assert moved[1] > 0.1 and abs(moved[0]) < 0.02
    rows = {row["object"]: row for row in scene.needs if row["name"] == "contact"}
    assert "friction 0.1, restitution 0.8" in rows["box 1"]["reason"]
    assert rows["box 2"]["reason"].startswith("is pushed")
    before = scene_file.read(path).groups
    assert [group.smooth for group in scene.groups[1:]] == [group.model for group in before[1:]]


def test_ignoring_all_contacts_restores_the_smooth_motions(path, pushed, capsys):
    out = path.with_name("smooth.r5dgs")
    extrapolate.run_extrapolate(pushed, out, ignore=["box 1", "box 2"])
    assert "all motions are smooth" in capsys.readouterr().out
    scene, before = scene_file.read(out), scene_file.read(path)
    assert [group.model for group in scene.groups] == [group.model for group in before.groups]
    assert not any(row["name"] == "contact" for row in scene.needs)


@pytest.mark.parametrize(
    ("given", "kind", "message"),
    [
        ({"push": [("box 1", "1,2")]}, errors.UsageError, "--push 'box 1' 1,2: expected a velocity VX,VY,VZ"),
        ({"push": [("box 1", "1,2,nan")]}, errors.UsageError, "expected a velocity"),
        ({"friction": ["box 1"]}, errors.UsageError, "--friction 'box 1': expected WORDS="),
        ({"friction": ["box 1=-1"]}, errors.UsageError, "a number >= 0"),
        ({"bounce": ["box 1=1.5"]}, errors.UsageError, "a number from 0 to 1"),
        ({"samples": 0}, errors.UsageError, "--samples 0: expected 1 to 10000"),
        ({"until": np.inf}, errors.UsageError, "--until inf: expected a scene time"),
        ({"push": [("teapot", "1,0,0")]}, errors.ConfigError, "--push 'teapot'"),
        ({"push": [("box 1", "1,0,0")], "ignore": ["box 1"]}, errors.UsageError, "both name box 1"),
        ({"until": 0.6}, errors.ConfigError, "--until 0.6: expected a time after t_max = 0.6"),
        ({"push": [("box 1", "1,0,0")], "si": True}, errors.ConfigError, "--si: .* has no meters_per_unit"),
    ],
)
def test_wrong_arguments_are_named(path, given, kind, message):
    with pytest.raises(kind, match=message):
        extrapolate.run_extrapolate(path, path.with_name("never.r5dgs"), **given)
    assert not path.with_name("never.r5dgs").exists()


def test_objects_that_cannot_be_simulated_are_named(tmp_path):
    made = contact_scenes.scene(contact_scenes.resting(), contact_scenes.resting(2.0))
    flat = dataclasses.replace(made.hulls[0], vertices=made.hulls[0].vertices * [1, 1, 0])
    path = scene_file.write(dataclasses.replace(made, hulls=(flat,)), tmp_path / "scene.r5dgs")
    for given, message in [
        ({"push": [("box 1", "1,0,0")]}, "--push 'box 1': box 1: has no contacts: the points of a hull lie in a plane"),
        ({"friction": ["box 2=0.1"]}, "--friction 'box 2': box 2: has no hull to simulate"),
    ]:
        with pytest.raises(errors.ConfigError, match=message):
            extrapolate.run_extrapolate(path, path.with_name("never.r5dgs"), **given)
