"""Camera paths of nerfstudio."""

import json
import math

import numpy as np
import pytest

from r5dgs_core import errors
from r5dgs_core.film import path_file
from r5dgs_core.scene import cameras
from tests.support import scenes


def content(keys, **changes):
    entries = [
        {
            "camera_to_world": cameras.cam_world_to_opengl(key.T_cam_world).ravel().tolist(),
            "fov": math.degrees(2 * math.atan(0.5 * key.height / key.intrinsics[1, 1])),
            "aspect": key.width / key.height,
        }
        for key in keys
    ]
    header = {"camera_type": "perspective", "render_width": 96, "render_height": 72, "fps": 30, "seconds": 1.0}
    return {**header, "keyframes": [], "camera_path": entries, "crop": None, **changes}


def written(tmp_path, value):
    path = tmp_path / "path.json"
    path.write_text(value if isinstance(value, str) else json.dumps(value))
    return path


def test_cameras_are_those_of_the_file(tmp_path):
    keys, origin = [scenes.orbit_camera(angle) for angle in (0.1, 0.7, 1.3)], np.array([5.0, -2.0, 1.0])
    value = content(keys)
    for entry in value["camera_path"]:
        for axis in range(3):
            entry["camera_to_world"][4 * axis + 3] += origin[axis]
    path = path_file.read(written(tmp_path, value), origin)
    assert (path.count, path.fps, path.times) == (3, 30.0, None)
    for found, key in zip(path.cameras(3), keys, strict=True):
        np.testing.assert_allclose(found.T_cam_world, key.T_cam_world, atol=1e-9)
        np.testing.assert_allclose(found.intrinsics, key.intrinsics, atol=1e-9)


def test_times_are_read_if_every_camera_has_one(tmp_path):
    value = content([scenes.orbit_camera(angle) for angle in (0.1, 0.7)])
    for k, entry in enumerate(value["camera_path"]):
        entry["render_time"] = 0.5 * k
    np.testing.assert_array_equal(path_file.read(written(tmp_path, value), np.zeros(3)).times, [0.0, 0.5])
    del value["camera_path"][1]["render_time"]
    assert path_file.read(written(tmp_path, value), np.zeros(3)).times is None


def spoiled(change):
    value = content([scenes.orbit_camera(0.1)])
    change(value)
    return value


@pytest.mark.parametrize(
    ("value", "said"),
    [
        ("{", "damaged"),
        ([], "'camera_path'"),
        (spoiled(lambda v: v.update(camera_path=[])), "at least one camera"),
        (spoiled(lambda v: v.update(camera_type="equirectangular")), "expected perspective, found 'equirectangular'"),
        (spoiled(lambda v: v.update(render_width=0)), "'render_width': expected a number from 1"),
        (spoiled(lambda v: v.update(fps="fast")), "'fps'"),
        (spoiled(lambda v: v["camera_path"][0].update(fov=0)), "camera_path[0]: 'fov'"),
        (spoiled(lambda v: v["camera_path"][0].update(camera_to_world=[1.0] * 12)), "expected 16 numbers"),
        (spoiled(lambda v: v["camera_path"][0].update(camera_to_world=[0.0] * 16)), "'camera_to_world'"),
        (spoiled(lambda v: v["camera_path"].append(7)), "camera_path[1]"),
    ],
)
def test_faults_are_named(tmp_path, value, said):
    path = written(tmp_path, value)
    with pytest.raises(errors.ConfigError) as failed:
        path_file.read(path, np.zeros(3))
    assert said in str(failed.value) and str(path) in str(failed.value)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(errors.ConfigError, match=r"no\.json: expected a camera path"):
        path_file.read(tmp_path / "no.json", np.zeros(3))
