"""The worker predicts motions with contacts for Blender."""

import functools
from types import SimpleNamespace

import numpy as np
import pytest

from r5dgs_core.contact import scene_future
from r5dgs_core.motion import models
from r5dgs_core.motion.models import MotionModel
from r5dgs_core.protocol.contacts import ContactRequest
from r5dgs_core.scene import scene_file
from r5dgs_core.worker import contact_prediction
from tests.core.worker.test_server import talk
from tests.support import contact_scenes, contacts
from tests.support.contact_scenes import SIZE


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    scene = contact_scenes.with_units(contact_scenes.scene(contact_scenes.sliding(1.2), contact_scenes.resting(2.0)))
    return scene_file.write(scene, tmp_path_factory.mktemp("contact") / "scene.r5dgs")


@pytest.fixture(autouse=True)
def few_samples(monkeypatch):
    """Bands of few futures, as each of them is a simulation."""
    monkeypatch.setattr(contact_prediction, "Wishes", functools.partial(contact_prediction.Wishes, samples=2))


def ask(path, **changes):
    ((header, _),) = talk({"command": "contact", **ContactRequest(str(path), 1.4, **changes).to_json()})
    return header


def wall(x):
    """Corners of a wall across the path of the box."""
    return contacts.box(np.array([x, 0.2, 0.3]), (0.1, 1.0, 0.6)).solid.vertices


def test_a_sliding_box_stops_at_an_obstacle_and_moves_on_without(path):
    pytest.importorskip("mujoco", reason="mujoco is not installed; it comes with the extra 'contact'")
    free = ask(path)["result"]
    assert not free["motions"] and not free["taken"]
    found = ask(path, obstacles={"wall": wall(0.6)})["result"]
    (motion,) = found["motions"]
    model, smooth = MotionModel.from_dict(motion["model"]), MotionModel.from_dict(motion["smooth"])
    assert motion["group"] == 1 and list(found["taken"]) == ["box 1"] and motion["history"]["band"]["half_width"]
    chosen = ask(path, obstacles={"wall": wall(0.6)}, frictions={1: 0.9})["result"]
    assert chosen["motions"][0]["material"] == motion["material"] and 0 < motion["material"][0] < 0.9
    assert models.evaluate(smooth, 0.8)[1][0] > 0.9
    assert models.evaluate(model, 0.8)[1][0] < 0.6 - 0.05 - SIZE / 2 + 0.05 * SIZE


def test_the_users_wishes_reach_the_prediction(path, monkeypatch):
    given = []
    unchanged = SimpleNamespace(groups=(), taken={}, lines=(), world=None)
    monkeypatch.setattr(scene_future, "predict", lambda scene, wishes: given.append(wishes) or unchanged)
    changes = {"frictions": {2: 0.05}, "restitutions": {1: 0.4}, "masses": {2: 50.0}, "gravity": 0.4}
    assert ask(path, **changes, obstacles={"wall": wall(0.6)})["result"] == {"motions": [], "taken": {}, "lines": []}
    (wishes,) = given
    assert wishes.materials == {1: (None, 0.4), 2: (0.05, None)} and wishes.masses == {2: 50.0}
    assert wishes.until == 1.4 and [*wishes.gravity] == [0, 0, -0.4] and list(wishes.obstacles) == ["wall"]


@pytest.mark.slow
def test_the_users_friction_mass_and_gravity_count(path):
    pytest.importorskip("mujoco", reason="mujoco is not installed; it comes with the extra 'contact'")
    near = contact_scenes.with_units(contact_scenes.scene(contact_scenes.sliding(1.5), contact_scenes.resting(0.8)))
    hit = scene_file.write(near, path.parent / "near.r5dgs")

    def ends(**changes):
        motions = ask(hit, **changes)["result"]["motions"]
        found = {one["group"]: MotionModel.from_dict(one["model"]) for one in motions}
        return [models.evaluate(found[group], 0.8)[1][0] for group in (1, 2)]

    plain, slippery = ends(), ends(frictions={2: 0.05})
    heavy, floating = ends(masses={2: 50.0}), ends(gravity=0.4)
    assert slippery[1] > plain[1] + 0.05 * SIZE and heavy[1] < 0.5 * plain[1]
    assert floating[1] > plain[1]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"until": "late"}, "'until' has to be a number"),
        ({"bodies": [{"group": 1, "friction": -1}]}, "'friction' has to be a number from 0"),
        ({"bodies": [{"group": 1, "speed": 1}]}, "'bodies' has to hold groups"),
        ({"obstacles": [{"name": "a", "corners": "AAAA"}]}, "'corners' has to be base64"),
        ({"gravity": 1e12}, "'gravity' has to be a number"),
        ({"scene": "/missing.r5dgs"}, "expected a .r5dgs file, found none"),
    ],
)
def test_invalid_requests_are_refused(path, changes, message):
    request = {"command": "contact", **ContactRequest(str(path), 1.4).to_json(), **changes}
    ((header, _),) = talk(request)
    assert not header["ok"] and message in header["error"]["message"]


def test_a_flat_obstacle_is_named(path):
    flat = wall(0.6) * [1, 1, 0]
    header = ask(path, obstacles={"Sheet": flat})
    assert "Sheet: nothing can collide with it" in header["error"]["message"]


def test_the_greeting_tells_if_contacts_can_be_simulated(monkeypatch):
    import importlib.util

    found = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "mujoco" else found(name))
    assert talk({"command": "hello"})[0][0]["result"]["contact"] is False
