"""Kernels are compiled once per machine: with a notice, beside the worker's requests, and never again."""

import io
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from r5dgs_core.raster import compilation, kernel_cache
from r5dgs_core.render import warm_up
from r5dgs_core.scene import scene_file
from r5dgs_core.train import warm_up as train_warm_up
from tests.support import scenes, tiny_datasets

pytestmark = pytest.mark.heavy

ROOT = Path(__file__).resolve().parents[3]

USE_EVERYTHING = """
import sys
from pathlib import Path
import numpy as np
from r5dgs_core.raster import compilation, kernel_cache
from r5dgs_core.render import scene_renderer, incremental_renderer
from r5dgs_core.playback import scene_player
from r5dgs_core.scene import scene_file
from r5dgs_core.scene.instance import Instance
from r5dgs_core.config import config
from r5dgs_core.train import run

scene = scene_file.read(Path(sys.argv[1]))
for t in (0.1, 0.9):
    scene_renderer.render_frame(scene, scene_player.Player(scene).frame(t), scene.cameras[0])
drawn, body = incremental_renderer.IncrementalRenderer(scene), scene.object(2)
for x in (0.0, 0.1, 0.2, 0.3):
    moved = np.eye(4)
    moved[0, 3] = x
    whole = Instance(0, body.start, np.eye(4))
    drawn.render([whole, Instance(body.start, body.count, moved)], scene.cameras[0])
run.train(Path(sys.argv[2]), Path(sys.argv[3]), config.load(None, sys.argv[4:]))
print(compilation.compiled())
"""


def start(cache, *arguments):
    """A fresh Python that keeps its kernels in a folder."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(cache), "PYTHONPATH": str(ROOT)}
    pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
    return subprocess.Popen([sys.executable, *map(str, arguments)], env=environment, **pipes)


def finish(process, data=b""):
    """Wait for a process; return its output and its errors."""
    out, complaints = process.communicate(data, timeout=300)
    assert process.returncode == 0, complaints.decode()
    return out, complaints.decode()


def request(number, **arguments):
    return json.dumps({"id": number, **arguments}).encode() + b"\n"


def headers(stream):
    """The JSON lines of a worker, without the bytes between them."""
    while line := stream.readline():
        header = json.loads(line)
        for entry in header["arrays"]:
            stream.read(int(np.prod(entry["shape"])) * np.dtype(entry["dtype"]).itemsize)
        yield header


@pytest.fixture(scope="module")
def scene_path(tmp_path_factory):
    scene = scenes.make_scene(n=300, sh_degree=1)
    return scene_file.write(scene, tmp_path_factory.mktemp("warming") / "scene.r5dgs")


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    """A copy of the kernels of this machine without one that pictures need and one that only training needs."""
    train_warm_up.warm_up(lambda stage: None)
    source = kernel_cache.cache_folder()
    folder = tmp_path_factory.mktemp("cache")
    shutil.copytree(source, folder / source.name)
    for name in ("tiles.merge_pairs", "losses._compare"):
        indices = list(folder.rglob(f"{name}-*.nbi"))  # one per checkout of this version
        assert indices
        for index in indices:
            index.unlink()
    return folder


def talk(cache, scene_path):
    """Lines of a worker that loads a scene and draws it twice."""
    camera = scenes.orbit_camera(0.2, 32, 24)
    view = {
        **{"width": 32, "height": 24, "intrinsics": camera.intrinsics.tolist()},
        "T_cam_world": camera.T_cam_world.tolist(),
    }
    at_rest = np.eye(4).tolist()
    instances = [{"scene": 0, "start": 0, "count": 300, "matrix": at_rest}]
    sky = {"scene": 0, "matrix": at_rest}
    draw = {"command": "render", "camera": view, "instances": instances, "sky": sky, "near": 0.01, "want": ["owners"]}
    lines = request(0, command="hello") + request(1, command="load", paths=[str(scene_path)])
    lines += request(2, **draw) + request(3, **draw)
    return list(headers(io.BytesIO(finish(start(cache, "-m", "r5dgs_core.worker.server"), lines)[0])))


@pytest.fixture(scope="module")
def cold(cache, scene_path):
    """Messages of the first worker that needs the missing kernel."""
    return talk(cache, scene_path)


@pytest.fixture(scope="module")
def warm_ups(cold, cache):
    """Events and errors of two calls of ``r5dgs warm-up`` after it."""
    calls = []
    for _ in range(2):
        out, complaints = finish(start(cache, "-m", "r5dgs_core.cli", "warm-up", "--progress", "json"))
        calls.append(([json.loads(line) for line in out.splitlines()], complaints))
    return calls


@pytest.mark.slow
def test_a_cold_worker_announces_compilation_in_the_background(cold):
    said = [header.get("event", header.get("id")) for header in cold]
    steps = [header["step"] for header in cold if header.get("event") == "progress"]
    assert len(steps) > 1 and steps == list(range(steps[0], warm_up.count(gradients=False) + 1))
    said = [number for number in said if number != "progress"]
    assert sorted(map(str, said)) == ["0", "1", "2", "3", "compiling", "ready"]
    assert said[0] == 0 and said.index(1) < said.index("ready") < said.index(2) < said.index(3)
    assert said.index("compiling") < said.index("ready")
    assert all(header["ok"] for header in cold if "id" in header)
    assert cold[said.index("compiling")]["text"] == compilation.NOTICE


@pytest.mark.slow
def test_a_warm_worker_announces_no_compilation(warm_ups, cache, scene_path):
    assert [header.get("event", header.get("id")) for header in talk(cache, scene_path)] == [0, 1, 2, 3]


@pytest.mark.slow
def test_the_command_compiles_missing_kernels_and_then_finds_them_ready(warm_ups, cache):
    (first, first_complaints), (second, second_complaints) = warm_ups
    notices = [[event for event in events if event["event"] == "notice"] for events in (first, second)]
    assert notices == [[{"event": "notice", "text": compilation.NOTICE}], []]
    assert first_complaints == second_complaints == ""
    done, again = first[-1], second[-1]
    assert done["event"] == again["event"] == "ready" and done["compiled"] > 0 == again["compiled"]
    assert Path(done["folder"]).parent == cache and any(Path(done["folder"]).rglob("*.nbc"))
    stages = [event["text"] for event in first if event["event"] == "prepare"]
    assert stages[0] == "splats" and {"gradients of splats", "sky", "loss"} <= set(stages)


@pytest.mark.slow
def test_after_warm_up_neither_pictures_nor_training_compile_anything(warm_ups, cache, tiny, scene_path, tmp_path):
    overrides = (*tiny_datasets.SETTINGS, "train.iterations=5", "identity.iterations=2")
    process = start(cache, "-c", USE_EVERYTHING, scene_path, tiny.root, tmp_path / "run", *overrides)
    out, complaints = finish(process)
    assert out.split()[-1] == b"0" and "compiling" not in complaints


def test_a_worker_whose_client_leaves_while_it_compiles_ends_at_once(tmp_path):
    process = start(tmp_path / "empty", "-m", "r5dgs_core.worker.server")
    process.stdin.write(request(0, command="hello"))
    process.stdin.flush()
    events = headers(process.stdout)
    assert next(events)["ok"] and next(events)["event"] == "compiling"
    out, _ = finish(process)  # closes its input
    assert out == b""


@pytest.mark.parametrize("mode", [torch.inference_mode, torch.no_grad])
def test_gradient_kernels_are_also_compiled_inside_inference_mode(mode):
    stages = []
    with mode():
        warm_up.warm_up(progress=stages.append)
    assert stages[-1] == "gradients of colors"


def test_importing_the_rasterizer_needs_neither_numba_nor_its_time():
    script = "import sys, r5dgs_core.raster, r5dgs_core.render.scene_renderer; print('numba' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
