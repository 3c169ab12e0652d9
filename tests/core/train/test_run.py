"""Runs that are killed or stopped resume to the result of an uninterrupted run."""

import dataclasses
import json
import shlex
import shutil
import signal

import pytest
import torch

from r5dgs_core import atomic_files
from r5dgs_core.cli import main
from r5dgs_core.errors import CheckpointError, Interrupted, TrainingError
from r5dgs_core.train import checkpoint, run, run_folder, step_log
from tests.support import processes, tiny_datasets

pytestmark = pytest.mark.heavy

STEPS, IDENTITY = 70, 20  # Gaussians grow after 20 and 40 steps, residuals are tried after 28
OVERRIDES = (
    f"train.iterations={STEPS}",
    f"identity.iterations={IDENTITY}",
    "train.checkpoint_every=20",
    "densify.stop=0.6",
)


@pytest.fixture(scope="module")
def unbroken(tiny, tmp_path_factory):
    """Folder of a run that nothing disturbed, and the events that it reported."""
    events = []
    folder = tmp_path_factory.mktemp("unbroken") / "run"
    run.train(tiny.root, folder, tiny_datasets.settings(*OVERRIDES), progress=events.append)
    return folder, events


def arguments(tiny, folder, *further):
    options = [text for override in (*tiny_datasets.SETTINGS, *OVERRIDES, *further) for text in ("--set", override)]
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
    lines = (folder / run_folder.LOG_FILE).read_text().splitlines()
    return [[json.loads(line)[key] for key in ("iteration", "loss", "gaussians")] for line in lines]


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.slow
@pytest.mark.default_cases("kill")
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM], ids=["kill", "terminate"])
def test_a_stopped_run_resumes_to_the_same_bits(tiny, unbroken, tmp_path, capsys, number):
    folder = tmp_path / "run"
    stop_at(25, number, arguments(tiny, folder), folder)
    with open(folder / run_folder.LOG_FILE, "a") as stream:
        stream.write('{"event": "step", "itera')  # what a crash of the machine may leave
    assert main.main(["train", str(tiny.root), "--out", str(folder), "--resume", "--progress", "none"]) == 0
    assert capsys.readouterr().err == ""
    assert_equal_runs(folder, unbroken[0])
    assert log_of(folder) == log_of(unbroken[0])


# A command that sends itself a signal when its progress reaches a step.
SIGNALLED = """
import json, os, sys
from r5dgs_core.cli import main as cli
step, number, write = int(sys.argv[1]), int(sys.argv[2]), sys.stdout.write

def watch(text):
    written = write(text)
    if text.startswith("{") and json.loads(text).get("iteration", 0) >= step:
        os.kill(os.getpid(), number)
    return written

sys.stdout.write = watch
sys.exit(cli.main([*sys.argv[3:], "--progress", "json"]))
"""


def stop_at(step, number, options, folder):
    """Train in a process of its own that gets a signal at a step."""
    process = processes.run(SIGNALLED, step, int(number), *options)
    complaint = process.stderr
    if not (folder / checkpoint.CHECKPOINT_FILE).exists():
        assert process.returncode == -signal.SIGKILL
        return
    stopped = checkpoint.load(folder)
    assert not stopped.finished and 20 <= stopped.iteration < STEPS
    if number == signal.SIGKILL:
        assert process.returncode == -signal.SIGKILL and stopped.iteration % 20 == 0
    else:
        assert process.returncode == 130
        assert complaint == (
            f"r5dgs: stopped at step {stopped.iteration}; continue with: "
            f"r5dgs train {options[1]} --out {folder} --resume\n"
        )


@pytest.mark.slow
def test_a_run_killed_before_its_first_checkpoint_starts_again(tiny, unbroken, tmp_path):
    folder = tmp_path / "run"
    stop_at(30, signal.SIGKILL, arguments(tiny, folder, "train.checkpoint_every=1000"), folder)
    assert not (folder / checkpoint.CHECKPOINT_FILE).exists() and len(log_of(folder)) >= 3
    assert main.main(["train", str(tiny.root), "--out", str(folder), "--resume", "--progress", "none"]) == 0
    assert_equal_runs(folder, unbroken[0])
    assert log_of(folder) == log_of(unbroken[0])


@pytest.mark.default_cases("placing", "identities")
@pytest.mark.parametrize(
    ("moment", "number", "done"),
    [
        ({"event": "prepare", "text": "kernels"}, signal.SIGTERM, None),
        ({"event": "prepare", "text": "images, objects, background"}, signal.SIGINT, None),
        ({"event": "prepare", "text": "labels, by a vote of the masks"}, signal.SIGINT, STEPS),
        ({"event": "identity", "iteration": 10}, signal.SIGTERM, STEPS),
    ],
    ids=["compiling", "placing", "voting", "identities"],
)
def test_a_run_stopped_outside_its_steps_names_the_command_that_continues_it(
    tiny, unbroken, tmp_path, moment, number, done
):
    folder, settings = tmp_path / "my run", tiny_datasets.settings(*OVERRIDES)

    def stop(event):
        if moment.items() <= event.items():
            signal.raise_signal(number)

    with pytest.raises(Interrupted) as stopped:
        run.train(tiny.root, folder, settings, progress=stop)
    command = shlex.split(str(stopped.value).split("continue with: ")[1])
    assert command == ["r5dgs", "train", str(tiny.root.resolve()), "--out", str(folder), "--resume"]
    written = (folder / checkpoint.CHECKPOINT_FILE).exists()
    assert (checkpoint.load(folder).iteration if written else None) == done  # no step is repeated
    assert main.main([*command[1:], "--progress", "none"]) == 0
    assert_equal_runs(folder, unbroken[0])
    assert log_of(folder) == log_of(unbroken[0])


def test_progress_counts_up_to_the_end(unbroken):
    folder, events = unbroken
    assert events[0]["event"] == "start" and events[0]["iterations"] == STEPS
    assert events[-1]["event"] == "trained"
    steps = [event for event in events if event["event"] == "step"]
    assert [event["iteration"] for event in steps] == list(range(10, STEPS + 1, 10))
    assert (
        all(event["seconds_left"] >= 0 for event in steps) and steps[-1]["seconds_left"] > 0
    )  # the identities are left
    identities = [event for event in events if event["event"] == "identity"]
    assert [e["iteration"] for e in identities] == [10, 20] and identities[-1]["seconds_left"] == 0
    prepared = [event["text"] for event in events if event["event"] == "prepare"]
    assert len(prepared) == 3 and "kernels" in prepared[0] and "objects" in prepared[1] and "labels" in prepared[2]
    logged = [json.loads(line) for line in (folder / run_folder.LOG_FILE).read_text().splitlines()]
    assert logged == steps


def test_resuming_a_finished_run_changes_nothing(tiny, unbroken):
    path = unbroken[0] / checkpoint.CHECKPOINT_FILE
    before = path.read_bytes()
    events = []
    run.train(tiny.root, unbroken[0], tiny_datasets.settings(), resume=True, progress=events.append)
    assert path.read_bytes() == before
    assert events[-1]["event"] == "trained" and events[-1]["gaussians"] > 0


def test_resuming_on_other_data_is_refused(unbroken, tmp_path):
    other = tiny_datasets.make_dataset(tmp_path, views=3)
    with pytest.raises(CheckpointError, match="was trained on other data"):
        run.train(other.root, unbroken[0], tiny_datasets.settings(), resume=True)


def test_signal_handlers_of_the_caller_are_restored_after_training(tiny, tmp_path):
    before = signal.getsignal(signal.SIGTERM), signal.getsignal(signal.SIGINT)
    run.train(tiny.root, tmp_path / "run", tiny_datasets.settings("train.iterations=2", "identity.iterations=0"))
    assert (signal.getsignal(signal.SIGTERM), signal.getsignal(signal.SIGINT)) == before


@pytest.fixture
def copied(unbroken, tmp_path):
    """A finished run that a test may change."""
    folder = tmp_path / "run"
    shutil.copytree(unbroken[0], folder)
    (folder / run_folder.EVALUATION_FILE).write_text("{}")
    return folder


def test_a_run_is_replaced_only_on_request(tiny, copied):
    before = contents(copied)
    with pytest.raises(CheckpointError, match="holds a run at step 70; add --resume to continue, or --overwrite"):
        run.train(tiny.root, copied, tiny_datasets.settings())
    torn = dict.fromkeys(checkpoint.GENERATIONS, b"torn")
    for file, content in torn.items():
        (copied / file).write_bytes(content)
    with pytest.raises(CheckpointError, match="cannot be read; add --overwrite to start again"):
        run.train(tiny.root, copied, tiny_datasets.settings())
    assert contents(copied) == {**before, **torn}


def test_overwriting_starts_again_without_files_of_the_old_run(tiny, copied):
    settings = tiny_datasets.settings("train.iterations=3", "identity.iterations=0")
    run.train(tiny.root, copied, settings, overwrite=True)
    assert run_folder.open_run(copied).config == settings and checkpoint.load(copied).iteration == 3
    assert [step for step, *_ in log_of(copied)] == [3]
    assert not (copied / run_folder.EVALUATION_FILE).exists()


@pytest.mark.parametrize("failure", [TrainingError("no start"), KeyboardInterrupt()], ids=["error", "signal"])
def test_a_run_is_kept_if_its_replacement_cannot_start(tiny, copied, monkeypatch, failure):
    def fail(*args):
        raise failure

    monkeypatch.setattr(run, "Trainer", fail)
    before = contents(copied)
    with pytest.raises((TrainingError, Interrupted), match=r"no start|is unchanged; repeat the same command"):
        run.train(tiny.root, copied, tiny_datasets.settings(), overwrite=True)
    assert contents(copied) == before


def test_resuming_without_a_run_starts_a_new_one_with_a_message(tiny, tmp_path, caplog):
    settings = tiny_datasets.settings("train.iterations=2", "identity.iterations=0")
    run.train(tiny.root, tmp_path / "run", settings, resume=True)
    assert [record.getMessage() for record in caplog.records if record.name == run.__name__] == [
        f"{tmp_path / 'run'}: no run to resume; starting a new one"
    ]
    assert checkpoint.load(tmp_path / "run").finished


def test_files_half_written_by_a_killed_run_are_removed(tiny, tmp_path):
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / f".{run_folder.RUN_FILE}.12ab.part").write_text("half")
    settings = tiny_datasets.settings("train.iterations=2", "identity.iterations=0")
    run.train(tiny.root, folder, settings)
    (folder / f".{checkpoint.CHECKPOINT_FILE}.12ab.part").write_text("half")
    run.train(tiny.root, folder, settings, resume=True)
    run.train(tiny.root, folder, settings, overwrite=True)
    assert {p.name for p in folder.iterdir()} == {run_folder.RUN_FILE, run_folder.LOG_FILE, *checkpoint.GENERATIONS}


@pytest.mark.parametrize("name", [run_folder.RUN_FILE, run_folder.LOG_FILE, checkpoint.CHECKPOINT_FILE])
def test_unwritable_files_are_named(tiny, tmp_path, monkeypatch, name):
    real = atomic_files.replacing

    def full(path, *previous):
        if path.name == name:
            raise OSError(28, "No space left on device")
        return real(path, *previous)

    monkeypatch.setattr(atomic_files, "replacing", full)
    if name == run_folder.LOG_FILE:
        monkeypatch.setattr(step_log, "open", full_disk, raising=False)
    settings = tiny_datasets.settings("train.iterations=2", "identity.iterations=0")
    with pytest.raises(CheckpointError, match="run.*cannot be .*written: .*No space left"):
        run.train(tiny.root, tmp_path / "run", settings)


def full_disk(*args, **kwargs):
    raise OSError(28, "No space left on device")
