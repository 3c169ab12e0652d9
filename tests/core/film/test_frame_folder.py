"""Folders of frames that several processes fill."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from r5dgs_core import errors, folder_lock, shared_frames
from r5dgs_core.cli import main
from r5dgs_core.data import images
from r5dgs_core.film import frame_folder
from r5dgs_core.film.schedule import Shot
from r5dgs_core.scene import scene_file
from tests.support import patience, scenes

ROOT = Path(__file__).resolve().parents[3]
FRAMES = 16


def test_existing_frames_are_left_and_the_others_drawn(tmp_path):
    shots, drawn = [Shot(number, scenes.orbit_camera(0), 0.0) for number in (1, 2, 3)], []
    (tmp_path / "frame_0002.png").write_text("mine")

    def draw(shot, path):
        drawn.append(shot.number)
        path.write_text("drawn")

    found = list(frame_folder.fill(tmp_path, shots, ".png", draw, share=True))
    assert drawn == [1, 3] and [(shot.number, own) for shot, own in found] == [(1, True), (2, False), (3, True)]
    assert sorted(p.name for p in tmp_path.iterdir()) == [f"frame_000{k}.png" for k in (1, 2, 3)]
    assert (tmp_path / "frame_0002.png").read_text() == "mine"


def test_remains_of_a_killed_process_are_removed_when_its_frame_is_drawn(tmp_path):
    for name in (".frame_0001.png.0123456789abcdef.png", ".frame_0001.png.placeholder", ".frame_0002.png.00.png"):
        (tmp_path / name).write_text("half")
    shots = [Shot(1, scenes.orbit_camera(0), 0.0)]
    list(frame_folder.fill(tmp_path, shots, ".png", lambda shot, path: path.write_text("whole"), share=True))
    assert sorted(p.name for p in tmp_path.iterdir()) == [".frame_0002.png.00.png", "frame_0001.png"]


def test_a_frame_that_fails_leaves_no_placeholder(tmp_path):
    def draw(shot, path):
        raise errors.ConfigError("no")

    with pytest.raises(errors.ConfigError):
        list(frame_folder.fill(tmp_path, [Shot(1, scenes.orbit_camera(0), 0.0)], ".png", draw, share=True))
    assert list(tmp_path.iterdir()) == []


def test_a_frame_of_another_holder_is_waited_for(tmp_path, monkeypatch):
    shots = [Shot(number, scenes.orbit_camera(0), 0.0) for number in (1, 2)]
    held = folder_lock.try_file(tmp_path / ".frame_0001.png.placeholder")
    assert held.__enter__()
    waits = []

    def sleep(seconds):
        waits.append(seconds)
        (tmp_path / "frame_0001.png").write_text("theirs")
        held.__exit__(None, None, None)

    monkeypatch.setattr(shared_frames.time, "sleep", sleep)
    found = frame_folder.fill(tmp_path, shots, ".png", lambda shot, path: path.write_text("own"), share=True)
    assert [(shot.number, own) for shot, own in found] == [(2, True), (1, False)]
    assert waits == [shared_frames.POLL_S] and (tmp_path / "frame_0001.png").read_text() == "theirs"


SETTINGS = {"scene": "0f", "camera": "()", "gaussians": "all", "fps": "24"}


def test_processes_must_agree_on_the_settings(tmp_path):
    for _ in range(2):
        frame_folder.claim(tmp_path, SETTINGS)
    for other in (SETTINGS | {"fps": "30"}, {key: SETTINGS[key] for key in SETTINGS if key != "fps"}):
        with pytest.raises(errors.ConfigError, match=r"other settings \(fps\)"):
            frame_folder.claim(tmp_path, other)
    assert [p.name for p in tmp_path.iterdir()] == [frame_folder.SETTINGS]


def names(folder):
    return sorted(p.name for p in folder.iterdir())


def test_frames_of_other_settings_are_removed_only_on_demand(tmp_path):
    frame_folder.claim(tmp_path, SETTINGS)
    own = ["frame_0001.png", "frame_0002.exr", "frame_12345.png"]
    others = ["frame_0001.jpg", "frame_001.png", "my_frame_0001.png", "notes.txt"]
    for name in own + others:
        (tmp_path / name).write_text(name)
    (tmp_path / "frame_0009.png").mkdir()
    before = names(tmp_path)
    frame_folder.claim(tmp_path, SETTINGS, overwrite=True)
    with pytest.raises(errors.ConfigError, match="--overwrite"):
        frame_folder.claim(tmp_path, SETTINGS | {"size": "64"})
    assert names(tmp_path) == before
    frame_folder.claim(tmp_path, SETTINGS | {"size": "64"}, overwrite=True)
    assert names(tmp_path) == sorted(set(before) - set(own))
    assert json.loads((tmp_path / frame_folder.SETTINGS).read_text()) == SETTINGS | {"size": "64"}


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize(("name", "said"), [("frame_0001.png", "not a frame of"), ("render.json", "not the settings")])
def test_files_of_other_programs_are_left(tmp_path, overwrite, name, said):
    (tmp_path / name).write_text("[1]")
    with pytest.raises(errors.ConfigError, match=said):
        frame_folder.claim(tmp_path, SETTINGS, overwrite=overwrite)
    assert [(p.name, p.read_text()) for p in tmp_path.iterdir()] == [(name, "[1]")]


@pytest.mark.slow
@pytest.mark.heavy
def test_four_processes_of_which_one_is_killed_lose_and_double_no_frame(tmp_path):
    path, folder = scene_file.write(scenes.make_scene(n=2000), tmp_path / "a.r5dgs"), tmp_path / "frames"
    command = [sys.executable, "-m", "r5dgs_core.cli", "render", str(path), "--out", str(folder), "--share"]
    command += ["--time", "0:1", "--seconds", "1", "--fps", str(FRAMES), "--size", "400", "--samples", "4"]
    settings = {**os.environ, "PYTHONPATH": str(ROOT), "NUMBA_NUM_THREADS": "1"}
    logs = [tmp_path / f"{k}.log" for k in range(4)]
    running = []
    for log in logs:
        with log.open("wb") as stream:
            running.append(subprocess.Popen([*command, "--progress", "json"], stdout=stream, env=settings))
    victim, held = running[0], []
    patience.wait_until(lambda: held.append(_frame_of(folder, victim.pid)) or held[-1] is not None)
    os.kill(victim.pid, signal.SIGKILL)
    assert victim.wait(60) == -signal.SIGKILL
    assert [process.wait(240) for process in running[1:]] == [0, 0, 0]

    paths = sorted(folder.glob("*.png"))
    assert [p.name for p in paths] == [f"frame_{number:04d}.png" for number in range(1, FRAMES + 1)]
    drawn = [event["frame"] for log in logs for event in _events(log) if event.get("drawn")]
    assert len(drawn) == len(set(drawn)) and set(range(1, FRAMES + 1)) - set(drawn) <= {held[-1]}
    assert sum(bool([e for e in _events(log) if e.get("drawn")]) for log in logs[1:]) >= 2
    assert not [p for p in folder.iterdir() if p.name.startswith(".")]
    alone = [str(tmp_path / "alone") if part == str(folder) else part for part in command[3:] if part != "--share"]
    assert main.main(alone) == 0
    for one in paths:
        np.testing.assert_array_equal(images.read_png(one), images.read_png(tmp_path / "alone" / one.name))


def _frame_of(folder: Path, pid: int) -> int | None:
    """Number of the frame that a process is drawing, or None."""
    for path in folder.glob(".*.placeholder"):
        try:
            if json.loads(path.read_text())["pid"] == pid:
                return int(path.name.split("_")[1][:4])
        except (OSError, ValueError, KeyError):
            continue
    return None


def _events(log: Path) -> list[dict]:
    """Events of a process; a killed one may have left half a line."""
    return [json.loads(line) for line in log.read_text().splitlines() if line.endswith("}")]
