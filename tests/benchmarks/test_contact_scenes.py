"""Scenes with contacts: rows of the benchmark from a finished run."""

import json
import shutil

import pytest

from r5dgs_core.config import config
from tests.support import benchmark_modules

pytestmark = pytest.mark.heavy


@pytest.mark.slow
def test_a_scene_gets_rows_and_a_summary(tiny, trained, tmp_path, monkeypatch):
    data = tmp_path / "00"
    shutil.copytree(tiny.root, data)
    names = [one["name"] for one in json.loads((data / "objects.json").read_text()).values()]
    bodies = [{"name": name, "friction": 0.3, "restitution": 0.5} for name in names]
    (data / "material.json").write_text(json.dumps({"name": "00_tiny", "bodies": bodies, "told": ["friction"]}))
    with benchmark_modules.importing(monkeypatch) as load:
        module = load("contact_scenes")
        row = module.study(data, trained.folder, config.load(None, []))
        assert module.lines(row).startswith("| 00_tiny |") and "(not seen)" in module.lines(row)
        found = module.summary([row, row])
    assert found["scenes"] == 2 and found["psnr_gain"] == row["on"]["psnr"] - row["off"]["psnr"]
