"""Kills within a write, full disks, damaged data, numbers that explode: one clear error, and nothing is lost.

Kills and full disks happen to real processes.
"""

import json
import os
import signal
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from r5dgs_core.bake import bake
from r5dgs_core.cli import main
from r5dgs_core.data import dataset as datasets
from r5dgs_core.data import images
from r5dgs_core.errors import TrainingError
from r5dgs_core.train import checkpoint, run
from r5dgs_core.train.trainer import Trainer
from tests.support import processes, tiny_datasets
from tests.support.command_line import complaint

pytestmark = pytest.mark.heavy

OVERRIDES = (
    "train.iterations=30",
    "identity.iterations=4",
    "train.checkpoint_every=10",
    "train.probe_every=0",
    "densify.stop=0.7",  # Gaussians grow after 20 steps
)
# Code of a process that kills itself when it writes its second checkpoint.
KILLED_WITHIN_A_WRITE = """
import contextlib, os, signal, sys
from r5dgs_core.cli import main as cli
from r5dgs_core import atomic_files
moment, real, replace, seen = sys.argv[1], atomic_files.replacing, os.replace, []

def die():
    os.kill(os.getpid(), signal.SIGKILL)

class Torn:
    def __init__(self, stream):
        self.stream = stream
    def write(self, data):
        self.stream.write(data[: len(data) // 2])
        self.stream.flush()
        die()

@contextlib.contextmanager
def replacing(path, *previous):
    with real(path, *previous) as stream:
        if path.name == "checkpoint.pt":
            seen.append(path)
        yield Torn(stream) if moment == "half" and len(seen) == 2 else stream

def rename(source, target):
    second = len(seen) == 2 and str(target).endswith("checkpoint.pt")
    if second and moment == "between" or moment == "before" and str(target).endswith("checkpoint.previous.pt"):
        die()
    replace(source, target)
    if second and moment == "after":
        die()

atomic_files.replacing, os.replace = replacing, rename
cli.main(sys.argv[2:])
"""
# A command on a disk that takes no file larger than so many bytes.
FULL_DISK = """
import resource, sys
from r5dgs_core.cli import main as cli
from r5dgs_core.train import warm_up as warming
warming.warm_up(lambda stage: None)
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[1]), resource.RLIM_INFINITY))
sys.exit(cli.main(sys.argv[2:]))
"""
needs_limits = pytest.mark.skipif(sys.platform == "win32", reason="Windows has no limit on the size of files")


@pytest.fixture(scope="module")
def reference(tiny, tmp_path_factory):
    """The last checkpoint of a run that nothing disturbed."""
    folder = tmp_path_factory.mktemp("undisturbed") / "run"
    run.train(tiny.root, folder, tiny_datasets.settings(*OVERRIDES))
    return checkpoint.load(folder)


def arguments(root, folder):
    options = [text for override in (*tiny_datasets.SETTINGS, *OVERRIDES) for text in ("--set", override)]
    return ["train", str(root), "--out", str(folder), "--progress", "none", *options]


def resumed(root, folder):
    """The last checkpoint after the run has gone on to its end."""
    assert main.main(["train", str(root), "--out", str(folder), "--resume", "--progress", "none"]) == 0
    return checkpoint.load(folder)


def assert_equal(ours, theirs):
    assert ours.finished and ours.iteration == theirs.iteration and ours.tensors.keys() == theirs.tensors.keys()
    assert all(torch.equal(ours.tensors[name], tensor) for name, tensor in theirs.tensors.items())


@pytest.mark.default_cases("half-10")
@pytest.mark.parametrize(("moment", "kept"), [("half", 10), ("before", 10), ("between", 10), ("after", 20)])
def test_a_kill_during_a_write_leaves_a_complete_checkpoint(tiny, reference, tmp_path, moment, kept):
    folder = tmp_path / "run"
    killed = processes.run(KILLED_WITHIN_A_WRITE, moment, *arguments(tiny.root, folder))
    assert killed.returncode == -signal.SIGKILL
    assert checkpoint.load(folder).iteration == kept
    assert bool(list(folder.glob(".*.part"))) == (moment != "after")
    assert_equal(resumed(tiny.root, folder), reference)
    assert not list(folder.glob(".*.part"))


@pytest.mark.slow
@needs_limits
def test_a_run_stopped_by_a_full_disk_resumes_after_space_is_freed(tiny, reference, tmp_path):
    folder = tmp_path / "run"

    def stop(event):
        if event.get("iteration") == 10:
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(run.Interrupted):
        run.train(tiny.root, folder, tiny_datasets.settings(*OVERRIDES), progress=stop)
    path = folder / checkpoint.CHECKPOINT_FILE
    before = path.read_bytes()
    options = ["train", tiny.root, "--out", folder, "--resume", "--progress", "none"]
    full = processes.run(FULL_DISK, len(before) // 2, *options)
    assert full.returncode == 3
    assert "checkpoint.pt: cannot be written" in full.stderr and "the previous checkpoint is kept" in full.stderr
    assert "Traceback" not in full.stderr
    assert path.read_bytes() == before and not list(folder.glob(".*.part"))
    assert_equal(resumed(tiny.root, folder), reference)


@needs_limits
def test_a_full_disk_at_the_start_is_an_error_of_one_line(tiny, tmp_path):
    full = processes.run(FULL_DISK, 1000, *arguments(tiny.root, tmp_path / "run"))
    assert full.returncode == 3 and "Traceback" not in full.stderr
    assert f"{tmp_path / 'run'}: cannot be created or written" in full.stderr


@pytest.fixture
def data(tiny, tmp_path):
    """A copy of the data set that a test may damage."""
    copied = tmp_path / "data"
    for path in tiny.root.rglob("*"):
        if path.is_file():
            target = copied / path.relative_to(tiny.root)
            target.parent.mkdir(parents=True, exist_ok=True)
            os.link(path, target)
    return copied


def damage(path, content):
    """Replace a file without touching the one that it is a link to."""
    path.unlink()
    path.write_bytes(content)


@pytest.mark.parametrize(
    ("name", "share"),
    [
        *(("train/r_011.png", share) for share in (0.0, 0.02, 0.5, 0.9)),
        *(("object_mask/train/r_007.png", share) for share in (0.02, 0.9)),
        *(("val/r_001.png", share) for share in (0.0, 0.5)),
    ],
)
def test_a_truncated_file_is_named_before_anything_is_trained(data, tmp_path, capsys, name, share):
    path, folder = data / name, tmp_path / "run"
    whole = path.read_bytes()
    damage(path, whole[: int(share * len(whole))])
    given = [text.replace("train.probe_every=0", "train.probe_every=20") for text in arguments(data, folder)]
    assert str(path) in complaint(capsys, *given)
    assert not (folder / checkpoint.CHECKPOINT_FILE).exists()


def test_a_run_that_damaged_data_prevented_starts_once_the_data_is_repaired(data, reference, tmp_path, capsys):
    path, folder = data / "train/r_011.png", tmp_path / "run"
    whole = path.read_bytes()
    damage(path, whole[:-200])
    assert str(path) in complaint(capsys, *arguments(data, folder))
    damage(path, whole)
    assert_equal(resumed(data, folder), reference)


@pytest.mark.parametrize("key", ["transform_matrix", "file_path", "time", "camera_angle_x"])
def test_a_camera_file_that_lacks_a_key_is_named_with_frame_and_key(data, tmp_path, capsys, key):
    path = data / "transforms_train.json"
    content = json.loads(path.read_text())
    if key in content:
        del content[key]
    else:
        del content["frames"][3][key]
    damage(path, json.dumps(content).encode())
    line = complaint(capsys, *arguments(data, tmp_path / "run"))
    assert str(path) in line and f"'{key}'" in line
    assert key == "camera_angle_x" or "frame 3" in line
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_objects_of_a_single_mask_or_pixel_become_background_with_a_warning(data, tmp_path, caplog):
    for name in ("r_000.png", "r_010.png"):
        path = data / "object_mask/train" / name
        ids = images.read_raw(path)[..., 0].copy()
        ids[0, 0] = 7
        damage(path, b"")
        images.write_png(path, ids)
    first = data / "object_mask/train/r_010.png"
    ids = images.read_raw(first)[..., 0].copy()
    floor = np.argwhere(ids == 0)
    middle = floor[np.argmin(np.abs(floor - [28, 12]).sum(1))]
    ids[middle[0] - 3 : middle[0] + 3, middle[1] - 3 : middle[1] + 3] = 9
    damage(first, b"")
    images.write_png(first, ids)
    done = run.train(data, tmp_path / "run", tiny_datasets.settings(*OVERRIDES))
    assert "object 9" in caplog.text and "Remedy" in caplog.text
    scene = bake.bake(tiny_datasets.as_trained(done), datasets.read(data))
    assert [entry.id for entry in scene.objects] == [0, 1, 2]
    assert np.isfinite(scene.tracks.poses).all() and np.isfinite(scene.gaussians.means).all()


def spoil_image(trainer):
    for index in range(len(trainer.views)):
        trainer.targets.of(index)[3, 4, 1] = float("nan")


def spoil_camera(trainer):
    for view in trainer.views:
        view.camera.T_cam_world[0, 3] = float("nan")


@pytest.mark.default_cases("spoil_image-loss|gradient of")
@pytest.mark.parametrize(
    ("spoil", "found"), [(spoil_image, "loss|gradient of"), (spoil_camera, "cannot be drawn|camera|finite")]
)
def test_a_nan_stops_the_run_at_its_step_and_view_and_the_run_resumes_before_it(
    tiny, reference, tmp_path, monkeypatch, spoil, found
):
    real = Trainer.step

    def step(trainer):
        if trainer.iteration == 27:
            spoil(trainer)
        return real(trainer)

    monkeypatch.setattr(Trainer, "step", step)
    with pytest.raises(TrainingError, match=rf"step 27, view train/r_\d+: .*({found})") as error:
        run.train(tiny.root, tmp_path / "run", tiny_datasets.settings(*OVERRIDES))
    assert "the last checkpoint is kept" in str(error.value)
    monkeypatch.undo()
    assert checkpoint.load(tmp_path / "run").iteration == 20
    assert_equal(resumed(tiny.root, tmp_path / "run"), reference)


@pytest.mark.parametrize(
    "rate", ["log_scales=1e3", "means=1e38", "sh=1e30", "rotvecs=1e20", "translations=1e30", "background=1e38"]
)
def test_rates_that_explode_name_step_view_and_parameter(tiny, tmp_path, rate):
    settings = tiny_datasets.settings(*OVERRIDES, f"rates.{rate}", "train.checkpoint_every=1")
    name = rate.split("=")[0]
    inputs = {"log_scales": "scales", "rotvecs": "means"}
    with pytest.raises(TrainingError, match=rf"step \d+.*{inputs.get(name, name)}.*the last checkpoint is kept"):
        run.train(tiny.root, tmp_path / "run", settings)
    path = tmp_path / "run" / checkpoint.CHECKPOINT_FILE
    if path.exists():  # whatever was kept can be gone on from
        kept = checkpoint.load(tmp_path / "run")
        assert all(t.isfinite().all() for t in kept.tensors.values() if t.is_floating_point())


def test_losing_every_gaussian_is_an_error(tiny, tmp_path):
    settings = tiny_datasets.settings(*OVERRIDES, "densify.prune_opacity=0.999")
    with pytest.raises(TrainingError, match="step 20: every Gaussian has become too faint"):
        run.train(tiny.root, tmp_path / "run", settings)
    assert checkpoint.load(Path(tmp_path / "run")).iteration == 10
