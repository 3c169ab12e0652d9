"""Round trip of render requests: the worker reads what Blender writes."""

import json

import numpy as np
import pytest

from r5dgs_core import errors
from r5dgs_core.protocol import answers, messages
from r5dgs_core.scene.instance import Instance, Sky
from tests.support import scenes

CAMERA = scenes.orbit_camera(0.4)
WORLD = np.diag([2.0, 2.0, 2.0, 1.0])


def received(request, numbers=(0, 1)):
    return messages.RenderRequest.from_json(json.loads(json.dumps(request.to_json())), numbers)


def assert_same(found, expected):
    assert type(found) is type(expected)
    for name, value in vars(expected).items():
        other = getattr(found, name)
        if isinstance(value, np.ndarray):
            np.testing.assert_array_equal(other, value)
        elif isinstance(value, tuple) and value and isinstance(value[0], Instance):
            assert len(other) == len(value)
            for a, b in zip(other, value, strict=True):
                assert_same(a, b)
        elif hasattr(value, "__dataclass_fields__"):
            assert_same(other, value)
        elif name != "name":  # cameras travel without their names
            assert other == value, name


def test_instances_arrive_as_they_were_sent():
    moved = Instance(3, 20, WORLD, 1, np.eye(4), (0.5, 1.0, 2.0), 0.25, True)
    edited = Instance(0, 0, np.eye(4), 0, WORLD)
    request = messages.RenderRequest(
        CAMERA,
        (moved, edited),
        (None, "key"),
        sky=Sky(1, WORLD),
        near=0.5,
        distance=3.0,
        want=("alpha", "owners"),
        coverage=messages.Coverage([4, -1], 2),
    )
    assert_same(received(request), request)


@pytest.mark.parametrize("sky", [None, Sky(1)])
def test_a_playback_arrives_as_it_was_sent(sky):
    request = messages.RenderRequest(CAMERA, t=1.5, scene=1, sky=sky, want=("ids",))
    assert_same(received(request), request)


def test_scenes_are_counted_by_the_paths_of_the_load_request():
    request = messages.RenderRequest(CAMERA, (Instance(0, 5, np.eye(4), 2),), (None,), sky=Sky(1))
    found = received(request, numbers=(0, 1, 0))
    assert found.instances[0].scene == 0 and found.sky is not None and found.sky.scene == 1
    with pytest.raises(errors.ConfigError, match="'scene'"):
        received(request)


def test_arrays_arrive_as_they_were_sent_and_a_cut_stream_gives_none(tmp_path):
    sent = {"color": np.arange(24, dtype=np.float32).reshape(2, 4, 3)[:, ::2], "ids": np.zeros((0, 2), np.int32)}
    path = tmp_path / "answer"
    with path.open("wb") as stream:
        answers.write(stream, {"id": 7}, sent)
    with path.open("rb") as stream:
        header = json.loads(stream.readline())
        found = answers.read_arrays(stream, header)
    assert header["id"] == 7 and found is not None and found.keys() == sent.keys()
    for name, array in sent.items():
        np.testing.assert_array_equal(found[name], array)
        assert found[name].dtype == array.dtype
    path.write_bytes(path.read_bytes()[:-1])
    with path.open("rb") as stream:
        assert answers.read_arrays(stream, json.loads(stream.readline())) is None
