"""Run folders and checkpoints: whole or not at all, and a damaged one is named instead of half-loaded."""

import dataclasses
import json
import os
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from r5dgs_core.config import config
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


def dataset(root="/data"):
    return SimpleNamespace(root=Path(root), digest="d1")


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


def test_a_run_is_opened_with_its_own_configuration(tmp_path):
    settings = config.load(None, ["train.seed=5", "losses.ssim=0.3"])
    made = checkpoint.create_run(tmp_path / "deep" / "run", dataset(), settings)
    opened = checkpoint.open_run(tmp_path / "deep" / "run")
    assert opened == made and opened.config == settings and opened.digest == "d1"
    assert set(opened.versions) >= {"r5dgs", "torch", "numpy"}
    text = json.loads((tmp_path / "deep" / "run" / checkpoint.RUN_FILE).read_text())
    assert text["platform"] == opened.platform and text["begun"].startswith("2")
    assert opened.platform["cores"] >= 1 and opened.platform["raster_threads"] >= 1 and opened.platform["system"]


def test_a_new_run_in_an_old_run_folder_starts_clean(tmp_path):
    checkpoint.create_run(tmp_path, dataset(), config.Config())
    checkpoint.save(tmp_path, STATE)
    (tmp_path / checkpoint.LOG_FILE).write_text("old\n")
    checkpoint.create_run(tmp_path, dataset(), config.Config())
    assert os.listdir(tmp_path) == [checkpoint.RUN_FILE]


def test_a_folder_with_other_files_does_not_change(tmp_path):
    (tmp_path / "thesis.tex").write_text("precious")
    with pytest.raises(CheckpointError, match="is not a run folder; choose another --out"):
        checkpoint.create_run(tmp_path, dataset(), config.Config())
    assert os.listdir(tmp_path) == ["thesis.tex"]
    with pytest.raises(CheckpointError, match="is not a run folder"):
        checkpoint.create_run(tmp_path / "thesis.tex", dataset(), config.Config())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda text: text[: len(text) // 2], "damaged"),
        (lambda text: "[]", "damaged"),
        (lambda text: json.dumps({**json.loads(text), "format_version": 2}), "expected format_version 1, got 2"),
        (lambda text: json.dumps({k: v for k, v in json.loads(text).items() if k != "digest"}), "damaged.*digest"),
    ],
)
def test_a_damaged_run_file_is_named(tmp_path, change, message):
    checkpoint.create_run(tmp_path, dataset(), config.Config())
    path = tmp_path / checkpoint.RUN_FILE
    path.write_text(change(path.read_text()))
    with pytest.raises(CheckpointError, match=f"run.json: {message}"):
        checkpoint.open_run(tmp_path)


def test_a_folder_that_is_not_a_run_raises(tmp_path):
    with pytest.raises(CheckpointError, match="not a run folder"):
        checkpoint.open_run(tmp_path)


def test_a_configuration_of_another_version_is_named_with_the_remedy(tmp_path):
    checkpoint.create_run(tmp_path, dataset(), config.Config())
    path = tmp_path / checkpoint.RUN_FILE
    text = json.loads(path.read_text())
    text["config"]["identity"]["dim"] = 16
    text["versions"]["r5dgs"] = "0.0.9"
    path.write_text(json.dumps(text))
    with pytest.raises(
        CheckpointError, match=r"run.json: .*made by 0\.0\.9.*identity\.dim: unknown key.*train again with --overwrite"
    ):
        checkpoint.open_run(tmp_path)


def test_a_folder_that_cannot_be_created_is_named(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(CheckpointError, match="file/run: cannot be created or written: .*choose another --out"):
        checkpoint.create_run(tmp_path / "file" / "run", dataset(), config.Config())
