"""Jobs of a batch on this machine: repetition of crashed ones, one table, and one error."""

import os
import signal
import sys
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import cloudpickle
import pytest
import submitit

from r5dgs_core.batch import jobs, table
from r5dgs_core.errors import BackendError, ConfigError, TrainingError

EVALUATION = {
    "train": {"gaussians": 900, "seconds": 12.4},
    "splits": {"val": {"rigid": {"psnr": 30.126}}, "test": {"rigid": {"psnr": None, "ssim": 0.91234, "miou": 0.5}}},
}


@dataclass(frozen=True)
class Pretended:
    """Job without training that may be killed or fail in its first attempts."""

    capture: SimpleNamespace
    out: Path
    killed: int = 0
    fails: int = 0

    def __call__(self):
        counter = self.out / f"{self.capture.name}.count"
        count = int(counter.read_text()) if counter.exists() else 0
        counter.write_text(str(count + 1))
        if count < self.killed:
            os.kill(os.getpid(), signal.SIGKILL)
        if count < self.killed + self.fails:
            raise RuntimeError("no luck")
        if self.capture.name == "empty":
            return {"failure": "no images", "repeat": False}
        return {"evaluation": EVALUATION}

    def with_least_used_gpu(self, others):
        return self


@pytest.fixture(scope="module", autouse=True)
def sent_to_jobs():
    """Send the class above by value, because the processes of jobs do not import this file."""
    module = sys.modules[__name__]
    cloudpickle.register_pickle_by_value(module)
    yield
    cloudpickle.unregister_pickle_by_value(module)


def make(out, name, **given):
    return Pretended(SimpleNamespace(name=name), out, **given)


def test_crashed_jobs_are_repeated_and_one_table_shows_all(tmp_path, monkeypatch):
    monkeypatch.setattr(jobs, "POLL_S", 0.1)
    monkeypatch.setattr(submitit.LocalJob, "_results_timeout_s", 0.5)
    events = []
    planned = [make(tmp_path, "killed", killed=1), make(tmp_path, "bad", fails=9), make(tmp_path, "empty")]
    start = jobs.executor("local", tmp_path / "jobs", {})
    with pytest.raises(TrainingError, match="2 of 3 captures failed, the first one (bad|empty): .*no (luck|images)"):
        jobs.run(planned, start, at_once=3, retries=1, progress=events.append)
    assert [int((tmp_path / f"{job.capture.name}.count").read_text()) for job in planned] == [2, 2, 1]
    lines = (tmp_path / "table.md").read_text().splitlines()
    assert lines[2] == "| killed | 900 | 12 | 30.13 | - | 0.9123 | 0.500 |  |"
    assert any(line.startswith("| bad | ") and "RuntimeError: no luck" in line for line in lines)
    assert any(line.endswith("| no images |") for line in lines)
    texts = [event["text"] for event in events]
    assert [texts.count(f"{job.capture.name}: running") for job in planned] == [2, 2, 1]
    assert texts.index("killed: submitted") < texts.index("killed: running") < texts.index("killed: finished")
    assert sum("tried again" in text for text in texts) == 2
    assert any(text.startswith("killed: the job ended without a result; it may") for text in texts)


class Waiting:
    """Submitted job that never starts."""

    cancelled = 0
    paths = SimpleNamespace(stdout=Path("missing"))

    def done(self):
        return False

    def cancel(self):
        self.cancelled += 1


def test_a_user_who_stops_cancels_the_jobs(tmp_path, monkeypatch):
    submitted = []

    def submit(job):
        submitted.append(Waiting())
        return submitted[-1]

    def stop(seconds):
        raise KeyboardInterrupt

    monkeypatch.setattr(jobs.time, "sleep", stop)
    planned = [make(tmp_path, name) for name in "abc"]
    with pytest.raises(KeyboardInterrupt):
        jobs.run(planned, SimpleNamespace(submit=submit), at_once=2, retries=0, progress=lambda event: None)
    assert [job.cancelled for job in submitted] == [1, 1]


def test_unknown_resources_are_refused(tmp_path):
    with pytest.raises(ConfigError, match="cluster: .*partitions"):
        jobs.executor("local", tmp_path, {"partitions": "gpu"})


def test_missing_programs_and_packages_are_named(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(BackendError, match="--cluster slurm: .*login node"):
        jobs.executor("slurm", tmp_path, {})
    monkeypatch.setitem(sys.modules, "submitit", None)
    with pytest.raises(BackendError, match=r"pip install 'r5dgs\[cluster\]'"):
        jobs.executor("local", tmp_path, {})


def test_the_terminal_shows_the_rows_of_the_table():
    result = {"captures": {"a": EVALUATION}, "failures": {"b": "no luck"}}
    assert table.to_rich(result).row_count == 2
