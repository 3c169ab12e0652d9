"""Order of worker jobs, and selection of the worker's Python."""

import importlib
import json
import os
import signal
import stat
import subprocess
import sys
import threading
import types
from pathlib import Path

import pytest

from r5dgs_core import errors, user_settings
from r5dgs_core.scene import scene_file
from tests.support import patience, scenes

pytest.importorskip("bpy", reason="bpy is not installed; it comes with the extra 'test' on Python 3.11")
pytest.importorskip("torch", reason="torch is not installed in this Python, which runs the worker here")

PYTHON = sys.executable
HELLO = [("greeting", "hello", {})]


@pytest.fixture
def worker(blender, monkeypatch):
    monkeypatch.delenv("R5DGS_PYTHON", raising=False)
    return importlib.import_module("r5dgs.r5dgs_addon.worker.jobs")


@pytest.fixture
def pythons(blender):
    return importlib.import_module("r5dgs.r5dgs_addon.find_python")


@pytest.fixture
def preferences(blender, monkeypatch):
    monkeypatch.delenv("R5DGS_PYTHON", raising=False)
    module = importlib.import_module("r5dgs.r5dgs_addon.preferences")
    monkeypatch.setattr(module, "_found", None)
    return module


@pytest.fixture
def held(worker):
    """Worker that is busy with a job and does not proceed."""
    running = worker.current()
    os.kill(running.pid, signal.SIGSTOP)
    job = worker.start(HELLO)
    patience.wait_until(lambda: job.doing == "greeting")
    yield running, job
    if running.alive:
        os.kill(running.pid, signal.SIGCONT)
    job.join()


@pytest.mark.skipif(not hasattr(signal, "SIGPIPE"), reason="Windows has no such signal")
def test_writing_to_a_worker_that_has_ended_is_an_error_and_no_signal_for_blender(worker):
    """Blender keeps the default action of SIGPIPE, which would end it; Python ignores the signal."""
    process = importlib.import_module("r5dgs.r5dgs_addon.worker.process")
    heard = []
    before = signal.signal(signal.SIGPIPE, lambda *_: heard.append(True))
    try:
        running = process.Worker("true")
        patience.wait_until(lambda: not running.alive)
        with pytest.raises(errors.BackendError, match=r"ended unexpectedly.*'Worker Python'"):
            running.greet(20.0)
        assert not heard and signal.SIGPIPE not in signal.pthread_sigmask(signal.SIG_BLOCK, ())
    finally:
        signal.signal(signal.SIGPIPE, before)


def test_the_latest_request_of_a_key_wins_and_other_keys_keep_their_turn(worker, held):
    running, first = held
    other = worker.submit("other", HELLO)
    waiting = [worker.submit("view", HELLO) for _ in range(3)]
    assert [job.dropped for job in waiting] == [True, True, False] and not other.dropped
    assert worker.busy() and worker.busy("view") and worker.busy("other") and not worker.busy("third")
    with pytest.raises(errors.BackendError, match="dropped before it started"):
        waiting[0].answer()
    os.kill(running.pid, signal.SIGCONT)
    for job in (first, other, waiting[2]):
        assert job.answer()[0]["pid"] == running.pid
    assert not worker.busy()


def test_a_running_request_is_not_dropped_for_a_later_one(worker):
    running = worker.current()
    os.kill(running.pid, signal.SIGSTOP)
    first = worker.submit("view", HELLO)
    patience.wait_until(lambda: first.doing == "greeting")
    second = worker.submit("view", HELLO)
    os.kill(running.pid, signal.SIGCONT)
    assert first.answer()[0]["pid"] == second.answer()[0]["pid"] == running.pid


def test_a_blocking_request_waits_for_its_turn(worker, held):
    running, first = held
    threading.Timer(0.1, os.kill, (running.pid, signal.SIGCONT)).start()
    assert worker.request("hello")[0]["pid"] == running.pid and first.done


def test_cancelling_a_waiting_job_keeps_the_worker_and_a_running_job_ends_it(worker, held):
    running, first = held
    waiting = worker.submit("view", HELLO)
    waiting.cancel()
    assert waiting.dropped and waiting.done and running.alive and not first.done
    next_one = worker.submit("view", HELLO)
    first.cancel()
    with pytest.raises(errors.BackendError, match="ended unexpectedly"):
        first.answer()
    assert not running.alive and next_one.answer()[0]["pid"] != running.pid


def test_stopping_ends_running_and_waiting_jobs(worker, held):
    running, first = held
    waiting = [worker.submit(key, HELLO) for key in ("a", "b")]
    worker.stop()
    assert first.done and all(job.dropped for job in waiting) and not running.alive and not worker.busy()


def test_a_worker_that_is_killed_in_the_middle_of_a_picture_is_survived(worker, tmp_path):
    path = scene_file.write(scenes.make_scene(n=2000, objects=3, seed=4), tmp_path / "scene.r5dgs")
    camera = scenes.orbit_camera(0.2, 4000, 4000)
    view = {"width": 4000, "height": 4000, "intrinsics": camera.intrinsics.tolist()}
    render = {"camera": {**view, "T_cam_world": camera.T_cam_world.tolist()}, "t": 0.3}
    steps = [("loading", "load", {"paths": [str(path)]}), ("rendering", "render", render)]
    running = worker.current()
    job = worker.start(steps)
    patience.wait_until(lambda: job.doing == "rendering" or job.done)
    os.kill(running.pid, signal.SIGKILL)
    with pytest.raises(errors.BackendError, match="ended unexpectedly.*starts it again"):
        job.answer()
    small = {**render, "camera": {**render["camera"], "width": 8, "height": 6}}
    _, arrays = worker.run([steps[0], ("rendering", "render", small)])
    assert arrays["color"].shape == (6, 8, 3)


def fake_python(path, reason=""):
    """Executable that reports that it can run the worker, or a reason why it cannot."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"#!{PYTHON}\nraise SystemExit({reason!r} or 0)\n")
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return str(path)


@pytest.fixture
def elsewhere(monkeypatch, tmp_path):
    """Home folder and PATH in which only the Pythons of a test exist."""
    for name in ("VIRTUAL_ENV", "CONDA_PREFIX"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(sys, "executable", "")
    monkeypatch.setenv("PATH", str(tmp_path / "path"))
    return tmp_path


def test_pythons_are_searched_beside_the_extension_at_home_and_on_the_path(pythons, elsewhere, monkeypatch):
    own, home = elsewhere / "own", elsewhere / "home"
    expected = [
        fake_python(elsewhere / "active" / "bin" / "python"),
        fake_python(own / ".venv" / "bin" / "python"),
        fake_python(home / ".virtualenvs" / "r5dgs" / "bin" / "python"),
        fake_python(home / "miniconda3" / "envs" / "r5dgs" / "bin" / "python"),
        fake_python(elsewhere / "tools" / "bin" / "python"),
        fake_python(elsewhere / "path" / "python3"),
    ]
    monkeypatch.setenv("VIRTUAL_ENV", str(elsewhere / "active"))
    command = elsewhere / "path" / "r5dgs"
    command.write_text(f"#!{expected[4]}\n")
    command.chmod(0o755)
    (own / "venv" / "bin").mkdir(parents=True)
    (own / "venv" / "bin" / "python").write_text("not executable")
    assert list(pythons.candidates([own], home)) == expected


def test_a_python_with_torch_is_preferred_to_an_earlier_one_that_can_only_draw(pythons, elsewhere):
    own, home = elsewhere / "own", elsewhere / "home"
    lacking = fake_python(own / "venv" / "bin" / "python", "lacks numba")
    assert pythons.lacking(lacking) == "lacks numba" and pythons.find([own], home) is None
    drawing = Path(fake_python(home / "r5dgs" / ".venv" / "bin" / "python"))
    drawing.write_text(f"#!{PYTHON}\nimport sys\nraise SystemExit('lacks torch' if 'torch' in sys.argv else 0)\n")
    assert pythons.find([own], home) == str(drawing)
    complete = fake_python(elsewhere / "path" / "python3")
    assert pythons.find([own], home) == complete


def test_blenders_own_python_is_given_the_folder_of_the_bundled_numba(pythons, monkeypatch, tmp_path):
    (tmp_path / "bundled" / "numba").mkdir(parents=True)
    (tmp_path / "bundled" / "numba" / "__init__.py").touch()
    monkeypatch.syspath_prepend(tmp_path / "bundled")
    monkeypatch.setenv("PYTHONPATH", "known")
    assert pythons.environment(sys.executable)["PYTHONPATH"] == f"{tmp_path / 'bundled'}{os.pathsep}known"
    assert pythons.environment("/other/python")["PYTHONPATH"] == pythons.environment()["PYTHONPATH"] == "known"


def test_blenders_own_python_compiles_kernels_into_the_folder_of_the_extension(worker, preferences, monkeypatch):
    process, begun = importlib.import_module("r5dgs.r5dgs_addon.worker.process"), []
    monkeypatch.setattr(preferences, "snapshot", lambda: preferences.Snapshot("", "", (), 1.0, kernels="/kernels"))
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)

    def begin(command, env, **_):
        begun.append(env.get("NUMBA_CACHE_DIR"))
        raise OSError("not started")

    monkeypatch.setattr(process, "ProcessGroup", begin)
    for python in (sys.executable, "/other/python"):
        with pytest.raises(errors.BackendError, match="not started"):
            process.Worker(python)
    assert begun == ["/kernels", None]


def test_unsuitable_pythons_are_rejected_with_the_reason(pythons, tmp_path):
    assert pythons.lacking(sys.executable) is None
    assert pythons.lacking(str(tmp_path / "none")) is not None
    dull = tmp_path / "dull"
    dull.write_text("no program")
    dull.chmod(0o755)
    assert pythons.lacking(str(dull)) is not None


def test_a_found_python_is_cached_until_it_is_forgotten_or_removed(preferences, pythons, elsewhere, monkeypatch):
    looked = []
    places = [fake_python(elsewhere / "one"), fake_python(elsewhere / "two")]
    monkeypatch.setattr(
        pythons, "find", lambda *_, **__: looked.append(1) or next(p for p in places if os.path.exists(p))
    )
    assert preferences.worker_python() == preferences.worker_python() == places[0] and len(looked) == 1
    os.remove(places[0])
    assert preferences.worker_python() == places[1] and len(looked) == 2
    preferences.forget()
    assert preferences.worker_python() == places[1] and len(looked) == 3
    monkeypatch.setenv("R5DGS_PYTHON", "/chosen/python")
    assert preferences.worker_python() == "/chosen/python" and len(looked) == 3


def test_the_users_settings_name_the_python_after_the_preferences_and_before_the_search(
    preferences, pythons, monkeypatch, tmp_path, caplog
):
    kept = types.SimpleNamespace(worker_python="", found_python="", trusted_folders="", worker_timeout=7)
    monkeypatch.setattr(preferences, "get", lambda: kept)
    monkeypatch.setattr(pythons, "find", lambda *_, **__: sys.executable)
    named = fake_python(tmp_path / "named")
    place = user_settings.write("worker_python", named)
    assert preferences.worker_python() == named
    kept.found_python = sys.executable
    assert preferences.worker_python() == named
    kept.worker_python = "/preferred/python"
    assert preferences.worker_python() == "/preferred/python"
    kept.worker_python = ""
    place.write_text("worker_python = 3")
    for _ in range(2):
        assert preferences.worker_python() == sys.executable
    assert [str(place) in record.getMessage() for record in caplog.records] == [True]
    user_settings.path().unlink()
    assert preferences.worker_python() == sys.executable


def test_blenders_own_python_is_used_if_no_python_is_suitable(preferences, pythons, monkeypatch):
    monkeypatch.setattr(pythons, "find", lambda *_, **__: None)
    assert preferences.worker_python() == sys.executable


def elsewhere_called(function):
    """Result of a function called outside Blender's main thread."""
    results = []
    thread = threading.Thread(target=lambda: results.append(function()))
    thread.start()
    thread.join()
    return results[0]


def test_other_threads_use_cached_preferences_without_reading_them(preferences, pythons, monkeypatch):
    kept = types.SimpleNamespace(worker_python="", found_python="", trusted_folders="", worker_timeout=7)
    asked = []
    monkeypatch.setattr(preferences, "get", lambda: asked.append(threading.current_thread()) or kept)
    monkeypatch.setattr(pythons, "find", lambda *_, **__: sys.executable)
    assert preferences.snapshot().timeout_s == 7
    kept.worker_timeout = 8
    assert elsewhere_called(preferences.snapshot).timeout_s == 7
    assert elsewhere_called(preferences.worker_python) == sys.executable and kept.found_python == ""
    assert set(asked) == {threading.main_thread()}
    assert preferences.snapshot().timeout_s == 8 and kept.found_python == sys.executable


@pytest.fixture
def only_python(preferences, elsewhere, monkeypatch):
    """Make an executable script the only Python that a search can find."""
    monkeypatch.setattr(preferences, "_beside", lambda: [])
    monkeypatch.setattr(Path, "home", lambda: elsewhere / "home")

    def make(lines):
        path = elsewhere / "path" / "python3"
        path.parent.mkdir()
        path.write_text("#!/bin/sh\n" + lines)
        path.chmod(0o755)
        return path

    return make


@pytest.mark.skipif(os.name == "nt", reason="the script is one of a POSIX shell")
def test_the_search_for_a_python_does_not_block_and_can_be_cancelled(worker, only_python, tmp_path):
    told = tmp_path / "pid"
    only_python(f"echo $$ > {told}.new; /bin/mv {told}.new {told}; exec /bin/sleep 600\n")
    job = worker.submit("view", HELLO)
    patience.wait_until(told.exists)
    assert not job.done and job.doing == worker.SEARCHING == "looking for a Python with numba"
    job.cancel()
    assert job.done and not worker.busy()
    with pytest.raises(ProcessLookupError):
        os.kill(int(told.read_text()), 0)
    with pytest.raises(errors.BackendError, match="stopped"):
        job.answer()


@pytest.mark.skipif(os.name == "nt", reason="the script is one of a POSIX shell")
def test_a_python_found_in_the_background_runs_the_worker_and_is_stored(
    worker, preferences, only_python, tmp_path, monkeypatch
):
    gate = tmp_path / "gate"
    os.mkfifo(gate)
    kept = types.SimpleNamespace(worker_python="", found_python="", trusted_folders="", worker_timeout=120)
    monkeypatch.setattr(preferences, "get", lambda: kept)
    found = only_python(f'[ "$1" = -c ] && read line < {gate}\nexec {PYTHON} "$@"\n')
    job = worker.submit("view", HELLO)
    with open(gate, "w"):  # from here on the search waits for the end of this block
        assert not job.done and job.doing == worker.SEARCHING and job.python == ""
    assert job.answer()[0]["pid"] and job.python == str(found) == kept.found_python
    again = worker.submit("view", HELLO)  # a new search would wait for ever at the gate
    assert again.answer()[0]["pid"] and again.python == str(found)
    worker.stop()


WRAPPERS = {
    "a child of a shell script": '{python} "$@"\nstatus=$?\nexit $status\n',
    "one that ignores SIGTERM": 'trap "" TERM\n{python} "$@"\nstatus=$?\nexit $status\n',
}


@pytest.fixture(params=WRAPPERS)
def wrapper(request, tmp_path):
    """A Worker Python that runs the real one as a child, as ``conda run`` does."""
    path = tmp_path / "wrapper"
    path.write_text("#!/bin/sh\n" + WRAPPERS[request.param].format(python=PYTHON))
    path.chmod(0o755)
    return str(path)


def runs(pid):
    """True while a process exists and is no zombie."""
    try:
        return "Z" not in Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="needs /proc to look at processes of others")
def test_stopping_ends_a_wrapper_script_and_the_python_that_it_runs(worker, wrapper, monkeypatch):
    monkeypatch.setenv("R5DGS_PYTHON", wrapper)
    running = worker.current()
    child = running.hello["pid"]
    assert child != running.pid and runs(child)
    os.kill(child, signal.SIGSTOP)  # it neither answers nor ends by itself
    job = worker.start(HELLO)
    patience.wait_until(lambda: job.doing == "greeting")
    job.cancel()
    assert job.done and not running.alive and not runs(running.pid)
    patience.wait_until(lambda: not runs(child))
    with pytest.raises(errors.BackendError, match="ended unexpectedly"):
        job.answer()
    assert worker.request("hello")[0]["pid"] != child


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="needs /proc to look at processes of others")
def test_a_process_that_left_the_group_and_keeps_the_pipes_is_not_waited_for(worker, monkeypatch, tmp_path):
    path, told = tmp_path / "daemon", tmp_path / "pid"
    lines = ("import os, time", "if os.fork():", "    time.sleep(600)", "os.setsid()")
    lines = (
        *lines,
        f"open({str(told)!r} + '.new', 'w').write(str(os.getpid()))",
        f"os.rename({str(told)!r} + '.new', ",
    )
    path.write_text(f"#!{PYTHON}\n" + "\n".join(lines) + f"{str(told)!r})\ntime.sleep(600)\n")
    path.chmod(0o755)
    monkeypatch.setenv("R5DGS_PYTHON", str(path))
    job = worker.start(HELLO)
    patience.wait_until(told.exists)
    stray = int(told.read_text())
    try:
        job.cancel()  # would wait for the pipes' other end, if any pipe were closed here
        assert job.done and runs(stray)
        worker.stop()
    finally:
        os.kill(stray, signal.SIGKILL)


def test_the_timeout_of_the_preferences_limits_the_start(worker, preferences, monkeypatch, tmp_path):
    path = tmp_path / "silent"
    path.write_text("#!/bin/sh\nexec sleep 600\n")
    path.chmod(0o755)
    monkeypatch.setenv("R5DGS_PYTHON", str(path))
    kept = types.SimpleNamespace(worker_python="", found_python="", trusted_folders="", worker_timeout=0.3)
    monkeypatch.setattr(preferences, "get", lambda: kept)
    with pytest.raises(errors.BackendError, match=r"no answer to 'hello' within 0\.3 s.*'Timeout'"):
        worker.request("hello")
    assert worker._worker is None or not worker._worker.alive


PARENT = """
import importlib.util, os, subprocess, sys, time
spec = importlib.util.spec_from_file_location("process_group", sys.argv[1])
module = importlib.util.module_from_spec(spec)
spec.loader.exec_module(module)
pipe = subprocess.PIPE
group = module.ProcessGroup([sys.argv[2], "-m", "r5dgs_core.worker.server"], stdin=pipe, stdout=pipe, cwd=sys.argv[3])
group.process.stdin.write(b'{"id": 1, "command": "hello"}\\n')
group.process.stdin.flush()
print(group.process.stdout.readline().decode(), flush=True)
time.sleep(600)
"""


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="needs /proc to look at processes of others")
def test_the_worker_ends_when_blender_is_killed(wrapper, blender):
    module = importlib.import_module("r5dgs.r5dgs_addon.process_group")
    root = Path(module.__file__).parent.parent
    arguments = [PYTHON, "-c", PARENT, module.__file__, wrapper, str(root)]
    with subprocess.Popen(arguments, stdout=subprocess.PIPE) as parent:
        child = json.loads(parent.stdout.readline())["result"]["pid"]
        assert runs(child)
        parent.kill()
    patience.wait_until(lambda: not runs(child))
