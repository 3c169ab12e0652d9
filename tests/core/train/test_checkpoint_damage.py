"""Damaged checkpoints and killed runs: nothing is accepted with changed numbers, and every run goes on bit for bit.

More flips and kills than a plain run makes:

    pytest tests/core/train/test_checkpoint_damage.py -m "nightly or not nightly" --bit-flips 1000 --kills 30
"""

import dataclasses
import io
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
import zipfile

import pytest
import torch

from r5dgs_core.bake import bake
from r5dgs_core.cli import main
from r5dgs_core.errors import CheckpointError
from r5dgs_core.train import checkpoint, checkpoint_content, checkpoint_file, run, run_folder
from tests.support import tiny_datasets

pytestmark = pytest.mark.heavy

OVERRIDES = (
    "train.iterations=30",
    "identity.iterations=4",
    "train.checkpoint_every=5",
    "train.probe_every=0",
    "densify.stop=0.7",  # Gaussians grow after 20 steps
)


@pytest.fixture(scope="module")
def reference(tiny, tmp_path_factory):
    """Folder of a run that nothing disturbed."""
    folder = tmp_path_factory.mktemp("undisturbed") / "run"
    run.train(tiny.root, folder, tiny_datasets.settings(*OVERRIDES))
    return folder


def assert_same(ours, theirs):
    """Two checkpoints are equal to the bit, but for the seconds that they took."""
    assert ours.tensors.keys() == theirs.tensors.keys()
    assert all(torch.equal(ours.tensors[name], tensor) for name, tensor in theirs.tensors.items())
    assert torch.equal(ours.observed, theirs.observed)
    for name in {field.name for field in dataclasses.fields(ours)} - {"tensors", "observed", "seconds"}:
        assert getattr(ours, name) == getattr(theirs, name), name


def steps(folder):
    lines = (folder / run_folder.LOG_FILE).read_text().splitlines()
    return [[json.loads(line)[key] for key in ("iteration", "loss", "gaussians")] for line in lines]


def flip(path, bit):
    data = bytearray(path.read_bytes())
    data[bit // 8] ^= 1 << bit % 8
    path.write_bytes(data)


def bits(data, count):
    """Numbers of bits of a zip, half of them anywhere, half outside the members' data."""
    draw = random.Random(5)
    covered = set()
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        for member in archive.infolist():
            start = data.index(member.filename.encode(), member.header_offset) + len(member.filename)
            padding = int.from_bytes(data[member.header_offset + 28 : member.header_offset + 30], "little")
            covered.update(range(start + padding, start + padding + member.file_size))
    headers = [place for place in range(len(data)) if place not in covered]
    anywhere = [draw.randrange(8 * len(data)) for _ in range(count - count // 2)]
    return anywhere + [8 * draw.choice(headers) + draw.randrange(8) for _ in range(count // 2)]


def unsealed(state):
    """The file of an earlier version, which had no digest."""
    buffer = io.BytesIO()
    content = {field.name: getattr(state, field.name) for field in dataclasses.fields(state)}
    torch.save({"format_version": checkpoint_content.FORMAT_VERSION, **content}, buffer)
    return buffer.getvalue()


@pytest.mark.default_cases("with a digest")
@pytest.mark.parametrize("sealed", [True, False], ids=["with a digest", "of an earlier version"])
def test_no_flipped_bit_changes_a_number(reference, tmp_path, pytestconfig, sealed):
    whole, path = checkpoint.load(reference), tmp_path / checkpoint.CHECKPOINT_FILE
    data = (reference / checkpoint.CHECKPOINT_FILE).read_bytes() if sealed else unsealed(whole)
    path.write_bytes(data)
    assert_same(checkpoint.load(tmp_path), whole)
    accepted = 0
    for bit in bits(data, pytestconfig.getoption("--bit-flips")):
        changed = bytearray(data)
        changed[bit // 8] ^= 1 << bit % 8
        path.write_bytes(changed)
        try:
            found = checkpoint.load(tmp_path)
        except CheckpointError as error:
            assert "damaged" in str(error) or "expected" in str(error)
        else:
            assert_same(found, whole)
            accepted += 1
    assert not (sealed and accepted)


def test_no_flipped_bit_of_a_directory_without_digest_changes_a_number(tmp_path):
    tensors = {"means": torch.arange(5.0), "ids": torch.arange(7)}
    buffer = io.BytesIO()
    torch.save(tensors, buffer)
    data, path = buffer.getvalue(), tmp_path / "checkpoint.pt"
    with zipfile.ZipFile(buffer) as archive:
        start = archive.start_dir
    for bit in range(8 * start, 8 * len(data), 5):  # of every byte; each field occurs once per member
        changed = bytearray(data)
        changed[bit // 8] ^= 1 << bit % 8
        path.write_bytes(changed)
        try:
            found = checkpoint_file.read(path)
        except checkpoint_file.DamagedError:
            continue
        assert all(torch.equal(found[name], tensor) for name, tensor in tensors.items()), bit


def interrupted(tiny, folder, at=20):
    """Train a run and stop it at a step, with two checkpoints in its folder."""

    def stop(event):
        if event.get("iteration") == at:
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(run.Interrupted):
        run.train(tiny.root, folder, tiny_datasets.settings(*OVERRIDES), progress=stop)
    return [(folder / name) for name in checkpoint.GENERATIONS]


@pytest.fixture(scope="module")
def stopped_run(tiny, tmp_path_factory):
    """Folder of an interrupted run with both of its checkpoints."""
    folder = tmp_path_factory.mktemp("stopped") / "run"
    interrupted(tiny, folder)
    return folder


@pytest.mark.default_cases("flipped")
@pytest.mark.parametrize("damage", ["flipped", "empty", "missing"])
def test_a_run_with_a_damaged_newest_checkpoint_continues_from_the_previous_one(
    tiny, reference, stopped_run, tmp_path, caplog, damage
):
    shutil.copytree(stopped_run, tmp_path / "run")
    newest, previous = (tmp_path / "run" / name for name in checkpoint.GENERATIONS)
    stopped = checkpoint.load(newest.parent).iteration
    if damage == "flipped":
        flip(newest, 8 * (newest.stat().st_size // 2))
    elif damage == "empty":
        newest.write_bytes(b"")
    else:
        newest.unlink()
    assert checkpoint.load(newest.parent).iteration < stopped
    if damage == "flipped":
        assert len(bake.bake(tiny_datasets.as_trained(run_folder.open_run(newest.parent))).gaussians.means) > 0
    caplog.clear()
    assert main.main(["train", str(tiny.root), "--out", str(newest.parent), "--resume", "--progress", "none"]) == 0
    told = [record.getMessage() for record in caplog.records if "previous checkpoint" in record.getMessage()]
    assert len(told) == 1 and str(newest) in told[0] and previous.name in told[0] and "\n" not in told[0]
    assert_same(checkpoint.load(newest.parent), checkpoint.load(reference))
    assert steps(newest.parent) == steps(reference)


def test_a_damaged_checkpoint_never_replaces_the_previous_one(tiny, tmp_path, monkeypatch):
    newest, previous = interrupted(tiny, tmp_path / "run")
    flip(newest, 8 * (newest.stat().st_size // 2))
    kept = checkpoint.load(newest.parent, mend=True)
    real = os.replace

    def die(source, target):
        if str(target).endswith(checkpoint.CHECKPOINT_FILE):
            raise KeyboardInterrupt  # between the two moves
        real(source, target)

    monkeypatch.setattr(os, "replace", die)
    with pytest.raises(KeyboardInterrupt):
        checkpoint.save(newest.parent, kept)
    monkeypatch.undo()
    assert not newest.exists()
    assert_same(checkpoint.load(newest.parent), kept)


def test_two_damaged_checkpoints_are_named_with_the_remedy(tiny, tmp_path):
    newest, previous = interrupted(tiny, tmp_path / "run")
    for path in (newest, previous):
        flip(path, 8000)
    with pytest.raises(CheckpointError, match=rf"{newest}: damaged.*{previous}: damaged.*--overwrite"):
        checkpoint.load(newest.parent)


STRANGE = {
    "sparse": lambda t: t.to_sparse(),
    "quantized": lambda t: torch.quantize_per_tensor(t, 0.1, 0, torch.quint8),
    "on no device": lambda t: t.to("meta"),
    "of stride 0": lambda t: t[:1, :1].expand(t.shape),
    "complex": lambda t: t.to(torch.complex64),
    "half as long": lambda t: t[: len(t) // 2],
    "with an axis more": lambda t: t[None],
    "whole numbers": lambda t: t.to(torch.int64),
    "half precision": lambda t: t.to(torch.float16),
    "a parameter": torch.nn.Parameter,
}


@pytest.mark.parametrize("kind", STRANGE)
@pytest.mark.parametrize("name", ["gaussians.means", "tracks.centers"])
@pytest.mark.filterwarnings("ignore:torch.quantize_per_tensor", "ignore:TypedStorage")
def test_a_tensor_that_does_not_fit_is_named(reference, tmp_path, kind, name):
    state = checkpoint.load(reference)
    changed = {**state.tensors, name: STRANGE[kind](state.tensors[name])}
    checkpoint.save(tmp_path, dataclasses.replace(state, tensors=changed))
    with pytest.raises(CheckpointError, match=r"checkpoint.pt: (damaged|'[a-z._]+': expected)"):
        checkpoint.load(tmp_path)


def test_a_mask_of_numbers_is_refused(reference, tmp_path):
    state = checkpoint.load(reference)
    changed = {**state.tensors, "held": torch.zeros(len(state.tensors["gaussians.means"]))}
    checkpoint.save(tmp_path, dataclasses.replace(state, tensors=changed))
    with pytest.raises(CheckpointError, match="'held': expected"):
        checkpoint.load(tmp_path)


@pytest.mark.parametrize("name", ["adam.means.exp_avg", "gradients.total", "generator"])
def test_a_state_that_does_not_fit_the_run_is_named_on_resuming(tiny, reference, tmp_path, name):
    state = checkpoint.load(reference)
    run_folder.create_run(tmp_path, run.datasets.read(tiny.root), tiny_datasets.settings(*OVERRIDES))
    changed = {**state.tensors, name: STRANGE["half as long"](state.tensors[name])}
    checkpoint.save(tmp_path, dataclasses.replace(state, tensors=changed, finished=False))
    with pytest.raises(CheckpointError, match=name.partition(".")[0]):
        run.train(tiny.root, tmp_path, tiny_datasets.settings(*OVERRIDES), resume=True)


@pytest.mark.nightly
def test_runs_killed_at_random_moments_resume_to_the_same_bits(tiny, reference, tmp_path, pytestconfig):
    draw = random.Random(11)
    options = [text for override in (*tiny_datasets.SETTINGS, *OVERRIDES) for text in ("--set", override)]
    span = None  # seconds from the first event to the end, by a run that is not killed
    for number in range(1 + pytestconfig.getoption("--kills")):
        folder = tmp_path / str(number)
        command = [sys.executable, "-m", "r5dgs_core.cli", "train", str(tiny.root), "--out", str(folder), *options]
        with subprocess.Popen([*command, "--progress", "json"], stdout=subprocess.PIPE) as process:
            assert process.stdout is not None
            process.stdout.readline()
            began = time.monotonic()
            if span is None:
                process.stdout.read()
                span = time.monotonic() - began
            else:
                time.sleep(draw.uniform(0, span))
                process.kill()
        if number:
            run.train(tiny.root, folder, tiny_datasets.settings(*OVERRIDES), resume=True)
        assert_same(checkpoint.load(folder), checkpoint.load(reference))
        assert steps(folder) == steps(reference)
        assert not list(folder.glob(".*"))
