"""Run folders: a folder with other files is never changed, and a damaged run file is named."""

import json
import os
from pathlib import Path
from types import SimpleNamespace

import pytest

from r5dgs_core.config import config
from r5dgs_core.errors import CheckpointError
from r5dgs_core.train import checkpoint, run_folder


def dataset(root="/data"):
    return SimpleNamespace(root=Path(root), digest="d1")


def test_a_run_is_opened_with_its_own_configuration(tmp_path):
    settings = config.load(None, ["train.seed=5", "losses.ssim=0.3"])
    made = run_folder.create_run(tmp_path / "deep" / "run", dataset(), settings)
    opened = run_folder.open_run(tmp_path / "deep" / "run")
    assert opened == made and opened.config == settings and opened.digest == "d1"
    assert set(opened.versions) >= {"r5dgs", "torch", "numpy"}
    text = json.loads((tmp_path / "deep" / "run" / run_folder.RUN_FILE).read_text())
    assert text["platform"] == opened.platform and text["begun"].startswith("2")
    assert opened.platform["cores"] >= 1 and opened.platform["raster_threads"] >= 1 and opened.platform["system"]


def test_a_new_run_in_an_old_run_folder_starts_clean(tmp_path):
    run_folder.create_run(tmp_path, dataset(), config.Config())
    for name in (*checkpoint.GENERATIONS, run_folder.LOG_FILE):
        (tmp_path / name).write_text("old\n")
    run_folder.create_run(tmp_path, dataset(), config.Config())
    assert os.listdir(tmp_path) == [run_folder.RUN_FILE]


def test_a_folder_with_other_files_does_not_change(tmp_path):
    (tmp_path / "thesis.tex").write_text("precious")
    with pytest.raises(CheckpointError, match="is not a run folder; choose another --out"):
        run_folder.create_run(tmp_path, dataset(), config.Config())
    assert os.listdir(tmp_path) == ["thesis.tex"]
    with pytest.raises(CheckpointError, match="is not a run folder"):
        run_folder.create_run(tmp_path / "thesis.tex", dataset(), config.Config())


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
    run_folder.create_run(tmp_path, dataset(), config.Config())
    path = tmp_path / run_folder.RUN_FILE
    path.write_text(change(path.read_text()))
    with pytest.raises(CheckpointError, match=f"run.json: {message}"):
        run_folder.open_run(tmp_path)


def test_a_folder_that_is_not_a_run_raises(tmp_path):
    with pytest.raises(CheckpointError, match="not a run folder"):
        run_folder.open_run(tmp_path)


def test_a_configuration_of_another_version_is_named_with_the_remedy(tmp_path):
    run_folder.create_run(tmp_path, dataset(), config.Config())
    path = tmp_path / run_folder.RUN_FILE
    text = json.loads(path.read_text())
    text["config"]["identity"]["dim"] = 16
    text["versions"]["r5dgs"] = "0.0.9"
    path.write_text(json.dumps(text))
    with pytest.raises(
        CheckpointError, match=r"run.json: .*made by 0\.0\.9.*identity\.dim: unknown key.*train again with --overwrite"
    ):
        run_folder.open_run(tmp_path)


def test_a_folder_that_cannot_be_created_is_named(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(CheckpointError, match="file/run: cannot be created or written: .*choose another --out"):
        run_folder.create_run(tmp_path / "file" / "run", dataset(), config.Config())
