"""One process at a time writes into a run folder."""

import errno
import os
import socket
import subprocess
import sys

import pytest

from r5dgs_core import folder_lock
from r5dgs_core.cli.commands import associate, bake, evaluate, import_run, lookup, name
from r5dgs_core.errors import CheckpointError
from r5dgs_core.train import checkpoint, run, run_folder
from tests.support import tiny_datasets

pytestmark = pytest.mark.heavy

HOLDS = """
import sys, pathlib
from r5dgs_core import folder_lock
with folder_lock.hold(pathlib.Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.read()
"""
SETTINGS = tiny_datasets.settings("train.iterations=20", "identity.iterations=0", "train.probe_every=0")


@pytest.fixture
def other(tmp_path):
    """A process that holds the folder."""
    command = [sys.executable, "-c", HOLDS, str(tmp_path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stdout.readline().strip() == b"held"
        yield process
        process.kill()


def refused(folder):
    """The message with which a folder is refused."""
    with pytest.raises(CheckpointError) as error, folder_lock.hold(folder):
        pass
    return str(error.value)


def test_the_process_that_holds_a_folder_is_named(tmp_path, other):
    message = refused(tmp_path)
    assert f"{tmp_path}: in use by process {other.pid} on {socket.gethostname()} since 2" in message
    assert str(tmp_path) in message.partition("(")[2] and "wait until that ends or stop it" in message


def test_a_killed_process_leaves_no_lock(tmp_path, other):
    refused(tmp_path)
    other.kill()
    other.wait()
    with folder_lock.hold(tmp_path) as locked:
        assert locked and str(os.getpid()) in refused(tmp_path)
    assert os.listdir(tmp_path) == []


def test_a_folder_is_created_and_unlocked_at_the_end_of_the_block(tmp_path):
    folder = tmp_path / "deep" / "run"
    for _ in range(2):
        with folder_lock.hold(folder):
            assert os.listdir(folder) == [folder_lock.LOCK_FILE]
        assert os.listdir(folder) == []


def test_a_lock_that_its_holder_removes_meanwhile_is_acquired_again(tmp_path, monkeypatch):
    real, opened = folder_lock._lock, []

    def lock(descriptor, path):
        opened.append(descriptor)
        if len(opened) == 1:
            path.unlink()
        return real(descriptor, path)

    monkeypatch.setattr(folder_lock, "_lock", lock)
    with folder_lock.hold(tmp_path):
        assert len(opened) == 2 and refused(tmp_path)


@pytest.mark.skipif(os.name != "posix", reason="Windows has other calls for locks and links")
@pytest.mark.parametrize("kind", ["link", "pipe"])
def test_a_lock_that_is_no_plain_file_is_refused(tmp_path, kind):
    precious = tmp_path / "precious"
    precious.write_text("kept")
    folder = tmp_path / "run"
    folder.mkdir()
    if kind == "link":
        (folder / folder_lock.LOCK_FILE).symlink_to(precious)
    else:
        os.mkfifo(folder / folder_lock.LOCK_FILE)
    assert "choose another --out" in refused(folder) and precious.read_text() == "kept"


@pytest.mark.skipif(os.name != "posix", reason="Windows has other calls for locks")
def test_a_file_system_without_locks_is_named_and_keeps_half_written_files(tiny, tmp_path, monkeypatch, caplog):
    import fcntl

    def flock(*_):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", flock)
    half = tmp_path / f".{run_folder.RUN_FILE}.12ab.part"
    half.write_text("of a process that may live")
    run.train(tiny.root, tmp_path, SETTINGS)
    told = [record.getMessage() for record in caplog.records if "has no locks" in record.getMessage()]
    assert len(told) == 1 and str(tmp_path) in told[0] and half.exists()


@pytest.mark.parametrize("number", [errno.EROFS, errno.EACCES, errno.ENOSPC])
def test_a_folder_that_cannot_be_written_is_an_error_of_one_line(tmp_path, monkeypatch, number):
    def fail(*_):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "open", fail)
    message = refused(tmp_path)
    monkeypatch.undo()
    assert str(tmp_path) in message and os.strerror(number) in message and "\n" not in message


def test_a_second_training_of_a_folder_is_refused_and_changes_nothing(tiny, tmp_path):
    folder, messages = tmp_path / "run", []

    def meanwhile(event):
        if event.get("iteration") == 10:
            half = folder / f".{checkpoint.CHECKPOINT_FILE}.12ab.part"
            half.write_text("half")
            for options in ({"resume": True}, {"overwrite": True}, {}):
                with pytest.raises(CheckpointError) as error:
                    run.train(tiny.root, folder, SETTINGS, **options)
                messages.append(str(error.value))
            assert half.exists()
            half.unlink()

    run.train(tiny.root, folder, SETTINGS, progress=meanwhile)
    assert len(messages) == 3 and all(f"in use by process {os.getpid()}" in message for message in messages)
    assert checkpoint.load(folder).finished and not list(folder.glob(".*"))


def test_a_folder_that_another_training_created_meanwhile_is_not_overwritten(tiny, tmp_path, monkeypatch):
    folder = tmp_path / "run"
    real = run.datasets.read

    def slowly(*args):
        monkeypatch.setattr(run.datasets, "read", real)
        run.train(tiny.root, folder, SETTINGS)
        return real(*args)

    monkeypatch.setattr(run.datasets, "read", slowly)
    with pytest.raises(CheckpointError, match="holds a run at step 20"):
        run.train(tiny.root, folder, SETTINGS)
    assert checkpoint.load(folder).finished


WRITERS = {
    "bake": lambda folder: bake.run_bake(folder, folder / "a.r5dgs", None),
    "import": lambda folder: import_run.run_import(folder, folder / "a.r5dgs"),
    "evaluate a run": lambda folder: evaluate.run_evaluate(folder, None, modes=["rigid"], json_path=None),
    "evaluate a scene": lambda folder: evaluate.run_evaluate(folder / "a.r5dgs", None, modes=["rigid"], json_path=None),
    "associate": lambda folder: associate.run_associate(folder),
    "lookup": lambda folder: lookup.run_lookup(folder / "a.r5dgs", "text"),
    "name": lambda folder: name.run_name(folder / "a.r5dgs", "1", "mug"),
}


@pytest.mark.parametrize("name", WRITERS)
def test_no_command_that_writes_into_a_run_folder_waits_for_the_lock(tmp_path, name):
    (tmp_path / run_folder.RUN_FILE).write_text('{"format_version": 1, "dataset": "data"}')
    with folder_lock.hold(tmp_path), pytest.raises(CheckpointError, match="in use by"):
        WRITERS[name](tmp_path)


@pytest.mark.parametrize(("text", "ours"), [('{"jobs": 3}', False), ("[]", False), ('{"format_version": 1', True)])
def test_a_run_file_of_another_program_makes_no_run_folder_and_a_damaged_one_does(tmp_path, text, ours):
    (tmp_path / run_folder.RUN_FILE).write_text(text)
    (tmp_path / "deep").mkdir()
    with folder_lock.hold_run_around(tmp_path / "deep" / "a.r5dgs"):
        assert (tmp_path / folder_lock.LOCK_FILE).exists() == ours


def test_reading_a_run_and_writing_elsewhere_need_no_lock(tmp_path, trained):
    with folder_lock.hold(trained.folder):
        assert run_folder.open_run(trained.folder).digest == trained.digest
        assert checkpoint.load(trained.folder).finished
        bake.run_bake(trained.folder, tmp_path / "a.r5dgs", None)
    assert (tmp_path / "a.r5dgs").exists()
