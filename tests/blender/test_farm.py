"""Rendering on farms: the Slurm array of `examples/farm`, and its job type for Flamenco."""

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from r5dgs_core.data import images
from r5dgs_core.scene import scene_file
from tests.support import patience, player, scenes

ROOT = Path(__file__).resolve().parents[2]
ARRAY = ROOT / "examples" / "farm" / "render_array.sh"
JOB_TYPE = ROOT / "examples" / "farm" / "r5dgs_render.js"
SHIM = Path(__file__).with_name("blender_program.py")
FIRST, LAST = 41, 64
# A program that writes its arguments to a file and ends as the next line of another file demands.
ENDING = """#!/bin/bash
echo "$@" >> "$SAID"
next=$(head -n 1 "$DEMANDS") && sed -i 1d "$DEMANDS"
eval "$next"
"""


def array(*arguments, task=0, tasks=1, **settings):
    """Environment and command of a task of the array."""
    slurm = {"TASK_ID": task, "TASK_COUNT": tasks, "TASK_MIN": 0, "TASK_STEP": 1}
    environment = {**os.environ, **{f"SLURM_ARRAY_{name}": str(value) for name, value in slurm.items()}, **settings}
    return {"args": ["bash", str(ARRAY), *map(str, arguments)], "env": environment}


@pytest.fixture
def ending(tmp_path):
    """Environment with a stand-in for Blender that ends as demanded."""
    program = tmp_path / "blender"
    program.write_text(ENDING)
    program.chmod(0o755)
    return {"BLENDER": str(program), "SAID": str(tmp_path / "said"), "DEMANDS": str(tmp_path / "demands")}


@pytest.mark.parametrize("span", [(1, 10), (1, 11), (5, 5), (-3, 4)])
@pytest.mark.parametrize("tasks", [1, 3, 4])
def test_the_tasks_of_an_array_share_the_frames(ending, tmp_path, span, tasks):
    (tmp_path / "demands").write_text("exit 0\n" * tasks)
    for task in range(tasks):
        subprocess.run(**array("a b.blend", "out/####", *span, task=task, tasks=tasks, **ending), check=True)
    frames = []
    for line in (tmp_path / "said").read_text().splitlines():
        start, part = line.split(" --frames=")
        assert start == "-b -y a b.blend -o out/#### --command r5dgs_render"
        first, last = part.split("..")
        frames += range(int(first), int(last) + 1)
    assert frames == list(range(span[0], span[1] + 1))


@pytest.mark.parametrize(
    ("demands", "status", "starts"),
    [
        (["kill -KILL $$", "exit 0"], 0, 2),
        (["exit 1"], 1, 1),
        (["kill -TERM $$"], 143, 1),
        (["kill -KILL $$"] * 4, 137, 3),
    ],
)
def test_a_killed_blender_is_started_again(ending, tmp_path, demands, status, starts):
    (tmp_path / "demands").write_text("\n".join(demands) + "\n")
    done = subprocess.run(**array("a.blend", "####", 1, 3, **ending), capture_output=True)
    assert done.returncode == status
    assert len((tmp_path / "said").read_text().splitlines()) == starts


@pytest.mark.parametrize("given", [["a.blend"], ["a.blend", "####", 3, 1], ["a.blend", "####", "x", 1]])
def test_the_array_with_wrong_arguments_shows_the_usage(given):
    done = subprocess.run(**array(*given), capture_output=True, text=True)
    assert done.returncode == 2 and "usage: sbatch" in done.stderr


MAKE = f"""
import sys
sys.path.insert(0, {str(ROOT)!r})
import bpy
from tests.blender import check_playback
check_playback.extension_package()
bpy.ops.wm.read_homefile(app_template="")
assert bpy.ops.r5dgs.load_scene(filepath=sys.argv[-2]) == {{"FINISHED"}}
scene = bpy.context.scene
scene.render.engine, scene.view_settings.view_transform = "R5DGS", "Standard"
scene.render.resolution_x, scene.render.resolution_y, scene.render.dither_intensity = 240, 160, 0.0
scene.camera.location, scene.camera.rotation_euler = (0, -5, 1), (1.4, 0, 0)
bpy.ops.wm.save_as_mainfile(filepath=sys.argv[-1])
"""


@pytest.fixture
def farm(tmp_path):
    """A .blend, and the environment with its Blender: the program in the path, else the bpy module."""
    program = shutil.which("blender")
    if program is None:
        pytest.importorskip("bpy", reason="neither bpy nor a program 'blender' is installed")
    pytest.importorskip("torch", reason="torch is not installed in this Python, which runs the worker here")
    (tmp_path / "make.py").write_text(MAKE)
    blend = tmp_path / "a.blend"
    given = [scene_file.write(scenes.make_scene(n=2000, objects=3, seed=4), tmp_path / "a.r5dgs"), blend]
    start = [program, "-b", "--python-exit-code", "1", "--python"] if program else [sys.executable]
    made = subprocess.run([*start, tmp_path / "make.py", "--", *given], capture_output=True, text=True)
    assert blend.exists(), made.stdout + made.stderr
    blender = tmp_path / "blender"
    command = f"{program} --python {tmp_path / 'register.py'}" if program else f"{sys.executable} {SHIM}"
    (tmp_path / "register.py").write_text(MAKE.split("bpy.ops")[0])
    blender.write_text(f'#!/bin/bash\nexec {command} "$@"\n')
    blender.chmod(0o755)
    environment = {"BLENDER": str(blender), "PYTHONPATH": str(ROOT)}
    return blend, environment | ({} if program else {"R5DGS_PYTHON": sys.executable})


@pytest.mark.blender
@pytest.mark.slow
@pytest.mark.heavy
@pytest.mark.parametrize("tasks", [2, 1], ids=["ranges", "the same frames"])
def test_an_array_with_a_killed_blender_loses_and_doubles_no_frame(farm, tmp_path, tasks):
    blend, environment = farm
    frames = tmp_path / "frames"
    logs = [tmp_path / f"{task}.log" for task in range(2)]
    running = []
    for task, log in enumerate(logs):
        with log.open("w") as stream:
            given = array(
                blend, frames / "####", FIRST, LAST, task=task if tasks > 1 else 0, tasks=tasks, **environment
            )
            running.append(subprocess.Popen(**given, stdout=stream, stderr=stream))
    victims = []
    patience.wait_until(lambda: victims.extend(drawing(frames)) or victims)
    os.kill(victims[0], signal.SIGKILL)
    assert [task.wait(300) for task in running] == [0, 0], "".join(log.read_text() for log in logs)

    said = "".join(log.read_text() for log in logs)
    assert "Blender was killed" in said
    names = [f"{frame:04d}.png" for frame in range(FIRST, LAST + 1)]
    assert sorted(path.name for path in frames.iterdir()) == names
    assert all(images.read(frames / name).shape[:2] == (160, 240) for name in names)
    saved = [line.split("'")[1] for line in said.splitlines() if line.startswith("Saved: ")]
    # The victim may have been killed between renaming a file and printing its name.
    assert len(saved) == len(set(saved)) and len(saved) >= len(names) - 1
    alone = array(blend, tmp_path / "alone" / "####", FIRST, LAST, **environment)
    subprocess.run(**alone, check=True, capture_output=True)
    for name in names:  # the pixels; the metadata of a file have its date
        np.testing.assert_array_equal(images.read(frames / name), images.read(tmp_path / "alone" / name))


def drawing(folder: Path) -> list[int]:
    """Return the processes that draw frames."""
    found = []
    for path in folder.glob(".*.placeholder"):
        with contextlib.suppress(OSError, ValueError, KeyError):  # removed meanwhile, or not yet written
            found.append(json.loads(path.read_text())["pid"])
    return found


@pytest.mark.browser
def test_the_job_type_of_flamenco_makes_a_task_per_chunk():
    given = {
        "created": "2026-03-04T05:06:07",
        "settings": {
            "frames": "0-12,34-56, 78",
            "chunk_size": 20,
            "render_output_path": "/render/promo/{timestamp}/######",
            "blendfile": "/jobs/scene 1.blend",
        },
        # Recorded from the tests of Flamenco, for the stand-in.
        "chunks": [["1..10,20..25,40,3..8", 4], ["1-3", 3], [" 1  .. 10,\t20..25\n,40   ", 4], ["47", 4]],
    }
    found = flamenco(given)
    apart = ["1-4", "5-8", "9,10,20,21", "22-25", "40"]
    assert found["chunks"] == [apart, ["1-3"], apart, ["47"]]
    assert [task["name"] for task in found["tasks"]] == ["render-0-12,34-40", "render-41-56,78"]
    assert {task["type"] for task in found["tasks"]} == {"blender"}
    output = "/render/promo/2026-03-04_050607/######"
    (command,) = found["tasks"][0]["commands"]
    assert command["name"] == "blender-render"
    assert command["parameters"] == {
        "exe": "{blender}",
        "exeArgs": "{blenderArgs}",
        "argsBefore": [],
        "blendfile": "/jobs/scene 1.blend",
        "args": ["--render-output", output, "--command", "r5dgs_render", "--frames", "0..12,34..40"],
    }
    assert found["settings"]["render_output_path"] == output
    settings = {setting["key"]: setting for setting in found["jobType"]["settings"]}
    assert settings.keys() - {"render_output_root"} == given["settings"].keys()
    assert {setting["type"] for setting in settings.values()} == {"string", "int32"}


@pytest.mark.browser
def test_the_job_type_of_flamenco_refuses_a_job_without_output_or_frames():
    settings = {"frames": "1-4", "chunk_size": 2, "render_output_path": "/a/####", "blendfile": "/a.blend"}
    for name, said in (("render_output_path", "render_output_path is empty"), ("frames", "empty range")):
        found = flamenco({"created": "2026-03-04T05:06:07", "settings": settings | {name: ""}})
        assert said in found["error"] and "tasks" not in found


def flamenco(given):
    """Compile a job with the stand-in."""
    command = [player.node_alone(), Path(__file__).with_name("flamenco_stand_in.mjs"), JOB_TYPE]
    done = subprocess.run(command, input=json.dumps(given), capture_output=True, text=True, check=True)
    return json.loads(done.stdout)
