"""Hostile requests to the worker: each gets one answer with an `R5dgsError`, and the worker continues."""

import copy
import io
import json
import os

import numpy as np
import pytest

from r5dgs_core import errors
from r5dgs_core.protocol import fields
from r5dgs_core.scene import scene_file
from r5dgs_core.worker import server
from tests.core.worker.test_server import CAMERA_JSON, ROWS, load, parse, talk
from tests.support import scenes

EYE = np.eye(4).tolist()
RENDER = {"command": "render", "camera": CAMERA_JSON, "instances": [ROWS]}
PLAY = {"command": "render", "camera": CAMERA_JSON, "t": 0.1}
DEEP = b'{"command": "hello", "x": ' + b"[" * 100_000 + b"]" * 100_000 + b"}"


def changed(request, *path, to):
    """A copy of a request with another value somewhere in it."""
    made = copy.deepcopy(request)
    place = made
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = to
    return made


HOSTILE = {
    "no JSON": b"not json",
    "half a request": b'{"command": "hello"',
    "bytes": b"\x00\xff\xfe\x80 \x1b[2J",
    "a list": b"[1, 2]",
    "a number": b"7",
    "null": b"null",
    "text": b'"hello"',
    "deep JSON": DEEP,
    "deep lists alone": b"[" * 200_000,
    "nan": b'{"command": "render", "t": NaN}',
    "infinity": b'{"command": "render", "t": 1e999}',
    "an integer of 5000 digits": b'{"command": "render", "t": ' + b"9" * 5000 + b"}",
    "half of a surrogate pair": b'{"command": "query", "text": "\\ud800"}',
    "a key twice": b'{"command": "hello", "command": "check"}',
    "many values": b'{"command": "load", "paths": [' + b"1," * 5_000_000 + b"1]}",
    "no command": {},
    "a command that is a list": {"command": ["hello"]},
    "a command that is an object": {"command": {"a": 1}},
    "an unknown command": {"command": "dance"},
    "a private method": {"command": "_loaded"},
    "an unknown field": {"command": "hello", "evil": 1},
    "an unknown field of a camera": changed(RENDER, "camera", "lens", to=50),
    "an unknown field of an instance": changed(RENDER, "instances", 0, "lens", to=50),
    "paths that are text": {"command": "load", "paths": "/etc/passwd"},
    "a path that is a number": {"command": "load", "paths": [3]},
    "a path that is a list": {"command": "load", "paths": [[]]},
    "a path with a zero byte": {"command": "load", "paths": ["/tmp/a\0b.r5dgs"]},
    "an empty path": {"command": "load", "paths": [""]},
    "a long path": {"command": "load", "paths": ["/a" * 100_000]},
    "a folder": {"command": "load", "paths": ["/"]},
    "a device": {"command": "load", "paths": ["/dev/zero"]},
    "a foreign file": {"command": "load", "paths": [__file__]},
    "a million paths": {"command": "load", "paths": ["a"] * 1_000_000},
    "no camera": {"command": "render", "t": 0.0},
    "a camera that is a list": changed(RENDER, "camera", to=[]),
    "a width that is true": changed(RENDER, "camera", "width", to=True),
    "a width that is text": changed(RENDER, "camera", "width", to="32"),
    "a width that is broken": changed(RENDER, "camera", "width", to=31.5),
    "a negative height": changed(RENDER, "camera", "height", to=-5),
    "a picture of 12 GiB": changed(changed(RENDER, "camera", "width", to=32768), "camera", "height", to=32768),
    "a played picture of 12 GiB": changed(changed(PLAY, "camera", "width", to=32768), "camera", "height", to=32768),
    "intrinsics of text": changed(RENDER, "camera", "intrinsics", to=[["1", "0", "0"]] * 3),
    "intrinsics of lists of all lengths": changed(RENDER, "camera", "intrinsics", to=[[1], [1, 2], []]),
    "intrinsics of zero": changed(RENDER, "camera", "intrinsics", to=np.zeros((3, 3)).tolist()),
    "a camera that is no rotation": changed(RENDER, "camera", "T_cam_world", to=np.ones((4, 4)).tolist()),
    "a camera at 1e300": changed(RENDER, "camera", "T_cam_world", 0, 3, to=1e300),
    "instances that are an object": changed(RENDER, "instances", to={}),
    "an instance that is a number": changed(RENDER, "instances", to=[1]),
    "an instance that is null": changed(RENDER, "instances", to=[None]),
    "a start that is text": changed(RENDER, "instances", 0, "start", to="0"),
    "a negative start": changed(RENDER, "instances", 0, "start", to=-1),
    "a negative count": changed(RENDER, "instances", 0, "count", to=-1),
    "rows past the end": changed(RENDER, "instances", 0, "count", to=10_000),
    "rows of 63 bits": changed(RENDER, "instances", 0, "start", to=(1 << 63) - 1),
    "a million instances": changed(RENDER, "instances", to=[{}] * 1_000_000),
    "Gaussians of many GiB": changed(RENDER, "instances", to=[{**ROWS, "count": 200}] * 20_000),
    "a matrix of nothing": changed(RENDER, "instances", 0, "matrix", to=None),
    "a matrix of 1e308": changed(RENDER, "instances", 0, "matrix", to=[[1e308] * 4] * 4),
    "a matrix of objects": changed(RENDER, "instances", 0, "matrix", to=[[{}] * 4] * 4),
    "a world of text": changed(RENDER, "instances", 0, "world", to="world"),
    "a scene that is true": changed(RENDER, "instances", 0, "scene", to=True),
    "a scene that is not loaded": changed(RENDER, "instances", 0, "scene", to=1),
    "a negative scene": changed(RENDER, "instances", 0, "scene", to=-1),
    "a tint of text": changed(RENDER, "instances", 0, "tint", to=["a", "b", "c"]),
    "a negative tint": changed(RENDER, "instances", 0, "tint", to=[-1, 0, 0]),
    "a tint of 1e300": changed(RENDER, "instances", 0, "tint", to=[1e300, 0, 0]),
    "an instance's time that is text": changed(RENDER, "instances", 0, "t", to="now"),
    "an instance's time of 1e300": changed(RENDER, "instances", 0, "t", to=1e300),
    "points that are a list": changed(RENDER, "instances", 0, "points", to=[]),
    "points that nobody keeps": changed(RENDER, "instances", 0, "points", to="a"),
    "a time that is a list": changed(PLAY, "t", to=[]),
    "a time that is true": changed(PLAY, "t", to=True),
    "a time of 1e300": changed(PLAY, "t", to=1e300),
    "a sky that is true": changed(RENDER, "sky", to=True),
    "a sky without a matrix": changed(RENDER, "sky", to={"scene": 0}),
    "a sky of another scene": changed(RENDER, "sky", to={"scene": 9, "matrix": EYE}),
    "near that is text": changed(RENDER, "near", to="1"),
    "near of zero": changed(RENDER, "near", to=0),
    "a distance that is a list": changed(RENDER, "distance", to=[1]),
    "a distance of 1e300": changed(RENDER, "distance", to=1e300),
    "want that is a number": changed(RENDER, "want", to=3),
    "want that is text": changed(RENDER, "want", to="depth"),
    "want of lists": changed(RENDER, "want", to=[["depth"]]),
    "want of a private name": changed(RENDER, "want", to=["__class__"]),
    "coverage that is true": changed(RENDER, "coverage", to=True),
    "coverage without instances": {**PLAY, "coverage": {"groups": [1], "ranks": 1}},
    "groups of truth values": changed(RENDER, "coverage", to={"groups": [True], "ranks": 1}),
    "groups of 63 bits": changed(RENDER, "coverage", to={"groups": [1 << 62], "ranks": 1}),
    "too many ranks": changed(RENDER, "coverage", to={"groups": [1], "ranks": 1 << 40}),
    "a query of nothing": {"command": "query", "text": None},
    "a query of 500 kB": {"command": "query", "text": "mug, " * 100_000},
    "a query of a scene that is text": {"command": "query", "text": "mug", "scene": "a"},
    "an encoder that is a list": {"command": "query", "text": "mug", "encoder": []},
    "an encoder with a zero byte": {"command": "embed", "texts": ["mug"], "encoder": "\0"},
    "an encoder that is a device": {"command": "embed", "texts": ["mug"], "encoder": "/dev/zero"},
    "texts that are text": {"command": "embed", "texts": "mug", "encoder": "text"},
    "texts of lists": {"command": "embed", "texts": [[]], "encoder": "text"},
    "a text of 500 kB": {"command": "embed", "texts": ["a" * 500_000], "encoder": "text"},
    "points without keys": {"command": "points"},
    "points of a number": {"command": "points", "keep": [], "new": {"a": 1}},
    "points that are no base64": {"command": "points", "keep": [], "new": {"a": {"rows": "?"}}},
    "points of half a number": {"command": "points", "keep": [], "new": {"a": {"rows": "AAA="}}},
    "keys that are lists": {"command": "points", "keep": [[]], "new": {}},
}
KINDS = {name for name, kind in vars(errors).items() if isinstance(kind, type) and issubclass(kind, errors.R5dgsError)}


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    scene = scenes.make_scene(n=200, sh_degree=1)
    return scene_file.write(scene, tmp_path_factory.mktemp("hostile") / "scene.r5dgs")


@pytest.fixture(autouse=True)
def little_memory(monkeypatch):
    """A machine with so much free memory that no honest request of these tests is refused."""
    monkeypatch.setattr(fields, "free_memory", lambda: 1 << 30)


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_request_gets_one_error_and_the_worker_continues(path, name, capsys):
    _, (refused, arrays), (after, picture) = talk(load(path), HOSTILE[name], RENDER)
    if isinstance(HOSTILE[name], dict) and HOSTILE[name].get("command") == "load":  # its scenes are gone then
        assert after["ok"] or "no scene is loaded" in after["error"]["message"]
    else:
        assert after["ok"] and picture["color"].shape == (24, 32, 3)
    assert not refused["ok"] and not arrays
    assert refused["error"]["kind"] in KINDS and len(refused["error"]["message"]) < 10_000
    assert "Traceback" not in capsys.readouterr().err


def test_there_are_more_than_the_trials_had():
    assert len(HOSTILE) >= 66


def test_a_giant_line_is_skipped_without_being_stored(path, monkeypatch):
    monkeypatch.setattr(fields, "MAX_LINE", 4 << 20)
    most = []

    class Stream(io.BytesIO):
        def readline(self, size=-1):
            most.append(size)
            return super().readline(size)

    lines = Stream(b"x" * (9 << 20) + b"\n" + json.dumps({"id": 5, "command": "hello"}).encode() + b"\n")
    out = io.BytesIO()
    server.serve(lines, out)
    (refused, _), (answered, _) = parse(out.getvalue())
    assert "more than 4 MiB" in refused["error"]["message"] and answered["ok"] and answered["id"] == 5
    assert all(0 < size <= (4 << 20) + 1 for size in most)


def test_a_last_line_without_a_newline_is_answered():
    out = io.BytesIO()
    server.serve(io.BytesIO(b'{"id": 1, "command": "hello"}'), out)
    ((answered, _),) = parse(out.getvalue())
    assert answered["ok"]


@pytest.mark.parametrize(("number", "back"), [(7, 7), ("a", "a"), (None, None), ([1] * 9, None), ("a" * 500, None)])
def test_only_plain_numbers_and_names_are_returned_as_the_id(number, back):
    ((answered, _),) = talk({"id": number, "command": "hello"})
    assert answered["ok"] and answered["id"] == back


def test_a_defect_of_the_worker_is_reported_as_an_error(monkeypatch, capsys):
    def fail(*_):
        raise MemoryError("no room")

    monkeypatch.setattr(server.Server, "answer", fail)
    ((answered, _),) = talk({"command": "check"})
    assert answered["error"] == {"kind": "BackendError", "message": "worker: the request failed: MemoryError: no room"}
    assert "Traceback" in capsys.readouterr().err


def test_the_free_memory_is_that_of_the_machine(monkeypatch):
    monkeypatch.undo()
    assert 1 << 20 < fields.free_memory() < 1 << 50


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="Windows has no pipes with paths")
def test_the_worker_does_not_wait_for_a_pipe(tmp_path):
    os.mkfifo(tmp_path / "a.r5dgs")
    ((answered, _),) = talk(load(tmp_path / "a.r5dgs"))
    assert answered["error"]["kind"] == "SceneFileError"
