"""The worker's protocol, in process and as a process."""

import dataclasses
import io
import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from r5dgs_core import errors
from r5dgs_core.language import build_table
from r5dgs_core.language.encoders import encoder_base, registry
from r5dgs_core.playback import scene_player
from r5dgs_core.protocol import messages
from r5dgs_core.protocol.meshes import Meshes
from r5dgs_core.raster import compilation
from r5dgs_core.render import incremental_renderer, posed_scene, scene_renderer, warm_up
from r5dgs_core.scene import scene_file
from r5dgs_core.scene.instance import Instance
from r5dgs_core.worker import server as worker_server
from tests.core.render.test_scene_renderer import matrix
from tests.support import encoder_folders, scenes

CAMERA = scenes.orbit_camera(0.2, 32, 24)
CAMERA_JSON = {
    "width": 32,
    "height": 24,
    "intrinsics": CAMERA.intrinsics.tolist(),
    "T_cam_world": CAMERA.T_cam_world.tolist(),
}
TRIANGLE, FAR_FACE = np.eye(3, dtype=np.float32), np.array([[0, 1, 3]], np.int32)
ROWS = {"start": 0, "count": 1, "matrix": np.eye(4).tolist()}


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    scene = scenes.make_scene(n=200, sh_degree=1)
    return scene_file.write(scene, tmp_path_factory.mktemp("serve") / "scene.r5dgs")


def talk(*requests):
    """Answers to requests (bytes are sent as they are): (header, arrays) each."""
    lines = [r if isinstance(r, bytes) else json.dumps({"id": i, **r}).encode() for i, r in enumerate(requests)]
    out = io.BytesIO()
    worker_server.serve(io.BytesIO(b"\n".join(lines) + b"\n"), out)
    return parse(out.getvalue())


def parse(data):
    stream, answers = io.BytesIO(data), []
    while line := stream.readline():
        header = json.loads(line)
        arrays = {}
        for entry in header["arrays"]:
            count = int(np.prod(entry["shape"]))
            dtype = np.dtype(entry["dtype"])
            arrays[entry["name"]] = np.frombuffer(stream.read(count * dtype.itemsize), dtype).reshape(entry["shape"])
        if "event" not in header:  # tested in tests/core/render/test_warm_up.py
            answers.append((header, arrays))
    return answers


def load(path):
    return {"command": "load", "paths": [str(path)]}


def test_hello_returns_missing_packages_and_protocol_version():
    (header, _), *_ = talk({"command": "hello"})
    assert header["ok"] and header["result"]["protocol"] == messages.VERSION and header["result"]["missing"] == []


def test_a_rendered_time_is_the_cores_picture(path):
    scene = scene_file.read(path)
    expected = scene_renderer.render_frame(scene, scene_player.Player(scene).frame(0.9, origin=CAMERA.center), CAMERA)
    request = {"command": "render", "camera": CAMERA_JSON, "t": 0.9, "want": ["depth", "alpha", "ids"]}
    _, (header, arrays) = talk(load(path), request)
    assert header["ok"] and header["result"]["gaussians"] == len(scene.gaussians.means)
    for name in ("color", "depth", "alpha", "ids"):
        np.testing.assert_array_equal(arrays[name], getattr(expected, name))


def test_instances_are_moved_and_other_gaussians_are_not_drawn(path):
    scene = scene_file.read(path)
    body = scene.object(2)
    matrix = np.eye(4)
    matrix[:3, 3] = [0.2, 0, 0.3]
    posed = posed_scene.pose_instances(scene, [Instance(body.start, body.count, matrix)])
    expected = scene_renderer.render_frame(scene, posed, CAMERA, background=None)
    instances = [{"start": body.start, "count": body.count, "matrix": matrix.tolist()}]
    request = {"command": "render", "camera": CAMERA_JSON, "instances": instances}
    _, (header, arrays) = talk(load(path), request)
    assert header["ok"]
    np.testing.assert_array_equal(arrays["color"], expected.color)


def test_scenes_loaded_together_are_in_one_picture(path, tmp_path):
    other = scene_file.write(scenes.make_scene(n=150, sh_degree=2, seed=9), tmp_path / "other.r5dgs")
    world = matrix((0.8, 0.1, 0.3, -0.2), (0.3, -0.2, 0.1), 0.8)
    rows = {"start": 20, "count": 60, "matrix": world.tolist(), "world": world.tolist(), "tint": [0.5, 1.0, 2.0]}
    entries = [{**rows, "scene": 1}, {**ROWS, "count": 200}]
    request = {"command": "render", "camera": CAMERA_JSON, "instances": entries, "want": ["depth", "alpha", "owners"]}
    request["sky"] = {"scene": 1, "matrix": world.tolist()}
    both = [scene_file.read(path), scene_file.read(other)]
    expected = incremental_renderer.IncrementalRenderer(both).render(
        [Instance(20, 60, world, 1, world, (0.5, 1.0, 2.0)), Instance(0, 200, np.eye(4))],
        CAMERA,
        sky=incremental_renderer.Sky(1, world),
    )
    (loaded, _), (header, arrays) = talk({"command": "load", "paths": [str(path), str(other)]}, request)
    assert [entry["gaussians"] for entry in loaded["result"]["scenes"]] == [200, 150]
    assert header["ok"] and header["result"]["gaussians"] == 260
    for name, found in (("color", "color"), ("depth", "depth"), ("alpha", "alpha"), ("owners", "ids")):
        np.testing.assert_array_equal(arrays[name], getattr(expected, found))
    assert {0, 1} <= set(arrays["owners"].ravel().tolist())


def test_coverage_is_returned_with_the_picture(path):
    entries = [{**ROWS, "count": 90}, {**ROWS, "start": 90, "count": 110}]
    request = {"command": "render", "camera": CAMERA_JSON, "instances": entries, "want": ["alpha"], "sky": None}
    _, (header, arrays) = talk(load(path), {**request, "coverage": {"groups": [5, 3], "ranks": 3}})
    assert header["ok"] and arrays["coverage"].shape == (CAMERA.height, CAMERA.width, 3)
    np.testing.assert_allclose(arrays["coverage"].sum(-1), arrays["alpha"], atol=1e-5)
    assert set(np.unique(arrays["coverage_groups"])) == {-1, 3, 5}
    for wrong in (True, {"groups": [1], "ranks": 2}, {"groups": [1, 2], "ranks": 0}, {"groups": [1, "a"], "ranks": 2}):
        _, (header, _) = talk(load(path), {**request, "coverage": wrong})
        assert (
            not header["ok"] and header["error"]["kind"] == "ConfigError" and "coverage" in header["error"]["message"]
        )


def test_a_file_named_twice_is_two_scenes(path):
    moved = matrix(translation=(0.3, 0, 0)).tolist()
    one, other = {**ROWS, "count": 200}, {**ROWS, "count": 200, "matrix": moved}
    render = {"command": "render", "camera": CAMERA_JSON, "want": ["owners"]}
    once = talk(load(path), {**render, "instances": [one, other]})[1]
    twice = {"command": "load", "paths": [str(path)] * 2}
    (loaded, _), found = talk(twice, {**render, "instances": [one, {**other, "scene": 1}]})
    assert len(loaded["result"]["scenes"]) == 2 and found[0]["ok"]
    for name in ("color", "owners"):
        np.testing.assert_array_equal(found[1][name], once[1][name])


def test_scenes_no_longer_requested_are_released(path, tmp_path, monkeypatch):
    copy = tmp_path / "copy.r5dgs"
    copy.write_bytes(path.read_bytes())
    read, original = [], scene_file.read
    monkeypatch.setattr(scene_file, "read", lambda place: read.append(place.name) or original(place))
    server = worker_server.Server()
    for paths in ([path], [path, copy], [copy, path, copy], [copy], [path]):
        result, _ = server.answer({"command": "load", "paths": [str(p) for p in paths]})
        assert [one["gaussians"] for one in result["scenes"]] == [200] * len(paths)
    assert read == ["scene.r5dgs", "copy.r5dgs", "scene.r5dgs"]


@pytest.mark.parametrize(
    ("request_", "kind", "message"),
    [
        ({"command": "dance"}, "ConfigError", "unknown command"),
        ({"command": "render", "camera": CAMERA_JSON}, "ConfigError", "'t'"),
        ({"command": "render", "t": 0.1}, "ConfigError", "'camera'"),
        ({"command": "render", "camera": {**CAMERA_JSON, "width": 0}, "t": 0.1}, "ConfigError", "width"),
        ({"command": "render", "camera": {**CAMERA_JSON, "intrinsics": [1, 2]}, "t": 0.1}, "ConfigError", "3 x 3"),
        ({"command": "render", "camera": CAMERA_JSON, "t": 0.1, "want": ["smell"]}, "ConfigError", "smell"),
        ({"command": "render", "camera": CAMERA_JSON, "instances": [{"start": 0}]}, "ConfigError", "instance"),
        ({"command": "render", "camera": CAMERA_JSON, "instances": [ROWS | {"scene": 1}]}, "ConfigError", "'scene'"),
        ({"command": "render", "camera": CAMERA_JSON, "instances": [ROWS | {"tint": 2}]}, "ConfigError", "tint"),
        ({"command": "render", "camera": CAMERA_JSON, "instances": [], "sky": {"scene": 3}}, "ConfigError", "'scene'"),
        ({"command": "render", "camera": CAMERA_JSON, "instances": [], "sky": True}, "ConfigError", "'sky'"),
        ({"command": "render", "camera": CAMERA_JSON, "instances": [], "near": 0}, "ConfigError", "'near'"),
        ({"command": "load", "paths": ["/nowhere/at all.r5dgs"]}, "SceneFileError", "at all.r5dgs"),
        ({"command": "render", "camera": CAMERA_JSON, "instances": [ROWS | {"t": "now"}]}, "ConfigError", "time"),
        ({"command": "render", "camera": CAMERA_JSON, "instances": [], "distance": "far"}, "ConfigError", "'distance'"),
        (
            {"command": "render", "camera": CAMERA_JSON, "instances": [], "meshes": {"vertices": ""}},
            "ConfigError",
            "'meshes'",
        ),
        (
            {
                "command": "render",
                "camera": CAMERA_JSON,
                "instances": [],
                "meshes": Meshes(TRIANGLE, FAR_FACE).to_json(),
            },
            "ConfigError",
            "'triangles'",
        ),
        (
            {"command": "render", "camera": CAMERA_JSON, "instances": [], "meshes": {"vertices": "=", "triangles": ""}},
            "ConfigError",
            "'vertices'",
        ),
        ({"command": "load", "paths": [3]}, "ConfigError", "paths"),
        ({"command": "load", "path": "/nowhere/at all.r5dgs"}, "ConfigError", "paths"),
    ],
)
def test_impossible_requests_are_named_and_the_worker_continues(path, request_, kind, message):
    _, (header, arrays), (after, _) = talk(load(path), request_, {"command": "hello"})
    assert not header["ok"] and header["error"]["kind"] == kind and message in header["error"]["message"]
    assert not arrays and after["ok"]


def test_rendering_without_a_scene_and_invalid_lines_are_errors():
    (first, _), (second, _), (third, _) = talk(
        {"command": "render", "camera": CAMERA_JSON, "t": 0.0}, b"not json", b"[1, 2]"
    )
    assert "no scene is loaded" in first["error"]["message"]
    assert "not valid JSON" in second["error"]["message"] and "JSON object" in third["error"]["message"]


def test_a_failed_load_unloads_the_previous_scene(path, tmp_path):
    broken = tmp_path / "broken.r5dgs"
    broken.write_bytes(path.read_bytes()[:300])
    _, (failed, _), (render, _) = talk(load(path), load(broken), {"command": "render", "camera": CAMERA_JSON, "t": 0.0})
    assert failed["error"]["kind"] == "SceneFileError"
    assert "no scene is loaded" in render["error"]["message"]


def test_a_file_that_cannot_be_read_is_read_once_until_it_changes(path, tmp_path, monkeypatch):
    path = Path(shutil.copy(path, tmp_path))
    read, calls = worker_server.scene_file.read, []
    monkeypatch.setattr(worker_server.scene_file, "read", lambda path: calls.append(path) or read(path))
    whole, server, request = path.read_bytes(), worker_server.Server(), {"command": "load", "paths": [str(path)]}
    path.write_bytes(whole[:1000])
    said = []
    for _ in range(3):
        with pytest.raises(errors.SceneFileError, match=path.name) as caught:
            server.answer(request)
        said.append(str(caught.value))
    assert len(calls) == 1 and len(set(said)) == 1
    path.write_bytes(whole)
    assert server.answer(request)[0]["scenes"] and len(calls) == 2


def test_a_changed_file_is_read_again(path, tmp_path):
    copy = tmp_path / "scene.r5dgs"
    copy.write_bytes(path.read_bytes())
    server = worker_server.Server()
    assert server.answer(load(copy))[0]["scenes"][0]["gaussians"] == 200
    scene_file.write(scenes.make_scene(n=120), copy)
    assert server.answer(load(copy))[0]["scenes"][0]["gaussians"] == 120


def test_the_rasterizer_is_compiled_on_request():
    (header, _), (again, _) = talk({"command": "warm_up"}, {"command": "warm_up"})
    assert header["ok"] and again["result"] == header["result"] == {"compiled": compilation.compiled()}


@pytest.mark.parametrize("compiled", [3, 0])
def test_an_announced_warm_up_that_fails_reports_the_reason(monkeypatch, capsys, compiled):
    def fail(gradients, progress):
        if compiled:
            compilation._watch.announce(compilation.NOTICE)
        raise OSError("no space left")

    monkeypatch.setattr(warm_up, "warm_up", fail)
    monkeypatch.setattr(compilation, "compiled", lambda: compiled)
    events = []
    warm = worker_server.WarmUpThread(events.append)
    warm.start()
    warm.wait()
    assert not warm.busy and "no space left" in capsys.readouterr().err
    announced = [
        {"event": "compiling", "text": compilation.NOTICE},
        {"event": "failed", "text": "OSError: no space left"},
    ]
    assert events == (announced if compiled else [])


def test_a_picture_is_returned_with_its_known_error(path, tmp_path):
    scene = scene_file.read(path)
    rows = np.arange(20, 40, dtype=np.int32)
    shape = (len(rows), len(scene.tracks.times))
    offsets = np.full((*shape, 3), 0.1, np.float32)
    offsets[:, -1] = 0
    bent = dataclasses.replace(
        scene.with_arrays(
            residual_rows=rows,
            residual_offsets=offsets,
            residual_quats=np.tile(np.float32([1, 0, 0, 0]), (*shape, 1)),
            residual_log_scales=np.zeros((*shape, 3), np.float32),
        ),
        name="bent",
    )
    other = scene_file.write(bent, tmp_path / "bent.r5dgs")
    loads = {"command": "load", "paths": [str(path), str(other)]}
    shown = [{**ROWS, "scene": 1}, ROWS]
    request = {"command": "render", "camera": CAMERA_JSON, "instances": shown}
    exact = {**request, "instances": [{**shown[0], "t": 0.1}, ROWS]}
    _, (stiff, _), (exactly, _) = talk(loads, request, exact)
    assert [one["name"] for one in stiff["result"]["scenes"]] == [scene.name, "bent"]
    assert [one["unbent"] for one in stiff["result"]["scenes"]] == [0, 20]
    assert [one["unbent"] for one in exactly["result"]["scenes"]] == [0, 0]
    assert all(one["error"] for one in stiff["result"]["scenes"])


def test_a_check_returns_versions_device_and_speed():
    ((header, _),) = talk({"command": "check"})
    found = header["result"]
    assert header["ok"] and set(found["versions"]) == {"Python", "R5DGS", "torch", "numba"}
    assert found["milliseconds"] > 0 and found["gaussians"] > 0 and "CPU" in found["device"]


def test_words_find_objects(path):
    _, (header, _) = talk(load(path), {"command": "query", "text": "mug"})
    assert header["result"]["matches"][0]["object_id"] == 1


def test_phrases_are_embedded_by_an_encoder_and_matched_with_its_table(tmp_path):
    folder = encoder_folders.sentences(tmp_path / "tiny")
    encoder = registry.open_encoder(folder)
    made = build_table.make(scenes.make_scene(n=120, objects=2), encoder).scene
    file = scene_file.write(made, tmp_path / "words.r5dgs")
    ask = {"encoder": str(folder)}
    _, (embedded, arrays), (found, _), (other, _), (wrong, _), (last, _) = talk(
        load(file),
        {"command": "embed", "texts": ["a mug", "zeppelin"], **ask},
        {"command": "query", "text": "mug", **ask},
        {"command": "embed", "texts": ["mug"], "encoder": str(tmp_path)},
        {"command": "embed", "texts": [3], **ask},
        {"command": "embed", "texts": [], **ask},
    )
    assert embedded["result"]["encoder"]["digest"] == made.lookup.encoder.digest
    np.testing.assert_array_equal(arrays["embeddings"], encoder_base.embed_phrases(encoder, ["a mug", "zeppelin"]))
    assert found["result"]["matches"][0]["object_id"] == 1 and found["result"]["matches"][0]["score"] == 1
    assert not other["ok"] and "config.json" in other["error"]["message"]
    assert not wrong["ok"] and "needs texts" in wrong["error"]["message"] and last["ok"]


def test_the_process_keeps_its_output_clean_and_ends_with_its_input(path):
    lines = [load(path), {"command": "render", "camera": CAMERA_JSON, "t": 0.3}, {"command": "shutdown"}]
    data = b"".join(json.dumps({"id": i, **line}).encode() + b"\n" for i, line in enumerate(lines))
    done = subprocess.run(
        [sys.executable, "-m", "r5dgs_core.worker.server"], input=data, capture_output=True, timeout=300
    )
    assert done.returncode == 0, done.stderr.decode()
    (_, _), (rendered, arrays), (ended, _) = parse(done.stdout)
    assert rendered["ok"] and ended["ok"] and arrays["color"].shape == (24, 32, 3)
