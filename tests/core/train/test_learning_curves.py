"""The learning curves of a run are a picture of its log, and no reason to lose the run."""

import json
import struct
import sys

import pytest

from r5dgs_core import atomic_files
from r5dgs_core.train import learning_curves, run, run_folder
from tests.support import tiny_datasets

pytestmark = [pytest.mark.usefixtures("plots"), pytest.mark.heavy]
ROWS = [
    {"iteration": 10 * k, "seconds": 1.5 * k, "loss": 0.5 / k, "gaussians": 100 + k, "val_psnr": 20 + k}
    for k in range(1, 6)
]
BLIND = [{name: value for name, value in row.items() if name != "val_psnr"} for row in ROWS]


def size(png):
    assert png[:8] == b"\x89PNG\r\n\x1a\n"
    return struct.unpack(">II", png[16:24])


def write_log(folder, rows, tail=""):
    (folder / run_folder.LOG_FILE).write_text("".join(json.dumps(row) + "\n" for row in rows) + tail)
    return learning_curves.LearningCurves(folder)


def test_each_measured_curve_has_a_panel():
    three, two = learning_curves.draw(ROWS), learning_curves.draw(BLIND)
    assert size(three)[0] == size(two)[0] and size(three)[1] * 2 == size(two)[1] * 3


@pytest.mark.slow
def test_some_steps_may_have_no_measurement_of_held_out_views():
    mixed = [BLIND[0], ROWS[1], BLIND[2], ROWS[3]]
    assert size(learning_curves.draw(mixed)) == size(learning_curves.draw(ROWS)) and learning_curves.draw(
        mixed
    ) != learning_curves.draw(ROWS)


def test_a_finished_run_is_drawn_whatever_the_time_and_a_torn_line_is_left_out(tmp_path):
    write_log(tmp_path, ROWS, '{"iterat').update(finished=True)
    assert (tmp_path / run_folder.CURVES_FILE).read_bytes() == learning_curves.draw(ROWS)


def test_an_active_run_is_plotted_rarely_enough_to_cost_little(tmp_path, monkeypatch):
    now, drawn = [0.0], []
    monkeypatch.setattr(learning_curves.time, "monotonic", lambda: now[0])

    def draw(rows):
        drawn.append(now[0])
        now[0] += 3.0  # what a slow machine takes
        return b"png"

    monkeypatch.setattr(learning_curves, "draw", draw)
    pictures = write_log(tmp_path, ROWS)
    while now[0] < 1000:
        now[0] += 1.0
        pictures.update()
    assert drawn[0] == learning_curves.EVERY_S
    gaps = [later - earlier for earlier, later in zip(drawn, drawn[1:], strict=False)]
    assert len(drawn) > 3 and all(1.1 * learning_curves.SHARE * gap >= 3.0 for gap in gaps)


def test_a_single_point_is_not_plotted(tmp_path):
    write_log(tmp_path, ROWS[:1]).update(finished=True)
    assert not (tmp_path / run_folder.CURVES_FILE).exists()


def full_disk(*args):
    raise OSError(28, "No space left on device")


@pytest.mark.parametrize("fault", ["matplotlib", "disk", "log"])
def test_a_plot_that_cannot_be_drawn_is_one_warning(tmp_path, monkeypatch, caplog, fault):
    pictures = write_log(tmp_path, ROWS)
    if fault == "matplotlib":
        monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    elif fault == "disk":
        monkeypatch.setattr(atomic_files, "write", full_disk)
    else:
        (tmp_path / run_folder.LOG_FILE).unlink()
    for _ in range(2):
        pictures.update(finished=True)
    assert len(caplog.records) == 1 and "learning curves cannot be drawn" in caplog.text
    assert not (tmp_path / run_folder.CURVES_FILE).exists()


def test_a_run_writes_its_curves_and_a_new_run_removes_them(tiny, tmp_path):
    folder, short = tmp_path / "run", ("identity.iterations=0", "train.log_every=5")
    run.train(tiny.root, folder, tiny_datasets.settings("train.iterations=20", *short))
    assert size((folder / run_folder.CURVES_FILE).read_bytes())[0] > 300
    run.train(tiny.root, folder, tiny_datasets.settings("train.iterations=2", *short), overwrite=True)
    assert not (folder / run_folder.CURVES_FILE).exists()
