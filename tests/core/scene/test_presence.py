"""Times at which groups are absent: rule at and between the observed times, storage, and faults."""

import dataclasses
import json
import math
import zipfile

import numpy as np
import pytest

from r5dgs_core import errors
from r5dgs_core.playback import scene_info
from r5dgs_core.scene import motion_words, presence, scene_file
from tests.support.scenes import make_scene, with_absence

INF = math.inf
TIMES = np.array([0.0, 0.1, 0.3, 0.4, 0.6])


@pytest.mark.parametrize(
    "absent, expected",
    [
        ("00000", ()),
        ("11000", ((-INF, 0.2),)),
        ("00011", ((0.35, INF),)),
        ("10101", ((-INF, 0.05), (0.2, 0.35), (0.5, INF))),
        ("11111", ()),
    ],
)
def test_groups_enter_and_leave_halfway_between_observed_times(absent, expected):
    found = presence.intervals(TIMES, np.array(list(absent)) == "1")
    assert np.allclose(found, expected) and presence.are_sound(found)


def test_the_first_time_of_an_interval_is_absent_and_the_last_is_not():
    found = (-INF, 0.2), (0.5, 0.6)
    assert [presence.is_absent(found, t) for t in (-5.0, 0.19, 0.2, 0.5, 0.6, INF, math.nan)] == [1, 1, 0, 1, 0, 0, 0]
    assert presence.span(found) == (0.2, INF) and presence.span(()) == (-INF, INF)
    assert presence.span([(0.3, 0.4), (0.5, INF)]) == (-INF, 0.5)


def test_words_name_the_times_of_absence():
    assert presence.text([(-INF, 0.2), (0.3, 0.4), (0.5, INF)]) == (
        "enters at 0.20, absent from 0.30 to 0.40, leaves at 0.50"
    )
    scene = with_absence(make_scene(60), (-INF, 0.2))
    assert motion_words.motion_of(scene, scene.bodies(1)).endswith("; enters at 0.20")
    assert scene_info.info(scene)["motion_groups"][1]["absent"] == [[None, 0.2]]


@pytest.mark.parametrize("precision", ["compact", "exact", "quantised"])
def test_absence_is_stored_as_an_optional_feature_and_only_if_needed(tmp_path, precision):
    scene = with_absence(make_scene(60), (-INF, 0.1), (0.3, 0.4), (0.7, INF))
    path = scene_file.write(scene, tmp_path / "scene.r5dgs", precision=precision)
    assert [group.absent for group in scene_file.read(path).groups] == [group.absent for group in scene.groups]
    tree = json.loads(zipfile.ZipFile(path).read("scene.json"))
    feature = next(row for row in tree["features"] if row["name"] == "absence")
    assert not feature["required"]
    assert tree["groups"][1]["absent"] == [[None, 0.1], [0.3, 0.4], [0.7, None]]
    plain = json.loads(zipfile.ZipFile(scene_file.write(make_scene(60), path)).read("scene.json"))
    assert plain["format_version"] == 1 and not any("absent" in group for group in plain["groups"])


@pytest.mark.parametrize(
    "absent",
    [
        ((0.2, 0.2),),
        ((0.3, 0.2),),
        ((0.1, 0.3), (0.3, 0.4)),
        ((0.1, INF), (0.5, 0.6)),
        ((-INF, INF),),
        ((math.nan, 1),),
    ],
)
def test_intervals_in_a_wrong_order_are_refused(tmp_path, absent):
    with pytest.raises(errors.SceneFileError, match="motion group 1: expected 'absent'"):
        scene_file.write(with_absence(make_scene(20), *absent), tmp_path / "scene.r5dgs")


@pytest.mark.parametrize("absent", ["soon", [0.1, 0.2], [[0.1]], [[True, 0.2]], [["a", None]], [[0.1, 0.2, 0.3]]])
def test_entries_of_another_form_are_refused(tmp_path, absent):
    path = scene_file.write(with_absence(make_scene(20), (-INF, 0.1)), tmp_path / "scene.r5dgs")
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    tree = json.loads(members["scene.json"])
    tree["groups"][1]["absent"] = absent
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in (members | {"scene.json": json.dumps(tree)}).items():
            archive.writestr(name, data)
    with pytest.raises(errors.SceneFileError, match=r"groups\[1\]: absent: expected"):
        scene_file.read(path)


def test_the_pinned_group_is_always_there(tmp_path):
    scene = make_scene(20)
    groups = (dataclasses.replace(scene.groups[0], absent=((0.1, 0.2),)), *scene.groups[1:])
    with pytest.raises(errors.SceneFileError, match="none of group 0"):
        scene_file.write(dataclasses.replace(scene, groups=groups), tmp_path / "scene.r5dgs")
