"""The worker caches edited points and draws them instead of the scene's own."""

import base64

import numpy as np
import pytest

from r5dgs_core.editing import point_edits
from r5dgs_core.editing.point_edits import PointEdit
from r5dgs_core.render import posed_scene, scene_renderer
from r5dgs_core.scene import scene_file
from r5dgs_core.scene.instance import Instance
from tests.core.worker.test_server import CAMERA, CAMERA_JSON, load, talk
from tests.support import scenes

EYE = np.eye(4).tolist()


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    scene = scenes.make_scene(n=200, sh_degree=1)
    return scene_file.write(scene, tmp_path_factory.mktemp("serve") / "scene.r5dgs")


@pytest.fixture(scope="module")
def scene(path):
    return scene_file.read(path)


def encoded(edit):
    names = [name for name in ("means", "quats", "scales", "base", "sh") if getattr(edit, name) is not None]
    arrays = {name: np.asarray(getattr(edit, name), "<f4") for name in names} | {"rows": np.asarray(edit.rows, "<i4")}
    return {name: base64.b64encode(values.tobytes()).decode() for name, values in arrays.items()}


def points(*keys, **new):
    return {"command": "points", "keep": list(keys), "new": {key: encoded(edit) for key, edit in new.items()}}


def picture(*instances):
    return {"command": "render", "camera": CAMERA_JSON, "instances": list(instances), "sky": None, "want": ["owners"]}


def entry(key):
    return {"scene": 0, "points": key, "matrix": EYE}


def scattered(scene, rows):
    means = scene.gaussians.means[rows] + np.random.default_rng(0).normal(scale=0.2, size=(len(rows), 3)).astype(
        np.float32
    )
    return PointEdit(
        rows, means, None, 2 * np.exp(scene.gaussians.log_scales[rows]), None, 0.5 * scene.gaussians.sh[rows, 1:4]
    )


def test_edited_points_are_drawn_with_unedited_rows(path, scene):
    edit = scattered(scene, np.arange(20, 90, 2))
    whole = {"scene": 0, "start": 100, "count": 50, "matrix": EYE}
    extended, (place,) = point_edits.extend(scene, [edit])
    rows = ((100, 50, np.eye(4)), (place.start, place.count, place.matrix))
    pose = posed_scene.pose_instances(extended, [Instance(*one) for one in rows])
    expected = scene_renderer.render_frame(scene, pose, CAMERA, background=None).color
    *_, (header, arrays) = talk(load(path), points("a", a=edit), picture(whole, entry("a")))
    assert header["ok"], header
    assert header["result"]["gaussians"] == 85 and set(np.unique(arrays["owners"])) == {-1, 0, 1}
    np.testing.assert_allclose(arrays["color"], expected, atol=1e-5)


def test_cached_points_are_not_sent_again_and_unused_ones_are_dropped(path, scene):
    a, b = scattered(scene, np.arange(20, 60)), scattered(scene, np.arange(60, 90))
    answers = talk(
        load(path),
        points("a", "b", a=a, b=b), picture(entry("a")),
        points("a"), picture(entry("a")),
        picture(entry("b")),
        points("b"),
    )  # fmt: skip
    first, again = answers[2], answers[4]
    assert first[0]["ok"] and again[0]["ok"] and first[1]["color"].any()
    np.testing.assert_array_equal(first[1]["color"], again[1]["color"])
    for header, _ in answers[5:]:
        assert header["error"]["kind"] == "ConfigError" and "'b'" in header["error"]["message"]


def test_a_picture_without_edits_shows_the_scene_again(path, scene):
    whole = {"scene": 0, "start": 0, "count": 200, "matrix": EYE}
    edit = scattered(scene, np.arange(200))
    answers = talk(load(path), picture(whole), points("a", a=edit), picture(entry("a")), picture(whole))
    before, edited, after = (answers[i][1]["color"] for i in (1, 3, 4))
    assert np.abs(edited - before).max() > 0.1
    np.testing.assert_array_equal(before, after)


def test_edits_of_two_scenes_are_kept_separate(path, scene, tmp_path):
    other = scenes.make_scene(n=100, objects=2, seed=9)
    second = scene_file.write(other, tmp_path / "other.r5dgs")
    edits = {"a": scattered(scene, np.arange(50)), "b": PointEdit(np.arange(0, 100, 3))}
    both = {"command": "load", "paths": [str(path), str(second)]}
    *_, (header, arrays) = talk(both, points("a", "b", **edits), picture(entry("a"), {**entry("b"), "scene": 1}))
    assert header["ok"] and header["result"]["gaussians"] == 50 + 34
    assert arrays["color"].any()


@pytest.mark.parametrize(
    "new",
    [
        {"a": None},
        {"a": {}},
        {"a": {"rows": "AAAA!"}},
        {"a": {"rows": "AAA="}},
        {"a": {"rows": "AAAAAA==", "means": "AAAAAA=="}},
        {"a": {"rows": "AAAAAA==", "colour": "AAAAAA=="}},
        {"a": {"rows": 5}},
    ],
)
def test_points_that_cannot_be_read_are_refused(path, new):
    *_, (header, _) = talk(load(path), {"command": "points", "keep": ["a"], "new": new})
    assert header["error"]["kind"] == "ConfigError" and "points" in header["error"]["message"]


@pytest.mark.parametrize(
    "edit", [PointEdit(np.array([200])), PointEdit(np.array([0, 1]), means=np.full((2, 3), np.inf))]
)
def test_points_that_do_not_fit_the_scene_are_refused(path, edit):
    *_, (header, _) = talk(load(path), points("a", a=edit), picture(entry("a")))
    assert header["error"]["kind"] == "ConfigError" and "points" in header["error"]["message"]
