"""The tables of a benchmark show the values of its records."""

import io

import numpy as np
import pytest
from rich.console import Console

from r5dgs_core.bench import plot, tables
from r5dgs_core.data import images
from r5dgs_core.errors import ConfigError
from r5dgs_core.evaluation import evaluate

MACHINE = {
    "system": "Some system",
    "processor": "Some CPU",
    "cores": 2,
    "raster_threads": 1,
    "torch_threads": 1,
    "gpu": None,
    "versions": {"r5dgs": "0.0"},
}


def record(scene="room", variant="tracks", mode="rigid", seed=0, psnr=30.0, cpu=10.0, ms=5.0):
    metrics = {**dict.fromkeys(evaluate.METRICS), "psnr": psnr, "ssim": 0.9, "flip": 0.05, "miou": 0.8, "images": 4}
    return {
        "scene": scene,
        "representation": "tracks" if variant == "tracks" else "field",
        "variant": variant,
        "mode": mode,
        "seed": seed,
        "gaussians": 1000,
        "iterations": 20,
        "trained_on": MACHINE,
        "machine": MACHINE,
        "train": {"cpu_seconds": cpu, "wall_seconds": 40.0, "peak_mb": 600.0, "peak_gpu_mb": None},
        "splits": {"test": metrics, "val": {**metrics, "psnr": psnr + 3}},
        "playback": {
            "fps": 1e3 / ms,
            "ms_frame": ms,
            "ms_motion": 1.0,
            "ms_raster": ms - 1,
            "ms_cpu": ms,
            "frames": 60,
        },
    }


def result(records, failures=()):
    settings = {"preset": None, "config": None, "set": ["train.iterations=20"]}
    return {"machine": MACHINE, "settings": settings, "results": list(records), "failures": list(failures)}


def lines_of(sheet):
    return [dict(zip(sheet.head, line, strict=True)) for block in sheet.blocks for line in block]


def test_seeds_are_shown_as_their_mean_and_half_their_range():
    test, val, played = tables.sheets(result([record(seed=0, psnr=30.0), record(seed=1, psnr=31.0)]))
    (line,) = lines_of(test)
    assert line["PSNR"] == "30.50 ± 0.50" and line["CPU s"] == "10 ± 0" and line["LPIPS"] == "-"
    assert lines_of(val)[0]["PSNR"] == "33.50 ± 0.50"
    assert lines_of(played)[0]["FPS"] == "200.0 ± 0.0" and "seeds 0, 1" in played.caption


def test_the_tables_mark_the_machine_of_each_record():
    records = [record(seed=0), record(seed=1), record(variant="r5dgs", mode="standard")]
    found = result(records)
    assert "alike" not in tables.markdown(found)
    caption = tables.sheets(found)[2].caption
    assert "threads of the rasterizer 1" in caption and "Some CPU" in caption and "GPU" not in caption
    records[1]["machine"] = {**MACHINE, "raster_threads": 4}
    caption = tables.sheets(found)[2].caption
    assert "not all measured alike" in caption and "rasterizer 1 / 4" in caption and "Some CPU" not in caption
    (line,) = [line for line in tables.markdown(found).splitlines() if "rasterizer 4" in line and line[0] == "-"]
    assert line.startswith("- measured:") and line.endswith("(room tracks rigid seed 1)")


def test_the_tables_mark_runs_trained_on_other_or_unknown_machines():
    records = [record(seed=0), record(seed=1), record(variant="r5dgs", mode="standard")]
    records[0]["trained_on"] = {**MACHINE, "versions": {"r5dgs": "0.1"}}
    records[2]["trained_on"] = None
    text = tables.markdown(result(records))
    assert "Not all runs were trained alike" in text and "Not all runs were measured alike" not in text
    trained = [line for line in text.splitlines() if line.startswith("- trained:")]
    assert len(trained) == 3 and "r5dgs 0.1" in trained[0] and trained[0].endswith("(room tracks seed 0)")
    assert trained[2] == "- trained: unknown (room r5dgs seed 0)"


def test_a_single_seed_has_no_spread():
    test, _, played = tables.sheets(result([record()]))
    assert lines_of(test)[0]["PSNR"] == "30.00" and "seeds" not in test.caption
    assert lines_of(played)[0]["mIoU test"] == "0.800"


def test_the_papers_rows_come_first_and_our_rows_last():
    records = [record(variant="tracks")]
    records += [record(variant=v, mode=m) for v in ("r5dgs_extra", "r5dgs") for m in ("rigid", "rigid_paper")]
    records += [record(variant="r5dgs", mode="standard")]
    found = [
        (line["paper's row"], line["method"], line["mode"]) for line in lines_of(tables.sheets(result(records))[0])
    ]
    assert found == [
        ("5DGS", "field/r5dgs", "standard"),
        ("R5DGS", "field/r5dgs", "rigid_paper"),
        ("R5DGS + extra", "field/r5dgs_extra", "rigid_paper"),
        ("ours", "field/r5dgs", "rigid"),
        ("ours", "field/r5dgs_extra", "rigid"),
        ("ours", "tracks", "rigid"),
    ]


def test_modes_are_compared_with_standard_of_the_same_run():
    records = [record(variant="r5dgs", mode="standard", seed=s, psnr=30.0 + 5 * s, ms=10.0) for s in (0, 1)]
    records += [record(variant="r5dgs", mode="rigid", seed=s, psnr=31.0 + 4 * s, ms=5.0) for s in (0, 1)]
    (line,) = lines_of(tables.sheets(result([*records, record()]))[3])
    assert (line["mode"], line["PSNR dB"], line["FPS x"]) == ("rigid", "+0.50 ± 0.50", "2.00 ± 0.00")
    assert line["objects dB"] == "-"
    assert len(tables.sheets(result([record()]))) == 3


def test_only_one_row_is_called_5dgs():
    both = ("5dgs", "r5dgs")
    assert tables.paper_row("5dgs", "standard", both) == "5DGS"
    assert tables.paper_row("r5dgs", "standard", both) == ""
    assert tables.paper_row("r5dgs", "standard", ("r5dgs",)) == "5DGS"


def test_the_mean_over_scenes_is_given_if_all_scenes_have_a_value():
    records = [record("a", psnr=20.0), record("b", psnr=30.0), record("a", variant="r5dgs", mode="standard")]
    last = [line for line in lines_of(tables.sheets(result(records))[0]) if line["scene"] == "mean of 2"]
    assert [(line["method"], line["PSNR"]) for line in last] == [("tracks", "25.00")]
    records[0]["splits"]["test"]["flip"] = None
    last = lines_of(tables.sheets(result(records))[0])[-1]
    assert last["FLIP"] == "-" and last["PSNR"] == "25.00"


def test_failed_runs_are_listed_in_and_below_the_tables():
    names = {"scene": "b", "representation": "field", "variant": "r5dgs", "seed": 0}
    found = result([record("a")], [{**names, "error": "loss: nan | at step 3"}])
    (line,) = [line for line in lines_of(tables.sheets(found)[0]) if line["scene"] == "b"]
    assert (line["method"], line["PSNR"]) == ("field/r5dgs", "failed")
    assert "b, r5dgs, seed 0: loss: nan" in tables.markdown(found)


def test_every_line_of_a_markdown_table_has_the_same_width():
    found = result([record("a"), record("b|c")])
    text = tables.markdown(found)
    rows = [line for line in text.splitlines() if line.startswith("|")]
    sheets = tables.sheets(found)
    assert len(rows) == sum(2 + len(lines_of(sheet)) for sheet in sheets)
    widths = [len(row.replace("\\|", "").split("|")) for row in rows]
    assert sorted(set(widths)) == sorted({len(sheet.head) + 2 for sheet in sheets})
    assert "Some CPU" in text and "train.iterations=20" in text


def test_the_terminal_shows_every_figure():
    sheet = tables.sheets(result([record(psnr=12.34)]))[0]
    console = Console(file=io.StringIO(), width=200)
    console.print(tables.to_rich(sheet))
    text = console.file.getvalue()
    assert all(cell in text for block in sheet.blocks for line in block for cell in line)


def test_rows_mark_results_without_a_faster_and_equally_good_one():
    records = [
        record(variant="tracks", psnr=40.0, cpu=5.0, ms=4.0),
        record(variant="r5dgs", psnr=35.0, cpu=50.0, ms=3.0),
    ]
    rows = tables.report_rows(records)
    assert {tuple(row) for row in rows} == {
        ("task", "mode", "method", "setting", "error_kind", "error", "ms", "pareto")
    }
    pareto = {(row["task"], row["method"]): row["pareto"] for row in rows}
    assert pareto["room, training, test", "tracks"] and not pareto["room, training, test", "field/r5dgs"]
    assert pareto["room, playback, test", "tracks"] and pareto["room, playback, test", "field/r5dgs"]
    assert {row["ms"] for row in rows if "training" in row["task"]} == {5e3, 5e4}


def test_rows_use_wall_time_if_processor_time_is_unknown_and_are_omitted_without_either():
    records = [record(cpu=None), record(seed=1)]
    for split in ("test", "val"):
        records[1]["splits"][split]["psnr"] = None
    rows = [row for row in tables.report_rows(records) if "training" in row["task"]]
    assert [(row["setting"], row["ms"]) for row in rows] == [("seed 0", 4e4)] * 2


def test_the_plot_shows_the_points(tmp_path):
    empty = images.read(plot.write([], tmp_path / "empty.png"))
    full = images.read(plot.write([record(), record(variant="r5dgs", psnr=20.0, ms=9.0)], tmp_path / "full.png"))
    blue, orange = np.array([0x1F, 0x77, 0xB4]) / 255, np.array([0xFF, 0x7F, 0x0E]) / 255
    for color in (blue, orange):
        near = [(np.abs(picture[..., :3] - color).max(-1) < 0.25).sum() for picture in (empty, full)]
        assert near[0] == 0 and near[1] > 100
    with pytest.raises(ConfigError, match="gone"):
        plot.write([], tmp_path / "gone" / "plot.png")
