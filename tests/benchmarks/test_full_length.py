"""The tables of full-length runs, from the folders of benchmarks."""

import json

import pytest

from r5dgs_core.bench.benchmark import RESULT_FILE
from r5dgs_core.data import dataset as datasets
from r5dgs_core.train import run_folder
from tests.support import benchmark_modules, tiny_datasets

FIELD = ("train.representation='field'", "train.iterations=40")


@pytest.fixture
def tables(monkeypatch):
    with benchmark_modules.importing(monkeypatch) as load:
        yield load("training.full_length")


def bench(folder, tiny, *overrides, finished):
    run = folder / "room" / "r5dgs_seed0"
    run_folder.create_run(run, datasets.read(tiny.root), tiny_datasets.settings(*FIELD, *overrides))
    events = [{"iteration": n, "loss": 1.0, **({"val_psnr": 20.0 + n} if n % 20 == 0 else {})} for n in (10, 20, 40)]
    lines = "".join(json.dumps(event) + "\n" for event in events)
    (run / run_folder.LOG_FILE).write_text(lines + '{"iteration": 50, "val_ps')  # a kill cut the last line
    if finished:
        common = {"scene": "room", "variant": "r5dgs", "seed": 0, "train": {"cpu_seconds": 90.0}}
        splits = {
            mode: {"val": {"psnr": 35.0}, "test": {"psnr": psnr}}
            for mode, psnr in (("standard", 26.0), ("rigid", 28.5))
        }
        results = [{**common, "mode": mode, "splits": found} for mode, found in splits.items()]
        (folder / RESULT_FILE).write_text(json.dumps({"results": results}))
    return folder


def test_the_tables_name_networks_and_measurements_of_finished_and_unfinished_runs(tables, tiny, tmp_path):
    done = bench(tmp_path / "a", tiny, "field.size='small'", finished=True)
    begun = bench(tmp_path / "b", tiny, "field.size='complex'", "field.width=160", finished=False)
    rows = tables.rows(done) + tables.rows(begun)
    assert [row["networks"] for row in rows] == ["4 x 128, 5 x 64", "8 x 160, 10 x 160"]
    lines = tables.quality(rows).splitlines()
    assert lines[0].endswith("| CPU min | val | test `standard` | test `rigid` |") and len(lines) == 3
    assert lines[2] == "| room | r5dgs_seed0 | - | 4 x 128, 5 x 64 | 40 | 1.5 | 35.0 | 26.0 | 28.5 |"
    assert tables.against_steps(rows).splitlines()[2:] == [
        "| room | r5dgs_seed0 | 4 x 128, 5 x 64 | 40.0 | 60.0 |",
        "| room | r5dgs_seed0 | 8 x 160, 10 x 160 | 40.0 | 60.0 |",
    ]
