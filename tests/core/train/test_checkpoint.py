"""Checkpoints: whole or not at all, and a damaged one is named instead of half-loaded."""

import dataclasses
import os

import pytest
import torch

from r5dgs_core.errors import CheckpointError
from r5dgs_core.train import checkpoint

ROWS = {"means": (3,), "quats": (4,), "log_scales": (3,), "opacity_logits": (), "sh": (1, 3), "sh_rest": (8, 3)}
STATE = checkpoint.Checkpoint(
    tensors={
        **{f"gaussians.{name}": torch.zeros(5, *row) for name, row in {**ROWS, "shading": (3,)}.items()},
        "gaussians.motion_ids": torch.zeros(5, dtype=torch.int64),
        "object_ids": torch.arange(2),
        "background": torch.zeros(1, 3),
        "generator": torch.Generator().get_state(),
        "light": torch.zeros(3),
        "tracks.times": torch.arange(3.0),
        "tracks.centers": torch.zeros(2, 3),
        "tracks.translations": torch.zeros(2, 3, 3),
        "tracks.rotvecs": torch.zeros(2, 3, 3),
        "tracks.base_quats": torch.zeros(2, 3, 4),
        "tracks.slope": torch.zeros(3),
        "tracks.casters": torch.zeros(0, dtype=torch.int64),
        "tracks.plane_normal": torch.zeros(3),
        "a": torch.arange(1000.0),
    },
    representation="tracks",
    iteration=7,
    entered=(0, 2),
    first_time=1,
    queue=(3, 1),
    running_loss=0.1,
    origin=(0.1, -2.0, 1e9),
    scale=0.3,
    observed=torch.tensor([[True, False, True]]),
    seconds=12.5,
)


class Gift:
    """Something that only pickle can bring along."""


def test_checkpoints_are_loaded_to_the_bit(tmp_path):
    checkpoint.save(tmp_path, STATE)
    loaded = checkpoint.load(tmp_path)
    assert loaded.tensors.keys() == STATE.tensors.keys()
    assert all(torch.equal(loaded.tensors[n], t) for n, t in STATE.tensors.items())
    assert torch.equal(loaded.observed, STATE.observed)
    for name in {f.name for f in dataclasses.fields(STATE)} - {"tensors", "observed"}:
        assert getattr(loaded, name) == getattr(STATE, name), name
    assert os.listdir(tmp_path) == [checkpoint.CHECKPOINT_FILE]


def test_objects_that_could_run_code_are_refused(tmp_path):
    torch.save({"format_version": 1, "gift": Gift()}, tmp_path / checkpoint.CHECKPOINT_FILE)
    with pytest.raises(CheckpointError, match=r"checkpoint.pt: damaged"):
        checkpoint.load(tmp_path)


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9, 0.999])
def test_a_truncated_checkpoint_is_named(tmp_path, share):
    checkpoint.save(tmp_path, STATE)
    path = tmp_path / checkpoint.CHECKPOINT_FILE
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(CheckpointError, match=r"checkpoint.pt: damaged"):
        checkpoint.load(tmp_path)


def test_foreign_files_and_other_versions_are_named(tmp_path):
    path = tmp_path / checkpoint.CHECKPOINT_FILE
    with pytest.raises(CheckpointError, match="no checkpoint yet"):
        checkpoint.load(tmp_path)
    path.write_bytes(b"not a checkpoint" * 10)
    with pytest.raises(CheckpointError, match="checkpoint.pt"):
        checkpoint.load(tmp_path)
    for content in ({"format_version": 999}, {"format_version": torch.ones(2)}, {"tensors": {}}, [1, 2]):
        torch.save(content, path)
        with pytest.raises(CheckpointError, match="checkpoint.pt: expected a checkpoint of format_version 1"):
            checkpoint.load(tmp_path)


NAMES = [field.name for field in dataclasses.fields(checkpoint.Checkpoint)]


@pytest.mark.parametrize("name", NAMES)
def test_a_missing_or_wrong_entry_is_named(tmp_path, name):
    checkpoint.save(tmp_path, STATE)
    path = tmp_path / checkpoint.CHECKPOINT_FILE
    whole = torch.load(path, weights_only=True)
    missing = {key: value for key, value in whole.items() if key != name}
    for content in (missing, *({**whole, name: value} for value in (b"x", [0.5, "y"], {"a": 1}))):
        torch.save(content, path)
        with pytest.raises(CheckpointError, match=f"checkpoint.pt: .*'{name}'.* found .*train again"):
            checkpoint.load(tmp_path)


@pytest.mark.parametrize("name", [name for name in STATE.tensors if name != "a"])
def test_a_missing_tensor_is_named(tmp_path, name):
    tensors = {n: t for n, t in STATE.tensors.items() if n != name}
    checkpoint.save(tmp_path, dataclasses.replace(STATE, tensors=tensors))
    with pytest.raises(CheckpointError, match=f"checkpoint.pt: expected the tensor '{name}'"):
        checkpoint.load(tmp_path)


@pytest.mark.parametrize(
    ("rows", "knots", "kind"), [(0, 3, torch.bool), (2, 3, torch.bool), (1, 2, torch.bool), (1, 3, torch.float32)]
)
def test_times_of_absence_that_fit_no_objects_are_named(tmp_path, rows, knots, kind):
    for folder, absent in (
        ("right", torch.zeros(1, 3, dtype=torch.bool)),
        ("wrong", torch.zeros(rows, knots, dtype=kind)),
    ):
        (tmp_path / folder).mkdir()
        state = dataclasses.replace(STATE, tensors={**STATE.tensors, "tracks.absent": absent})
        checkpoint.save(tmp_path / folder, state)
    assert "tracks.absent" in checkpoint.load(tmp_path / "right").tensors
    with pytest.raises(CheckpointError, match=r"'tracks.absent': expected"):
        checkpoint.load(tmp_path / "wrong")


@pytest.mark.parametrize("moment", ["save", "fsync", "replace"])
def test_the_old_checkpoint_survives_a_crash_while_the_new_one_is_written(tmp_path, monkeypatch, moment):
    checkpoint.save(tmp_path, STATE)

    def crash(*args):
        if moment == "save":
            args[1].write(b"half")
        raise OSError("power is gone")

    monkeypatch.setattr(torch if moment == "save" else os, moment, crash)
    with pytest.raises(CheckpointError, match="checkpoint.pt: cannot be written: power is gone.*--resume"):
        checkpoint.save(tmp_path, dataclasses.replace(STATE, iteration=8))
    monkeypatch.undo()
    assert os.listdir(tmp_path) == [checkpoint.CHECKPOINT_FILE]
    assert checkpoint.load(tmp_path).iteration == 7
    checkpoint.save(tmp_path, dataclasses.replace(STATE, iteration=9))  # and what the crash left is no obstacle
    assert checkpoint.load(tmp_path).iteration == 9
