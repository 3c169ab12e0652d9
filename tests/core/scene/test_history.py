import dataclasses
import json
import zipfile

import numpy as np
import pytest

from r5dgs_core import errors
from r5dgs_core.motion import rotations
from r5dgs_core.motion.history import EMPTY, Band, Event, History, PoseErrors, Segment
from r5dgs_core.motion.models import MotionModel
from r5dgs_core.scene import scene_file
from tests.support import scenes

RATES = {"velocity": (1.0, 0.0, 0.5), "acceleration": (0.0, 0.0, -9.0), "angular_velocity": (0.0, 2.0, 0.0)}
DRAG = {**RATES, "damping": (2.5,), "precession": (1.0, 0.0, 0.0)}
BAND = Band((0.75, 0.9, 1.5), (0.01, 0.02, 0.3), (0.0, 0.1, 0.5), predictable_until=1.1)
HIT = History(
    (Event(0.31, "start", 0.01), Event(0.55, "impact", 0.002)),
    (Segment(0.0, 0.31, "static", RATES), Segment(0.31, 0.55, "drag", RATES), Segment(0.55, 0.75, "drag", DRAG)),
    BAND,
)


def with_history(history, **changes):
    scene = scenes.make_scene()
    groups = list(scene.groups)
    groups[1] = dataclasses.replace(groups[1], history=history, **changes)
    return dataclasses.replace(scene, groups=tuple(groups))


def tree_of(path):
    with zipfile.ZipFile(path) as archive:
        return json.loads(archive.read("scene.json"))


def test_events_segments_and_band_survive_a_file(tmp_path):
    path = scene_file.write(with_history(HIT), tmp_path / "hit.r5dgs")
    assert scene_file.read(path).groups[1].history == HIT
    features = tree_of(path)["features"]
    assert [(row["name"], row["required"]) for row in features] == [("events", False)]
    assert tree_of(path)["groups"][1]["segments"][1]["from"] == 0.31
    assert tree_of(path)["groups"][1]["segments"][2]["parameters"]["damping"] == 2.5


def test_pose_errors_survive_a_file_and_grow_with_the_scene(tmp_path):
    errors_of_poses = PoseErrors((0.1, np.inf), (0.02, np.inf))
    path = scene_file.write(with_history(History(errors=errors_of_poses)), tmp_path / "errors.r5dgs")
    assert tree_of(path)["format_version"] == 1
    assert scene_file.read(path).groups[1].history.errors == errors_of_poses
    assert History(errors=errors_of_poses).transformed(np.eye(3), 2.0).errors == PoseErrors(
        (0.2, np.inf), (0.02, np.inf)
    )


def test_a_band_alone_needs_no_newer_release(tmp_path):
    path = scene_file.write(with_history(History(band=BAND)), tmp_path / "band.r5dgs")
    assert tree_of(path)["format_version"] == 1
    assert scene_file.read(path).groups[1].history.band == BAND
    plain = scene_file.write(with_history(EMPTY), tmp_path / "plain.r5dgs")
    assert not {"events", "segments", "band"} & set(tree_of(plain)["groups"][1])


@pytest.mark.parametrize(
    "model",
    [
        MotionModel("drag", velocity=[1, 0, 0], damping=2.0),
        MotionModel("bounce", velocity=[0, 0, -1], acceleration=[0, 0, -9], bounce_time=0.1, restitution=0.5),
        MotionModel("translation", velocity=[1, 0, 0], frequency=3.0, damping=0.5),
    ],
)
def test_a_motion_that_older_releases_would_misread_is_a_required_feature(model, tmp_path):
    path = scene_file.write(with_history(EMPTY, model=model), tmp_path / "new.r5dgs")
    assert [(row["name"], row["required"]) for row in tree_of(path)["features"]] == [("motions", True)]
    assert scene_file.read(path).groups[1].model == model


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"events": [{"time": 0.5, "kind": "explosion", "sigma": 0.1}]}, "kind: expected one of start"),
        ({"events": [{"time": 0.5, "kind": "impact", "sigma": -1.0}]}, "sigma: expected a number >= 0"),
        ({"events": [{"kind": "impact", "sigma": 1.0}]}, "time: expected float, found nothing"),
        ({"band": {"times": [], "half_width": [], "half_angle": [], "level": 0.95}}, "expected 1 to 16 numbers"),
        ({"band": {"times": [1, 1], "half_width": [0, 0], "half_angle": [0, 0], "level": 0.95}}, "increasing"),
        ({"band": {"times": [1], "half_width": [-1], "half_angle": [0], "level": 0.95}}, "half_width: .* >= 0"),
        ({"band": {"times": [1], "half_width": [1], "half_angle": [0], "level": 95}}, "between 0 and 1"),
        ({"band": {"times": [1], "half_width": [1, 2], "half_angle": [0], "level": 0.5}}, "half_width"),
        ({"errors": {"place": [0.1], "turn": [-0.1]}}, "errors: turn: expected numbers >= 0"),
        ({"errors": {"place": [0.1, None], "turn": [0.1]}}, "errors: turn: expected finite numbers of shape"),
        ({"errors": {"place": ["a"], "turn": [0.1]}}, "errors: place: expected finite numbers"),
    ],
)
def test_a_faulty_history_is_named(change, message, tmp_path):
    path = scene_file.write(with_history(HIT), tmp_path / "hit.r5dgs")
    faulty = tmp_path / "faulty.r5dgs"
    with zipfile.ZipFile(path) as source, zipfile.ZipFile(faulty, "w") as target:
        for name in source.namelist():
            data = source.read(name)
            if name == "scene.json":
                tree = json.loads(data)
                tree["groups"][1].update(change)
                data = json.dumps(tree).encode()
            target.writestr(name, data)
    with pytest.raises(errors.SceneFileError, match=message) as caught:
        scene_file.read(faulty)
    assert "groups[1]" in str(caught.value)


def test_the_warning_names_the_last_event():
    assert HIT.warning() == "not predictable past 1.10 (hit at 0.55)"
    assert HIT.text() == "set off at 0.31, not predictable past 1.10 (hit at 0.55)"
    trusted = dataclasses.replace(HIT, band=dataclasses.replace(BAND, predictable_until=None))
    assert trusted.warning() == "" and trusted.text() == "set off at 0.31, hit at 0.55"
    assert HIT.warning(1.2) == HIT.warning() and HIT.text(1.2) == HIT.text()
    assert HIT.warning(1.1) == "" and HIT.text(1.1) == trusted.text()
    assert EMPTY.text() == ""


def test_a_similarity_of_the_world_scales_widths_and_turns_rates():
    turn = rotations.quats_to_rotmats(rotations.rotvecs_to_quats(np.array([0, 0, np.pi / 2])))
    moved = HIT.transformed(turn, -2.0)
    np.testing.assert_allclose(moved.band.half_width, [0.02, 0.04, 0.6])
    assert moved.band.half_angle == BAND.half_angle and moved.events == HIT.events
    np.testing.assert_allclose(moved.segments[0].parameters["velocity"], [0, -2, -1], atol=1e-12)
    np.testing.assert_allclose(moved.segments[0].parameters["angular_velocity"], [-2, 0, 0], atol=1e-12)


def test_a_band_is_linear_between_its_knots_and_keeps_growing_after_them():
    np.testing.assert_allclose(BAND.widths(np.array([0.75, 1.2, 9.0])), [0.01, 0.16, 0.3 + 7.5 * 0.28 / 0.6])
    np.testing.assert_allclose(BAND.angles(np.array([0.9, 1.8, 9.0])), [0.1, 0.7, np.pi])
    still = Band((0.75, 1.5), (0.2, 0.1), (0.2, 0.1))
    assert still.widths(np.array([9.0])) == still.angles(np.array([9.0])) == [0.1]
