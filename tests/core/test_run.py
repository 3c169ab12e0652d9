"""Runs that are killed or stopped go on to the numbers of an unbroken one."""

import dataclasses
import json
import os
import signal
import subprocess
import sys

import pytest
import torch

from r5dgs_core import cli
from r5dgs_core.errors import CheckpointError
from r5dgs_core.train import checkpoint, run
from tests import datasets as tiny_datasets

STEPS, IDENTITY = 150, 20
OVERRIDES = (f"train.iterations={STEPS}", f"identity.iterations={IDENTITY}", "train.checkpoint_every=20")


@pytest.fixture(scope="module")
def unbroken(tiny, tmp_path_factory):
    """Folder of a run that nothing disturbed, and the events that it reported."""
    events = []
    folder = tmp_path_factory.mktemp("unbroken") / "run"
    run.train(tiny.root, folder, tiny_datasets.settings(*OVERRIDES), progress=events.append)
    return folder, events


def arguments(tiny, folder):
    options = [text for override in (*tiny_datasets.SETTINGS, *OVERRIDES) for text in ("--set", override)]
    return ["train", str(tiny.root), "--out", str(folder), *options]


def assert_equal_runs(folder, reference):
    ours, theirs = checkpoint.load(folder), checkpoint.load(reference)
    assert ours.finished and ours.tensors.keys() == theirs.tensors.keys()
    for name, tensor in theirs.tensors.items():
        assert torch.equal(ours.tensors[name], tensor), name
    assert torch.equal(ours.observed, theirs.observed)
    for name in {field.name for field in dataclasses.fields(ours)} - {"tensors", "seconds", "observed"}:
        assert getattr(ours, name) == getattr(theirs, name), name


def log_of(folder):
    """Steps, losses and counts of a run's log, without its clock."""
    lines = (folder / checkpoint.LOG_FILE).read_text().splitlines()
    return [[json.loads(line)[key] for key in ("iteration", "loss", "gaussians")] for line in lines]


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM], ids=["kill", "terminate"])
def test_a_stopped_run_resumes_to_the_same_bits(tiny, unbroken, tmp_path, capsys, number):
    folder = tmp_path / "run"
    command = [sys.executable, "-m", "r5dgs_core.cli", *arguments(tiny, folder), "--progress", "json"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None and process.stderr is not None
        for line in process.stdout:
            if json.loads(line).get("iteration", 0) >= 50:
                os.kill(process.pid, number)
                break
        _, complaint = process.communicate(timeout=120)
    stopped = checkpoint.load(folder)
    assert not stopped.finished and 40 <= stopped.iteration < STEPS
    if number == signal.SIGKILL:
        assert process.returncode == -signal.SIGKILL and stopped.iteration % 20 == 0
    else:
        assert process.returncode == 130
        assert complaint == (
            f"r5dgs: stopped at step {stopped.iteration}; go on with: r5dgs train {tiny.root.resolve()} "
            f"--out {folder} --resume\n"
        )
    assert cli.main(["train", str(tiny.root), "--out", str(folder), "--resume", "--progress", "none"]) == 0
    assert capsys.readouterr().err == ""
    assert_equal_runs(folder, unbroken[0])
    assert log_of(folder) == log_of(unbroken[0])


def test_a_run_killed_before_its_last_labels_only_makes_these(tiny, unbroken, tmp_path, monkeypatch):
    folder, settings = tmp_path / "run", tiny_datasets.settings(*OVERRIDES)

    def die(*args, **kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr(run, "_finish", die)
    with pytest.raises(KeyboardInterrupt):
        run.train(tiny.root, folder, settings)
    monkeypatch.undo()
    assert checkpoint.load(folder).iteration == STEPS
    events = []
    run.train(tiny.root, folder, settings, resume=True, progress=events.append)
    assert "step" not in {event["event"] for event in events}
    assert_equal_runs(folder, unbroken[0])


def test_progress_counts_up_to_the_end(unbroken):
    folder, events = unbroken
    assert events[0]["event"] == "start" and events[0]["iterations"] == STEPS
    assert events[-1]["event"] == "done"
    steps = [event for event in events if event["event"] == "step"]
    assert [event["iteration"] for event in steps] == list(range(10, STEPS + 1, 10))
    assert all(event["seconds_left"] >= 0 for event in steps) and steps[-1]["seconds_left"] == 0
    assert [e["iteration"] for e in events if e["event"] == "identity"] == [10, 20]
    logged = [json.loads(line) for line in (folder / checkpoint.LOG_FILE).read_text().splitlines()]
    assert logged == steps


def test_resuming_a_finished_run_changes_nothing(tiny, unbroken):
    path = unbroken[0] / checkpoint.CHECKPOINT_FILE
    before = path.read_bytes()
    events = []
    run.train(tiny.root, unbroken[0], tiny_datasets.settings(), resume=True, progress=events.append)
    assert path.read_bytes() == before
    assert events[-1]["event"] == "done" and events[-1]["gaussians"] > 0


def test_resuming_on_other_data_is_refused(unbroken, tmp_path):
    other = tiny_datasets.make_dataset(tmp_path, views=3)
    with pytest.raises(CheckpointError, match="was trained on other data"):
        run.train(other.root, unbroken[0], tiny_datasets.settings(), resume=True)


def test_signal_handlers_are_the_callers_again_after_training(tiny, tmp_path):
    before = signal.getsignal(signal.SIGTERM), signal.getsignal(signal.SIGINT)
    run.train(tiny.root, tmp_path / "run", tiny_datasets.settings("train.iterations=2", "identity.iterations=0"))
    assert (signal.getsignal(signal.SIGTERM), signal.getsignal(signal.SIGINT)) == before
