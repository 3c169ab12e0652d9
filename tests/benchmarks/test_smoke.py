"""Benchmarks run at their smallest size and write finite figures."""

import json
import math
import sys

import pytest

from tests.support import benchmark_modules, tiny_datasets

ONCE = ("--threads", "1", "--repeats", "1")
SHORT = tuple(word for text in (*tiny_datasets.SETTINGS, "identity.iterations=5") for word in ("--set", text))
# Arguments by program; {data} and {run} are the tiny data set and a finished run on it.
PROGRAMS = {
    "appearance": ("{data}", "--run", "{run}"),
    "association": ("--scenes", "two", "--cases", "A", "--errors", "0.7", "--models", "drift", "--seeds", "1"),
    "association_time": ("--gaussians", "900", "--objects", "3", "--images", "20", "--pixels", "24"),
    "backdrop": ("--workloads", "train", "--moving", "0,1", *ONCE),
    "extrapolation": ("{run}",),
    "first_frame": ("--count", "200", "--size", "32", "--degrees", "0,0", "--repeats", "1"),
    "frame_rate": ("--count", "200", "--size", "32", "--frames", "3", "--degrees", "1,2", "--threads", "1"),
    "harmonics": ("--count", "50", "--size", "16", "--turns", "1"),
    "held_out_times": ("{data}", *SHORT, "--set", "train.iterations=10"),
    "memory": ("--size", "48", "--cameras", "5", "--times", "3", "--objects", "2", "--gaussians", "500", *SHORT),
    "motion": ("--gaussians", "100", "--bodies", "2", "--size", "small", "--rounds", "1"),
    "raster": ("--workloads", "W0", *ONCE),
    "raster_error": ("--workloads", "W0", "--groups", "resolution", "--repeats", "1"),
    "raster_extreme": ("--case", "duplicates at one place"),
    "step": ("{data}", "--gaussians", "400", "--steps", "2", "--variants", "tracks"),
    "training": ("{data}", "--iterations", "10", *SHORT),
    "workloads": ("--workloads", "W0"),
}
LONG = ("association", "extrapolation", "first_frame", "held_out_times", "training")  # more than five seconds each


def figures(tree):
    """All numbers of a JSON tree."""
    parts = tree.values() if isinstance(tree, dict) else tree if isinstance(tree, list) else ()
    return [tree] if isinstance(tree, float | int) else [number for part in parts for number in figures(part)]


@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.slow] * (n in LONG)) for n in PROGRAMS])
def test_a_benchmark_prints_a_table_and_writes_finite_figures(name, tiny, trained, tmp_path, monkeypatch, capsys):
    given = [text.format(data=tiny.root, run=trained.folder) for text in PROGRAMS[name]]
    target = tmp_path / "rows.json"
    if name == "association":
        given += ["--out", str(target.with_suffix(""))]
    elif name not in ("raster_extreme", "workloads"):
        given += ["--json", str(target)]
    monkeypatch.setattr(sys, "argv", [f"{name}.py", *given])
    with benchmark_modules.importing(monkeypatch) as load:
        load(name).main()
    assert capsys.readouterr().out.strip()
    if target.exists() or "--json" in given:
        found = figures(json.loads(target.read_text()))
        assert found and all(map(math.isfinite, found))
