"""The worker writes scene files in the formats of the registry."""

import pytest

from r5dgs_core.formats import poses, registry
from r5dgs_core.scene import scene_file
from tests.core.worker.test_server import talk
from tests.support import scenes


@pytest.fixture
def path(tmp_path):
    return scene_file.write(scenes.make_scene(n=60, objects=2), tmp_path / "scene.r5dgs", precision="exact")


def request(source, target, **changes):
    wanted = {"command": "export", "scene": str(source), "format": "poses", "path": str(target), "times": [0.1, 0.4]}
    return wanted | {"frames": [3, 9]} | changes


def test_a_file_is_that_of_the_registry(path, tmp_path):
    ((header, _),) = talk(request(path, tmp_path / "a.json"))
    assert header["result"]["files"] == [str(tmp_path / "a.json")]
    options = registry.Options((0.1, 0.4), (3, 9))
    (wanted,) = poses.FORMAT.write(scene_file.read(path), tmp_path / "b.json", options)
    assert (tmp_path / "a.json").read_bytes() == wanted.read_bytes()


def test_one_file_per_frame(path, tmp_path):
    ((header, _),) = talk(request(path, tmp_path / "a.ply", format="ply"))
    assert header["result"]["files"] == [str(tmp_path / "a_0003.ply"), str(tmp_path / "a_0009.ply")]


def test_the_greeting_names_the_formats_of_this_python(monkeypatch):
    monkeypatch.setitem(registry.MODULES, "lacking", "poses")
    before = talk({"command": "hello"})[0][0]["result"]["formats"]
    assert {"ply", "lacking"} <= set(before)
    monkeypatch.setattr(registry.Format, "why_unavailable", lambda one: "no" if one.name == "poses" else None)
    assert "lacking" not in talk({"command": "hello"})[0][0]["result"]["formats"]


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"format": "obj"}, "unknown format 'obj'"),
        ({"format": None}, "needs 'format'"),
        ({"times": []}, "needs times"),
        ({"times": ["now", 1.0]}, "'times' have to be numbers"),
        ({"frames": [1]}, "as many frames"),
        ({"frames": [1, 2.5]}, "whole numbers"),
        ({"path": 3}, "needs paths"),
        ({"scene": "/missing.r5dgs"}, "expected a .r5dgs file"),
        ({"scene": "/dev/zero"}, "a folder or device"),
        ({"path": "/missing/folder/a.json"}, "cannot be written"),
    ],
)
def test_impossible_exports_are_named(path, tmp_path, changes, said):
    before = sorted(tmp_path.iterdir())
    (header, _), (after, _) = talk(request(path, tmp_path / "a.json", **changes), {"command": "hello"})
    assert not header["ok"] and said in header["error"]["message"] and after["ok"]
    assert sorted(tmp_path.iterdir()) == before
