"""Jobs in Slurm: a job that is returned to the queue while it trains loses nothing.

    .ci/slurm.sh pytest -m "nightly and cluster" tests/core/batch

starts a Slurm on this machine for these tests.
"""

import json
import os
import shutil
import subprocess
import sys
import time

import pytest

from r5dgs_core.train import checkpoint
from tests.support import tiny_datasets

pytestmark = [
    pytest.mark.cluster,
    pytest.mark.nightly,
    pytest.mark.skipif(shutil.which("sbatch") is None or "SLURM_CONF" not in os.environ, reason="needs Slurm"),
]

SETTINGS = (
    *tiny_datasets.SETTINGS,
    *("train.iterations=160", "train.checkpoint_every=40", "train.probe_every=0", "identity.iterations=2"),
)


def queue(form):
    return subprocess.run(["squeue", "--noheader", "--format", form], capture_output=True, text=True).stdout.split()


def wait_for(condition, seconds=300):
    for _ in range(seconds * 5):
        if condition():
            return
        time.sleep(0.2)
    raise AssertionError(f"{condition}: not within {seconds} s; queue: {queue('%i %T %R')}")


def test_a_job_that_is_returned_to_the_queue_loses_nothing(tiny, tmp_path):
    path, out = tmp_path / "captures.toml", tmp_path / "out"
    captures = [f'[[capture]]\ndata = "{tiny.root}"\nname = "{name}"\n' for name in ("stopped", "whole")]
    path.write_text(f"[defaults]\nset = {json.dumps(SETTINGS)}\ndevice = 'cpu'\n" + "".join(captures))
    command = [sys.executable, "-m", "r5dgs_core", "batch", str(path), "--out", str(out), "--cluster", "slurm"]
    with open(tmp_path / "batch.log", "w") as log:
        batch = subprocess.Popen([*command, "--jobs", "1", "--threads", "1"], stdout=log, stderr=log)
    try:
        wait_for((out / "stopped" / "checkpoint.pt").exists)
        (job,) = queue("%i")
        subprocess.run(["scontrol", "requeue", job], check=True)
        wait_for(lambda: queue("%T") != ["RUNNING"])
        step = checkpoint.load(out / "stopped").iteration
        assert 40 <= step < 160
        release = ["scontrol", "update", f"jobid={job}", "StartTime=now"]  # Slurm waits two minutes by default
        wait_for(lambda: queue("%T") == ["PENDING"])
        subprocess.run(release, check=True)
        assert batch.wait(400) == 0, (tmp_path / "batch.log").read_text()
    finally:
        batch.kill()
    assert len((out / "table.md").read_text().splitlines()) == 4
    steps = [json.loads(line)["iteration"] for line in (out / "stopped" / "log.jsonl").read_text().splitlines()]
    assert steps == list(range(10, 161, 10))
    stopped, whole = (checkpoint.load(out / name) for name in ("stopped", "whole"))
    assert stopped.finished and all((stopped.tensors[n] == t).all() for n, t in whole.tensors.items() if t.numel())
