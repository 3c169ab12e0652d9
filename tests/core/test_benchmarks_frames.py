"""The benchmarks of whole frames and of harmonics: the scene that is played, and what the rows hold."""

import importlib
import json
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("numba")

from r5dgs_core.raster import compile as compilation  # noqa: E402
from r5dgs_core.raster import scene_render  # noqa: E402
from r5dgs_core.scene import playback, validation  # noqa: E402

FOLDER = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture
def load(monkeypatch):
    """Imports a benchmark by name, as running it as a script would; threads are reset afterwards."""
    import torch

    before = compilation.threads(), torch.get_num_threads()
    monkeypatch.syspath_prepend(str(FOLDER))
    names = [path.stem for path in FOLDER.glob("*.py")]
    hidden = {name: sys.modules.pop(name) for name in names if name in sys.modules}
    yield importlib.import_module
    for name in names:
        sys.modules.pop(name, None)
    sys.modules.update(hidden)
    compilation.set_threads(before[0])
    torch.set_num_threads(before[1])


def test_the_scene_that_is_played_is_valid_and_its_bodies_move(load):
    frame_rate = load("frame_rate")
    camera = frame_rate.make_camera(64)
    scene = frame_rate.make_scene(300, 6, 1, 2, camera)
    validation.check(scene, "benchmark")
    for t in (0.2, 1.2):
        frame = playback.frame(scene, t)
        moved = np.linalg.norm(frame.means - scene.means, axis=-1)
        assert (moved[:100] == 0).all() and (moved[100:] > 1e-3).all()
        assert len(np.unique(frame.motion_ids)) == 7
        output = scene_render.render_frame(scene, frame, camera)
        assert float(output.alpha.mean()) > 0.1


def test_a_row_of_frames_splits_its_time(load, tmp_path, capsys):
    frame_rate, target = load("frame_rate"), tmp_path / "rows.json"
    options = ["--count", "200", "--size", "32", "--frames", "3", "--degrees", "0,0", "1,2", "--json", str(target)]
    frame_rate.main([*options, "--threads", "1", "2"])
    rows = json.loads(target.read_text())
    assert [(r["threads"], r["sh_degree"], r["sky_degree"]) for r in rows] == [
        (1, 0, 0),
        (2, 0, 0),
        (1, 1, 2),
        (2, 1, 2),
    ]
    for row in rows:
        assert set(row) == set(frame_rate.COLUMNS)
        assert row["ms_motion"] + row["ms_colors"] + row["ms_raster"] == pytest.approx(row["ms_frame"], abs=2e-3)
        assert row["fps"] == pytest.approx(1e3 / row["ms_frame"], rel=1e-2)
    assert len(capsys.readouterr().out.splitlines()) == 5


def test_kernels_and_plain_ways_take_the_same_work(load, tmp_path):
    harmonics, target = load("harmonics"), tmp_path / "rows.json"
    harmonics.main(["--count", "50", "--size", "16", "--turns", "1", "--json", str(target)])
    rows = json.loads(target.read_text())
    assert len(rows) == 3 * 3 * 2 and all(set(row) == set(harmonics.COLUMNS) for row in rows)
    assert all(row["ratio"] == 1 for row in rows if row["way"] == "kernel")
    for degree in (1, 2, 3):
        for work in (harmonics.colors(50, degree, True), harmonics.sky(16, degree, True)):
            plain = {**harmonics.colors(50, degree, False), **harmonics.sky(16, degree, False)}
            for name, function in work.items():
                if name != "forward_backward":
                    np.testing.assert_allclose(np.asarray(function()), np.asarray(plain[name]()), atol=2e-6)
