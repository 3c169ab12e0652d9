"""Reliability of predictions: warnings name the object, widths are those of the horizon, unknown values are None."""

import dataclasses

import numpy as np
import pytest

from r5dgs_core.motion.history import UNKNOWN_TURN, Band, Event, History, PoseErrors
from r5dgs_core.scene import motion_words, predictability
from tests.support import scenes

BAND = Band((0.75, 1.0, 1.5), (0.01, 0.2, 0.3), (0.0, 0.1, 0.5), predictable_until=0.85)
HIT = History(events=(Event(0.55, "impact", 0.002),), band=BAND)


def with_histories(*histories):
    scene = scenes.make_scene()
    groups = list(scene.groups)
    for index, history in enumerate(histories, 1):
        groups[index] = dataclasses.replace(groups[index], history=history)
    return dataclasses.replace(scene, groups=tuple(groups))


def test_a_warning_names_object_time_and_cause():
    scene = with_histories(HIT, History(band=dataclasses.replace(BAND, predictable_until=None)))
    name = scene.object(scene.groups[1].object_id).name
    assert predictability.warnings(scene) == [f"{name}: not predictable past 0.85 (hit at 0.55)"]
    assert predictability.warnings(scenes.make_scene()) == []


def test_a_motion_that_is_predictable_up_to_the_horizon_has_no_warning():
    scene = scenes.make_scene()
    end = predictability.horizon(scene)
    for until, is_late in ((end - 0.01, False), (end, True), (end + 0.2, True)):
        found = with_histories(History(HIT.events, band=dataclasses.replace(BAND, predictable_until=until)))
        outlook = predictability.outlooks(found)[found.groups[1].object_id]
        assert (outlook.warning == "") == is_late
        assert ("not predictable" in motion_words.motion_of(found, found.groups[1:2])) != is_late


def test_the_half_width_is_that_of_the_horizon():
    scene = with_histories(HIT)
    assert predictability.horizon(scene) == pytest.approx(max(1.0, scene.t_max * 4 / 3))
    found = predictability.outlooks(scene)[scene.groups[1].object_id]
    width = float(BAND.widths(np.array([predictability.horizon(scene)]))[0])
    assert found.half_width == pytest.approx(width)
    assert found.half_width_percent == pytest.approx(100 * width / (2 * scene.groups[1].model.radius))
    assert found.rotation_error_deg is None


def rigid(scene, bend=0.0):
    """The scene with bodies that deviate from rigid motion by a distance, world units."""
    groups = tuple(dataclasses.replace(group, rigid_rms=bend) for group in scene.groups)
    return dataclasses.replace(scene, groups=groups)


def test_a_trusted_object_has_an_empty_warning_and_an_unknown_one_none():
    scene = with_histories(History(band=dataclasses.replace(BAND, predictable_until=None)))
    found = predictability.outlooks(scene)
    assert found[scene.groups[1].object_id].warning == ""
    other = found[scene.groups[2].object_id]
    assert other == predictability.UNKNOWN and not other.is_known
    assert other.prediction() == {"warning": None, "half_width": None, "half_width_percent": None}


def test_errors_of_poses_are_those_of_the_times_that_show_the_object():
    errors = PoseErrors((0.01, 0.02, np.inf, 0.06), (0.01, 0.02, np.inf, 0.06))
    scene = rigid(with_histories(History(errors=errors)))
    found = predictability.outlooks(scene)[scene.groups[1].object_id]
    size = 2 * scene.groups[1].model.radius
    assert found.position_error_percent == predictability.PoseError(pytest.approx(2 / size), pytest.approx(6 / size))
    assert found.rotation_error_deg.median == pytest.approx(np.degrees(0.02)) and found.unseen_times == 1
    assert predictability.rotation_text(found.rotation_error_deg) == "1.1°, worst 3.4°"
    unknown = PoseErrors((0.01,) * 3, (UNKNOWN_TURN,) * 3)
    lost = predictability.outlooks(with_histories(History(errors=unknown)))[scene.groups[1].object_id]
    assert predictability.rotation_text(lost.rotation_error_deg) == "unknown"
    hidden = with_histories(History(errors=PoseErrors((np.inf,), (np.inf,))))
    never = predictability.outlooks(hidden)[scene.groups[1].object_id]
    assert never.rotation_error_deg is None and never.unseen_times == 1


def test_a_body_that_bends_has_no_exact_poses():
    errors = PoseErrors((0.0,) * 4, (0.0,) * 4)
    scene = rigid(with_histories(History(errors=errors)), bend=3**0.5)
    found, radius = predictability.outlooks(scene)[scene.groups[1].object_id], scene.groups[1].model.radius
    assert found.position_error_percent.median == pytest.approx(50 / radius)
    assert found.rotation_error_deg.median == pytest.approx(np.degrees(1 / radius))


def test_of_parts_of_an_object_the_worst_counts():
    good = dataclasses.replace(HIT, band=dataclasses.replace(BAND, half_width=(0, 0, 0), predictable_until=None))
    scene = with_histories(good, HIT)
    groups = list(scene.groups)
    groups[2] = dataclasses.replace(groups[2], object_id=groups[1].object_id)
    found = predictability.outlooks(dataclasses.replace(scene, groups=tuple(groups)))[groups[1].object_id]
    assert found.warning == HIT.warning() and found.half_width > 0
