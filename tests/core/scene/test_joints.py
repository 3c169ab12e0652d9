import dataclasses
import json
import zipfile

import numpy as np
import pytest

from r5dgs_core import errors
from r5dgs_core.motion import joint as joints
from r5dgs_core.motion.models import MotionModel
from r5dgs_core.scene import scene_file
from tests.support import arms, scenes


def tree_of(path):
    with zipfile.ZipFile(path) as archive:
        return json.loads(archive.read("scene.json"))


def with_group(scene, row, **changes):
    groups = list(scene.groups)
    groups[row] = dataclasses.replace(groups[row], **changes)
    return dataclasses.replace(scene, groups=tuple(groups))


@pytest.mark.parametrize("kind", joints.KINDS)
def test_parts_survive_a_file(kind, tmp_path):
    scene = arms.make_arm(kind)
    joint = dataclasses.replace(scene.groups[2].joint, stop_time=0.4)
    path = scene_file.write(with_group(scene, 2, joint=joint), tmp_path / "arm.r5dgs")
    back = scene_file.read(path).groups[2]
    assert back.parent == 1
    for name in ("kind", "limits", "model", "stop_time"):
        assert getattr(back.joint, name) == getattr(joint, name)
    np.testing.assert_array_equal(back.joint.point, joint.point)
    np.testing.assert_array_equal(back.joint.axis, joint.axis)
    features = tree_of(path)["features"]
    assert [(row["name"], row["required"]) for row in features] == [("parts", False)]
    again = scene_file.write(scene_file.read(path), tmp_path / "again.r5dgs")
    assert again.read_bytes() == path.read_bytes()


def test_scenes_without_parts_have_no_trace_of_them(tmp_path):
    tree = tree_of(scene_file.write(scenes.make_scene(), tmp_path / "plain.r5dgs"))
    assert tree["format_version"] == 1 and not any({"parent", "joint"} & set(row) for row in tree["groups"])


BAD = {
    "a parent alone": ({"joint": None}, "'parent' and 'joint' together"),
    "a joint alone": ({"parent": None}, "'parent' and 'joint' together"),
    "itself as parent": ({"parent": 2}, "no circle of parents"),
    "an unknown parent": ({"parent": 99}, "no circle of parents"),
    "the pinned group as parent": ({"parent": 0}, "no circle of parents"),
    "another object's parent": ({"parent": 3}, "a parent of the same object"),
    "a follower": ({"follows": 1, "follow_matrix": np.eye(3)}, "a body that follows none"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_tree_is_named(name, tmp_path):
    changes, message = BAD[name]
    with pytest.raises(errors.SceneFileError, match=f"motion group 2: expected {message}|{message}"):
        scene_file.write(with_group(arms.make_arm(), 2, **changes), tmp_path / "bad.r5dgs")


BAD_JOINTS = {
    "kind": ({"kind": "screw"}, "kind: expected one of hinge, ball, slider, found 'screw'"),
    "point": ({"point": np.full(3, np.nan)}, "point: expected three numbers"),
    "no axis": ({"axis": None}, "axis: expected a unit vector, found None"),
    "long axis": ({"axis": np.array([0, 0, 2.0])}, "axis: expected a unit vector"),
    "no limits": ({"limits": None}, "limits: expected two numbers"),
    "limits": ({"limits": (1.0, -1.0)}, "limits: expected two numbers .* in order"),
    "stop time": ({"stop_time": -1.0}, "stop_time: expected a number from 0"),
    "model": ({"model": MotionModel("translation", velocity=[1e20, 0, 0])}, "joint: model: velocity: expected numbers"),
}


@pytest.mark.parametrize("name", BAD_JOINTS)
def test_a_bad_joint_is_named(name, tmp_path):
    changes, message = BAD_JOINTS[name]
    scene = arms.make_arm()
    scene = with_group(scene, 2, joint=dataclasses.replace(scene.groups[2].joint, **changes))
    with pytest.raises(errors.SceneFileError, match=message):
        scene_file.write(scene, tmp_path / "bad.r5dgs")


@pytest.mark.parametrize(
    ("key", "value"), [("kind", 3), ("model", {"kind": "magic"}), ("point", [1, 2]), ("axis", "x"), ("limits", [0])]
)
def test_a_malformed_joint_is_named(key, value, tmp_path):
    path = scene_file.write(arms.make_arm(), tmp_path / "arm.r5dgs")
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(tmp_path / "bad.r5dgs", "w") as new:
        for name in old.namelist():
            data = old.read(name)
            if name == "scene.json":
                tree = json.loads(data)
                tree["groups"][2]["joint"][key] = value
                data = json.dumps(tree).encode()
            new.writestr(name, data)
    with pytest.raises(errors.SceneFileError, match=rf"groups\[2\]: joint: {key}"):
        scene_file.read(tmp_path / "bad.r5dgs")
