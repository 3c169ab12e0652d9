"""The command ``r5dgs batch`` trains, bakes and evaluates, and continues what has begun."""

import json
import os
import shutil
from types import SimpleNamespace

import pytest

from r5dgs_core.batch import capture_job, captures, jobs
from r5dgs_core.bench import process
from r5dgs_core.cli import main
from r5dgs_core.cli.exit_status import ExitStatus
from r5dgs_core.errors import TrainingError
from r5dgs_core.scene import scene_file
from r5dgs_core.train import checkpoint
from tests.support import tiny_datasets
from tests.support.command_line import complaint

pytestmark = pytest.mark.heavy

SHORT = (*tiny_datasets.SETTINGS, "train.iterations=20", "train.probe_every=0", "identity.iterations=2")


def write(path, data, *settings):
    path.write_text(f"[defaults]\nset = {json.dumps([*SHORT, *settings])}\n[[capture]]\ndata = {json.dumps(str(data))}")
    return path


def test_a_fault_in_the_file_is_one_error(tmp_path, capsys):
    path = tmp_path / "captures.toml"
    path.write_text("[[capture]]\ndata = 'nowhere'\n")
    assert "nowhere is not a folder" in complaint(capsys, "batch", str(path), "--out", str(tmp_path / "out"))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("cluster", "resources", "named"),
    [
        ("local", "gpus_per_node = 2", "gpus_per_node = 2"),
        ("local", "local_gpus_per_node = 4\ngpus_per_node = 1", "local_gpus_per_node = 4"),
        ("slurm", "slurm_gpus_per_task = 2", "slurm_gpus_per_task = 2"),
        ("slurm", "tasks_per_node = 2", "tasks_per_node = 2"),
        ("slurm", "slurm_ntasks_per_node = 2", "slurm_ntasks_per_node = 2"),
    ],
)
def test_several_gpus_or_processes_of_a_job_are_refused(tiny, tmp_path, capsys, cluster, resources, named):
    path = write(tmp_path / "captures.toml", tiny.root)
    path.write_text(f"{path.read_text()}\n[cluster]\n{resources}\n")
    said = complaint(capsys, "batch", str(path), "--out", str(tmp_path / "out"), "--cluster", cluster)
    assert f"{path}: cluster: {named}: expected at most 1" in said
    assert not (tmp_path / "out").exists()


def test_resources_of_other_clusters_are_not_checked(tmp_path):
    captures.check_resources(tmp_path, {"gpus_per_node": 4, "local_gpus_per_node": 1, "slurm_nodes": 2}, "local")


@pytest.mark.parametrize(
    ("resources", "own", "seen"),
    [({}, None, None), ({}, "1,2", "1,2"), ({}, "", ""), ({"gpus_per_node": 1}, "2", "0")],
)
def test_local_jobs_see_the_gpus_of_the_command_unless_they_request_some(tmp_path, monkeypatch, resources, own, seen):
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    if own is not None:
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", own)
    capture = SimpleNamespace(name="a", data=tmp_path, arguments=(), config=tiny_datasets.settings())
    job = capture_job.CaptureJob(capture, tmp_path, gpus=capture_job.visible_gpus("local", resources))
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "0" if resources else "")  # as submitit sets it
    found = []

    def run(*given):
        found.append(os.environ.get("CUDA_VISIBLE_DEVICES"))
        return SimpleNamespace(status=3, complaint="no images")

    monkeypatch.setattr(process, "run", run)
    assert "no images" in job()["failure"]
    assert found == [seen]
    assert capture_job.visible_gpus("slurm", {}) is None


def test_local_jobs_at_the_same_time_use_different_gpus(tmp_path, monkeypatch):
    monkeypatch.setattr(jobs, "POLL_S", 0.0)
    used, ended = [], {"a": 2, "b": 1, "c": 1, "d": 1, "e": 1}  # polls until the end

    def submit(job):
        used.append(job.gpus)
        polls = iter([False] * ended[job.capture.name] + [True])
        given = {"exception": lambda: None, "result": lambda: {"failure": "no images", "repeat": False}}
        return SimpleNamespace(paths=SimpleNamespace(stdout=tmp_path), done=lambda: next(polls), **given)

    def job(name, device):
        config = tiny_datasets.settings(f"train.device={device}")
        capture = SimpleNamespace(name=name, data=tmp_path, arguments=(), config=config)
        return capture_job.CaptureJob(capture, tmp_path, gpus="all", selectable_gpus=("2", "5"))

    planned = [job("a", "auto"), job("b", "cuda"), job("c", "auto"), job("d", "cuda:1"), job("e", "cpu")]
    with pytest.raises(TrainingError, match="5 of 5"):
        jobs.run(planned, SimpleNamespace(submit=submit), at_once=2, retries=0, progress=lambda event: None)
    assert used == ["2", "5", "5", "all", "all"]


@pytest.mark.parametrize(
    ("resources", "own", "listed", "found"),
    [
        ({}, None, 2, ("0", "1")),
        ({"gpus_per_node": 1}, None, 2, ("0", "1")),
        ({}, "3,GPU-5", 4, ("3", "GPU-5")),
        ({}, "", 2, ()),
        ({"gpus_per_node": 2}, None, 2, ()),
        ({"gpus_per_node": 1, "local_gpus_per_node": 0}, None, 2, ()),
        ({}, None, None, ()),
    ],
)
def test_jobs_may_use_the_gpus_of_the_command_one_by_one(tmp_path, monkeypatch, resources, own, listed, found):
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    if own is not None:
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", own)
    monkeypatch.setenv("PATH", str(tmp_path))
    if listed is not None:
        lines = "".join(f"echo 'GPU {k}: NVIDIA (UUID: GPU-{k})'\necho '  MIG 1g'\n" for k in range(listed))
        (tmp_path / "nvidia-smi").write_text(f"#!/bin/sh\n{lines}")
        (tmp_path / "nvidia-smi").chmod(0o755)
    assert capture_job.separate_gpus("local", resources) == found
    assert capture_job.separate_gpus("slurm", resources) == ()


@pytest.mark.parametrize(
    ("status", "repeated"),
    [(-9, True), (1, True), (ExitStatus.DEFECT, True), (ExitStatus.USAGE, False), (ExitStatus.ERROR, False)],
)
def test_only_commands_that_are_killed_or_crash_are_repeated(tmp_path, monkeypatch, status, repeated):
    capture = SimpleNamespace(name="a", data=tmp_path, arguments=(), config=tiny_datasets.settings())
    monkeypatch.setattr(process, "run", lambda *given: process.EndedProcess(status, "no luck", None, 1.0, None, None))
    assert capture_job.CaptureJob(capture, tmp_path)()["repeat"] is repeated


@pytest.mark.slow
def test_a_batch_ends_with_scene_and_figures_and_begins_nothing_twice(tiny, tmp_path, capsys):
    path, out = write(tmp_path / "captures.toml", tiny.root), tmp_path / "out"
    command = ["batch", str(path), "--out", str(out), "--progress", "none", "--threads", "1"]
    assert main.main(command) == 0
    name = tiny.root.name
    assert checkpoint.load(out / name).iteration == 20
    assert len(scene_file.read(out / f"{name}.r5dgs").objects) == 3
    result = json.loads((out / "batch.json").read_text())
    assert result["captures"][name]["splits"]["val"]["rigid"]["psnr"] > 10 and result["failures"] == {}
    assert name in capsys.readouterr().out
    own = {name + suffix for suffix in captures.SUFFIXES}
    assert {path.name for path in out.iterdir()} == own | {"batch.json", "table.md", "jobs"}
    stamp = (out / f"{name}.r5dgs").stat().st_mtime_ns
    assert main.main(command) == 0
    assert (out / f"{name}.r5dgs").stat().st_mtime_ns == stamp
    other = shutil.copytree(tiny.root, tmp_path / "other" / name)
    (other / "train" / "r_000.png").write_bytes((other / "train" / "r_001.png").read_bytes())
    write(path, other)
    assert main.main(command) == ExitStatus.ERROR
    assert "was trained on other data than" in (out / "batch.json").read_text()
    write(path, tiny.root, "train.seed=5")
    assert main.main(command) == ExitStatus.ERROR
    assert "was trained with other values of train.seed" in (out / "batch.json").read_text()
