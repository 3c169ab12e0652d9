"""Several processes train a run as one process does, and fail or stop with one message."""

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch

from r5dgs_core.cli import main
from r5dgs_core.cli.exit_status import ExitStatus
from r5dgs_core.data import dataset, memory
from r5dgs_core.errors import ConfigError
from r5dgs_core.raster import cuda
from r5dgs_core.train import checkpoint, devices, workers
from tests.support import processes, tiny_datasets
from tests.support.command_line import complaint

pytestmark = pytest.mark.heavy
needs_proc = pytest.mark.skipif(not os.path.isdir("/proc/self"), reason="needs /proc")

SHORT = (
    *tiny_datasets.SETTINGS,
    *("train.iterations=24", "densify.stop=0.9", "identity.iterations=2", "train.probe_every=10", "train.log_every=1"),
)
# Code of one of two processes, started as `torch.distributed.run` does.
PROCESS = """
import os, sys
rank, port = sys.argv[1:3]
os.environ.update(RANK=rank, LOCAL_RANK=rank, WORLD_SIZE="2", LOCAL_WORLD_SIZE="2")
os.environ.update(MASTER_ADDR="127.0.0.1", MASTER_PORT=port)
from r5dgs_core.cli import main
sys.exit(main.main(sys.argv[3:]))
"""

# The same with twice the penalties in the second process.
OTHER_PENALTIES = PROCESS.replace(
    "sys.exit",
    """from r5dgs_core.train import trainer
penalties = trainer.Trainer.penalties
if rank == "1":
    trainer.Trainer.penalties = lambda run: [term if term is None else 2 * term for term in penalties(run)]
sys.exit""",
)
# Code that prints gradients in one of two processes which have computed different ones.
GRADIENTS = """
import os, sys
rank, port = sys.argv[1:3]
os.environ.update(RANK=rank, WORLD_SIZE="2", MASTER_ADDR="127.0.0.1", MASTER_PORT=port)
import torch
from r5dgs_core.train import workers
parameters = [torch.zeros(size, requires_grad=True) for size in ((2, 2), (3,), (1,))]
own = [torch.full((2, 2), 1.5), None, torch.ones(1).expand(1)] if rank == "0" else [None, torch.ones(3), None]
with workers.joined() as group:
    found = group.of_leader(parameters, own)
    print([gradient if gradient is None else gradient.tolist() for gradient in found])
    print(group.of_leader(parameters, [None] * 3 if rank == "0" else own))
"""
# Code that prints the threads of one of two processes after it has left the other one.
LEAVES = """
import os, sys
rank, port = sys.argv[1:3]
os.environ.update(RANK=rank, WORLD_SIZE="2", MASTER_ADDR="127.0.0.1", MASTER_PORT=port)
from r5dgs_core.train import workers
with workers.joined() as group:
    import torch._dynamo
    assert group.broadcast("state") == "state"
for task in os.listdir("/proc/self/task"):
    print(open(f"/proc/self/task/{task}/comm").read().strip())
"""


def arguments(root, out, *settings, more=()):
    given = [text for setting in settings for text in ("--set", setting)]
    return ["train", str(root), "--out", str(out), "--device", "cpu", "--progress", "none", *given, *more]


def in_two_processes(*given, second=None, code=PROCESS):
    """Run both processes with the same arguments, or the second one with others."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    with ThreadPoolExecutor() as pool:
        return list(pool.map(lambda rank: processes.run(code, rank, port, *(given, second or given)[rank]), (0, 1)))


def losses(folder):
    return [json.loads(line)["loss"] for line in (folder / "log.jsonl").read_text().splitlines()]


def assert_same_run(first, second):
    assert losses(first) == pytest.approx(losses(second), rel=1e-5)
    one, two = checkpoint.load(first), checkpoint.load(second)
    assert one.finished and two.finished
    assert len(one.tensors["gaussians.means"]) == len(two.tensors["gaussians.means"])


@pytest.fixture(scope="module")
def alone(tiny, tmp_path_factory):
    """Run of one process with two views per step."""
    out = tmp_path_factory.mktemp("alone") / "run"
    assert main.main(arguments(tiny.root, out, *SHORT, "train.batch=2")) == 0
    return out


@pytest.fixture(scope="module")
def together(tiny, tmp_path_factory):
    """The same run by two processes, and the finished processes."""
    out = tmp_path_factory.mktemp("together") / "run"
    return out, in_two_processes(*arguments(tiny.root, out, *SHORT))


@pytest.mark.slow
def test_two_processes_train_as_one_with_two_views_per_step(alone, together):
    out, (first, second) = together
    assert (first.returncode, second.returncode) == (0, 0), first.stderr + second.stderr
    assert second.stdout + second.stderr == ""
    assert_same_run(out, alone)
    assert len(checkpoint.load(out).tensors["gaussians.means"]) > 900  # of 1010 at most before densification


@pytest.mark.slow
def test_two_processes_train_a_field_as_one(tiny, tmp_path):
    field = ("train.representation=field", "field.width=32", "field.place_steps=3", "field.trd_steps=2", *SHORT)
    assert main.main(arguments(tiny.root, tmp_path / "one", *field, "train.batch=2")) == 0
    first, second = in_two_processes(*arguments(tiny.root, tmp_path / "two", *field))
    assert (first.returncode, second.returncode) == (0, 0), first.stderr + second.stderr
    assert_same_run(tmp_path / "two", tmp_path / "one")


def test_all_processes_get_the_gradients_of_the_leading_one():
    for ended in in_two_processes(code=GRADIENTS):
        assert ended.returncode == 0, ended.stderr
        assert ended.stdout == "[[[1.5, 1.5], [1.5, 1.5]], None, [1.0]]\n[None, None, None]\n"


@pytest.mark.slow
def test_the_penalties_of_the_leading_process_count(tiny, alone, tmp_path):
    ended = in_two_processes(*arguments(tiny.root, tmp_path / "run", *SHORT), code=OTHER_PENALTIES)
    assert [process.returncode for process in ended] == [0, 0], ended[0].stderr + ended[1].stderr
    assert_same_run(tmp_path / "run", alone)


def test_one_process_reports_a_failure(tmp_path):
    ended = in_two_processes(*arguments(tmp_path / "missing", tmp_path / "run"))
    assert [process.returncode for process in ended] == [3, 3]
    assert ended[0].stderr.startswith("r5dgs: ") and "missing" in ended[0].stderr
    assert "r5dgs:" not in ended[1].stderr and "Traceback" not in ended[1].stderr
    assert not (tmp_path / "run").exists()


@needs_proc
def test_no_thread_of_the_group_is_left():
    for ended in in_two_processes(code=LEAVES):
        assert ended.returncode == 0, ended.stderr
        assert "gloo" not in ended.stdout


def test_the_images_of_all_processes_must_fit_into_the_memory_of_the_machine(tiny, tmp_path, monkeypatch, capsys):
    needed = memory.at_once(dataset.read(tiny.root))
    monkeypatch.setattr(memory, "available", lambda: 1.5 * needed)
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "2")
    assert "in each of 2 processes" in complaint(capsys, *arguments(tiny.root, tmp_path / "run", *SHORT))
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_processes_with_other_data_are_refused(tiny, copied, tmp_path):
    (copied / "train" / "r_000.png").write_bytes((copied / "train" / "r_001.png").read_bytes())
    first, second = (arguments(root, tmp_path / "run", *SHORT) for root in (tiny.root, copied))
    ended = in_two_processes(*first, second=second)
    assert all(process.returncode == ExitStatus.ERROR for process in ended)
    assert "differs from the data of the first process" in ended[1].stderr
    assert "Traceback" not in ended[0].stderr + ended[1].stderr


def test_settings_are_repeated_or_left_out_to_resume(tiny, alone, capsys):
    again = arguments(tiny.root, alone, *SHORT, "train.batch=2", more=["--resume"])
    assert main.main(again) == 0
    assert "train.seed" in complaint(capsys, *again, "--seed", "3", status=ExitStatus.USAGE)


def test_processes_share_the_views_of_a_step_in_order():
    group = [workers.Workers(rank, 3) for rank in range(3)]
    assert [one.share("abcdef") for one in group] == [["a", "d"], ["b", "e"], ["c", "f"]]
    group[0].check_batch(6)
    with pytest.raises(ConfigError, match="3 processes cannot share 4 views"):
        group[0].check_batch(4)


def test_the_command_that_resumes_starts_as_many_processes(monkeypatch):
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "4")
    assert workers.launch_command(1, ["train", "a b"]) == "r5dgs train 'a b'"
    assert workers.launch_command(4, ["train", "a b"]) == "torchrun --nproc-per-node 4 -m r5dgs_core train 'a b'"
    monkeypatch.setenv("GROUP_WORLD_SIZE", "2")
    assert "--nnodes 2 " in workers.launch_command(8, ["train"])


class Launched:
    """Two processes started by `torch.distributed.run`, with the messages of each in a file."""

    def __init__(self, folder, *given, restarts=0):
        self.logs = folder / "logs"
        options = ["--nproc-per-node", "2", "--max-restarts", str(restarts), "--redirects", "3"]
        start = [sys.executable, "-m", "torch.distributed.run", *options, "--log-dir", str(self.logs)]
        with open(folder / "launcher.log", "w") as log:
            self.launcher = subprocess.Popen([*start, "-m", "r5dgs_core", *given], stdout=log, stderr=log)

    def pid(self, rank):
        listed = subprocess.run(["pgrep", "-P", str(self.launcher.pid)], capture_output=True, text=True).stdout
        for pid in map(int, listed.split()):
            with open(f"/proc/{pid}/environ", "rb") as file:
                if f"RANK={rank}".encode() in file.read().split(b"\0"):
                    return pid
        raise AssertionError(f"no process of rank {rank} in {listed}")

    def messages(self, rank, attempt=0):
        (path,) = self.logs.glob(f"*/attempt_{attempt}/{rank}/stderr.log")
        return path.read_text()


def until_checkpoint(out):
    for _ in range(1200):
        if (out / "checkpoint.pt").exists():
            return
        time.sleep(0.1)
    raise AssertionError(f"{out}: no checkpoint")


LONG = (
    *tiny_datasets.SETTINGS,
    *("train.iterations=300", "train.checkpoint_every=40", "identity.iterations=2", "train.probe_every=0"),
)


@pytest.mark.slow
@pytest.mark.parametrize("grows", ["densify.start=100", "densify.start=100000"])
def test_torchrun_trains_as_one_process(tiny, tmp_path, grows):
    assert main.main(arguments(tiny.root, tmp_path / "one", *LONG, grows, "train.batch=2")) == 0
    assert Launched(tmp_path, *arguments(tiny.root, tmp_path / "two", *LONG, grows)).launcher.wait(300) == 0
    assert_same_run(tmp_path / "two", tmp_path / "one")


@pytest.mark.slow
@needs_proc
@pytest.mark.parametrize("rank", [0, 1])
def test_a_killed_process_loses_no_run(tiny, tmp_path, rank):
    out = tmp_path / "run"
    launched = Launched(tmp_path, *arguments(tiny.root, out, *LONG))
    until_checkpoint(out)
    os.kill(launched.pid(rank), signal.SIGKILL)
    assert launched.launcher.wait(60) != 0
    assert launched.messages(1 - rank).startswith("r5dgs: another process of this run has ended")
    assert "Traceback" not in launched.messages(1 - rank)
    assert in_two_processes(*arguments(tiny.root, out, more=["--resume"]))[0].returncode == 0
    whole = tmp_path / "whole"
    assert main.main(arguments(tiny.root, whole, *LONG, "train.batch=2")) == 0
    assert_same_run(out, whole)


@pytest.mark.slow
@needs_proc
def test_torchrun_restarts_a_run_from_its_last_checkpoint(tiny, tmp_path):
    out = tmp_path / "run"
    launched = Launched(tmp_path, *arguments(tiny.root, out, *LONG, more=["--resume"]), restarts=2)
    until_checkpoint(out)
    shutil.copy(out / "checkpoint.pt", tmp_path)
    os.kill(launched.pid(1), signal.SIGKILL)
    assert launched.launcher.wait(120) == 0
    assert checkpoint.load(out).finished
    assert launched.messages(0, attempt=1) == ""
    assert len(losses(out)) == 30  # every logged step once


@pytest.mark.slow
@needs_proc
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_stops_all_processes_after_a_checkpoint(tiny, tmp_path, number):
    out = tmp_path / "run"
    launched = Launched(tmp_path, *arguments(tiny.root, out, *LONG))
    until_checkpoint(out)
    launched.launcher.send_signal(number)
    launched.launcher.wait(60)
    said = launched.messages(0)
    assert said.startswith("r5dgs: stopped at step ") and "torchrun --nproc-per-node 2" in said
    assert launched.messages(1) == ""
    step = checkpoint.load(out).iteration
    assert f"step {step};" in said and step % 40 != 0


def test_each_process_takes_a_gpu_of_its_own(monkeypatch):
    monkeypatch.setenv("LOCAL_RANK", "1")
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setattr(torch.cuda, "set_device", lambda device: None)
    monkeypatch.setattr(cuda, "why_unavailable", lambda device, dtype: None)
    assert devices.select("cuda") == devices.select("auto") == torch.device("cuda", 1)
    assert devices.select("cuda:0") == torch.device("cuda", 0)
