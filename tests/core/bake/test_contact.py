"""The stage of baking that adds contacts."""

import builtins
import dataclasses
import types

import numpy as np
import pytest

from r5dgs_core import errors
from r5dgs_core.bake import contact
from r5dgs_core.bake.draft import Draft
from r5dgs_core.config.sections.needs import NeedsSection
from r5dgs_core.contact import scene_future
from r5dgs_core.motion.history import UNKNOWN_TURN, History, PoseErrors
from tests.support import contact_scenes

FALLING, RESTING = contact_scenes.scene(contact_scenes.falling()), contact_scenes.scene(contact_scenes.resting())


def baked(scene, wanted="auto", **options):
    draft = Draft(scene, None, None, None, None, parts=({"name": "motion"},), **options)
    return draft, contact.apply(draft, types.SimpleNamespace(wanted=NeedsSection(contact=wanted)))


def test_a_body_that_would_pass_through_the_floor_gets_contacts_and_a_row_with_the_evidence():
    pytest.importorskip("mujoco", reason="mujoco is not installed; it comes with the extra 'contact'")
    draft, after = baked(FALLING)
    assert (
        after.scene.groups[1].model.kind == "trajectory" and after.scene.groups[1].smooth is draft.scene.groups[1].model
    )
    before, row = after.parts
    assert before == {"name": "motion"} and row["name"] == "contact"
    assert row["object"] == "box 1" and row["object_id"] == after.scene.groups[1].object_id
    assert row["friction"] == pytest.approx(0.3, abs=0.05) and 0.05 <= row["restitution"] <= 0.98
    assert row["decision"] == "on" and row["value"] > row["threshold"] == 0.02 and "friction" in row["reason"]


def test_contacts_are_told_of_slipped_rotations_and_a_scene_without_need_is_not(monkeypatch):
    times = contact_scenes.TIMES
    errors = PoseErrors((0.01,) * len(times), (0.02,) * len(times))
    groups = [dataclasses.replace(group, history=History(errors=errors)) for group in FALLING.groups]
    scene, given = dataclasses.replace(FALLING, groups=tuple(groups)), []

    def predict(scene):
        given.append(scene.groups[1].history.errors)
        return scene_future.Prediction(scene.groups, {}, {}, ())

    monkeypatch.setattr(contact.scene_future, "predict", predict)
    draft, after = baked(scene, slipped={1: [(times[2], times[5]), (times[-2], np.inf)]})
    unknown = [n for n, turn in enumerate(given[0].turn) if turn == UNKNOWN_TURN]
    assert unknown == [3, 4, len(times) - 1] and given[0].place == errors.place
    assert after is draft and after.scene.groups[1].history.errors == errors


@pytest.mark.parametrize(("scene", "wanted"), [(RESTING, "auto"), (FALLING, "off")])
def test_without_need_or_by_the_users_wish_the_draft_stays(scene, wanted):
    draft, after = baked(scene, wanted)
    assert after is draft


def test_an_object_that_cannot_be_simulated_does_not_stop_the_bake(monkeypatch, caplog):
    def refuse(scene):
        raise errors.ConfigError("the points of a hull lie in a plane")

    monkeypatch.setattr(contact.scene_future, "predict", refuse)
    draft, after = baked(FALLING)
    assert after is draft and "no contacts are predicted: the points of a hull" in caplog.text


def test_without_mujoco_the_smooth_motion_stays_and_the_command_is_named(monkeypatch, caplog):
    original = builtins.__import__

    def refuse(name, *rest):
        if name == "mujoco":
            raise ImportError("No module named 'mujoco'", name="mujoco")
        return original(name, *rest)

    monkeypatch.setattr(builtins, "__import__", refuse)
    draft, after = baked(FALLING)
    assert after is draft
    (record,) = caplog.records
    assert "passes through" in record.getMessage() and "pip install 'r5dgs[contact]'" in record.getMessage()
