"""Live view of a training run."""

import itertools
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from r5dgs_core.cli import live_bake, live_run
from r5dgs_core.cli.commands import view
from tests.support import patience
from tests.support.command_line import complaint

ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture
def run(trained, tmp_path):
    return shutil.copytree(trained.folder, tmp_path / "run")


@pytest.fixture
def watched(run, tmp_path):
    """A live view whose thread runs."""
    (tmp_path / "made").mkdir()
    live = live_run.LiveRun(run, tmp_path / "made", idle=False)  # idle time may never come during tests
    thread = threading.Thread(target=live.watch)
    yield live, thread
    live.stop()
    if thread.ident is not None:
        thread.join()


def test_an_empty_run_waits_for_its_checkpoint(tmp_path):
    live = live_run.LiveRun(tmp_path, tmp_path)
    state = live.state()
    assert (state["bakes"], state["log"], state["curves"], state["baking"]) == (0, None, None, False)
    assert live.find("/scene") is None and live.find("/curves") is None and live.find("/../run.json") is None
    page = live.find("/")
    assert page is not None and b"/state" in page.content
    assert json.loads(live.find("/state").content) == state


def test_the_last_complete_line_of_the_log_is_shown(tmp_path):
    (tmp_path / "log.jsonl").write_text('{"iteration": 50}\n{"iteration": 100, "loss": 0.5}\n{"iteration": 1')
    assert live_run.LiveRun(tmp_path, tmp_path).state()["log"] == {"iteration": 100, "loss": 0.5}


@pytest.mark.slow
def test_a_checkpoint_is_baked_once_by_another_process(watched, monkeypatch):
    live, thread = watched
    (live.run / live_run.CURVES).write_bytes(b"\x89PNG")
    monkeypatch.setattr(live_run, "POLL_S", 0.01)
    thread.start()
    patience.wait_until(lambda: live.state()["bakes"] or live.state()["problem"])
    state = live.state()
    assert state["bakes"] == 1 and state["problem"] == ""
    assert b"<canvas" in live.find("/scene").content and live.find("/sheet").content.startswith(b"\x89PNG")
    assert live.find("/curves").content == b"\x89PNG" and state["curves"] is not None
    made = (live.folder / live_run.SCENE).stat().st_mtime_ns
    assert not thread.join(0.5) and (live.folder / live_run.SCENE).stat().st_mtime_ns == made


@pytest.mark.parametrize(
    ("spent", "wait"), [(0.0, live_run.EVERY_S), (2.0, live_run.EVERY_S), (30.0, 30.0 / live_run.SHARE)]
)
def test_bakes_start_at_most_once_a_minute_and_take_a_tenth_of_the_time(watched, monkeypatch, spent, wait):
    live, _ = watched
    waits, clock = [], itertools.count(0.0, spent)

    def sleep(seconds):
        waits.append(seconds)
        os.utime(live.run / live_run.CHECKPOINT, ns=(1, len(waits)))  # a new checkpoint each time
        if len(waits) == 3:
            live.stop()

    monkeypatch.setattr(live, "_bake", lambda: None)
    monkeypatch.setattr(live_run, "_children_seconds", lambda: next(clock))
    monkeypatch.setattr(live._stop, "wait", sleep)
    live.watch()
    assert len(waits) == 3 and all(wait - 1 < seconds <= wait for seconds in waits)


@pytest.mark.heavy
def test_a_bake_that_fails_is_reported_and_the_last_scene_stays(watched):
    live, _ = watched
    (live.folder / live_run.SCENE).write_bytes(b"old")
    (live.run / "run.json").write_text("{")
    live._bake()
    assert "run.json" in live.state()["problem"] and live.state()["bakes"] == 0
    assert live.find("/scene").content == b"old"


@pytest.mark.parametrize(("retry", "count"), [(0.0, 3), (1e6, 1)])
def test_a_bake_that_fails_is_repeated_after_a_while(watched, monkeypatch, retry, count):
    live, _ = watched
    waits, bakes = [], []

    def fail():
        bakes.append(1)
        live._problem = "out of memory"

    def sleep(seconds):
        waits.append(seconds)
        if len(waits) == 3:
            live.stop()

    monkeypatch.setattr(live_run, "RETRY_S", retry)
    monkeypatch.setattr(live, "_bake", fail)
    monkeypatch.setattr(live._stop, "wait", sleep)
    live.watch()
    assert len(bakes) == count


def test_no_bake_starts_after_the_end(watched):
    live, _ = watched
    live.stop()
    live._bake()
    assert live._process is None and not live.state()["baking"]


def test_a_bake_ends_with_the_process_that_started_it():
    code = "from r5dgs_core.cli import live_bake; import time; live_bake.end_with_input(); time.sleep(1000)"
    settings = {**os.environ, "PYTHONPATH": str(ROOT)}
    with subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, env=settings) as process:
        process.stdin.close()
        assert process.wait(patience.PATIENCE_S) == 1


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="needs the signals of Unix")
@pytest.mark.parametrize("number", ["SIGTERM", "SIGHUP"])
def test_a_signal_ends_the_view_and_removes_its_files(run, tmp_path, number):
    (tmp_path / "temporary").mkdir()
    settings = {**os.environ, "PYTHONPATH": str(ROOT), "TMPDIR": str(tmp_path / "temporary")}
    code = f"import signal; signal.signal(signal.{number}, signal.SIG_DFL); "  # nohup ignores one of them
    code += "import sys; from r5dgs_core.cli import main; sys.exit(main.main(sys.argv[1:]))"
    command = [sys.executable, "-c", code, "view", "--live", str(run), "--no-browser"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=settings) as process:
        try:
            assert "http://" in process.stdout.readline()
            assert list((tmp_path / "temporary").glob("r5dgs_live_*"))
            process.send_signal(getattr(signal, number))
            assert process.wait(patience.PATIENCE_S) == 0
        finally:
            process.kill()
    assert not list((tmp_path / "temporary").glob("r5dgs_live_*"))


def test_ctrl_c_ends_the_view_as_soon_as_the_address_is_visible(monkeypatch):
    printed = []

    def interrupted(*words, **options):
        printed.append(words)
        if len(printed) == 1:
            raise KeyboardInterrupt

    monkeypatch.setattr(view, "print", interrupted, raising=False)
    view._serve({}.get, 0, browser=False)
    assert "http://" in printed[0][0]


@pytest.mark.skipif(not hasattr(os, "SCHED_IDLE"), reason="needs Linux")
def test_baking_has_the_lowest_priority():
    code = "from r5dgs_core.cli import live_bake; import os; live_bake.lower_priority(); "
    code += "print(os.nice(0), os.sched_getscheduler(0))"
    settings = {**os.environ, "PYTHONPATH": str(ROOT)}
    own_session = {"start_new_session": True}  # else the session of the tests would have the lowest priority, too
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=settings, check=True, **own_session
    )
    assert done.stdout.split() == ["19", str(os.SCHED_IDLE)]


def test_a_path_that_is_no_run_is_named(tmp_path, capsys):
    assert "not a run folder" in complaint(capsys, "view", "--live", tmp_path, "--no-browser")


@pytest.mark.slow
def test_scene_and_sheet_have_the_names_that_the_view_looks_for(run, tmp_path):
    live_bake.make(run, tmp_path)
    assert {live_run.SCENE, live_run.SHEET} <= {path.name for path in tmp_path.iterdir()}
