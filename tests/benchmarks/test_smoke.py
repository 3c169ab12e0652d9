"""Benchmarks run at their smallest size and write finite figures."""

import json
import math
import os
import sys
from concurrent.futures.process import BrokenProcessPool

import pytest

from r5dgs_core.scene import scene_file
from r5dgs_core.train import run
from tests.support import benchmark_modules, encoder_folders, tiny_datasets

pytestmark = pytest.mark.heavy

ONCE = ("--threads", "1", "--repeats", "1")
SHORT = tuple(word for text in (*tiny_datasets.SETTINGS, "identity.iterations=5") for word in ("--set", text))
# Arguments by program: {data} is the tiny data set, {run} and {field} are finished runs on it, {encoder} is a sentence
# model.
PROGRAMS = {
    "extrapolation.appearance": ("{data}", "--run", "{run}"),
    "association.synthetic": ("--scenes=two", "--cases=A", "--errors=0.7", "--models=drift", "--seeds=1"),
    "association.large_scene": ("--gaussians", "900", "--objects", "3", "--images", "20", "--pixels", "24"),
    "raster.static_layer": ("--workloads", "train", "--moving", "0,1", *ONCE),
    "cameras.dirty": (
        *("--size=48", "--cameras=4", "--frames=4", "--scenes=balls", "--rows", "dirty", *SHORT),
        *("--set", "train.iterations=10"),
    ),
    "extrapolation.modes": ("{run}",),
    "prepare": ("--cameras=2", "--frames", "12", "--size", "64", "48", "--lines=48"),
    "raster.first_frame": ("--count", "200", "--size", "32", "--degrees", "0,0", "--repeats", "1"),
    "raster.frames": ("--count", "200", "--size", "32", "--frames", "3", "--degrees", "1,2", "--threads", "1"),
    "raster.harmonics": ("--count", "50", "--size", "16", "--turns", "1"),
    "training.held_out_times": ("{data}", *SHORT, "--set", "train.iterations=10"),
    "training.image_size": ("{data}", "--lines", "18", "36", *SHORT, "--set", "train.iterations=10"),
    "training.reconstruction": ("{data}", "{scene}", "--points", "3000", *SHORT, "--set", "train.iterations=10"),
    "training.memory": ("--size=48", "--cameras=5", "--times=3", "--objects=2", "--gaussians=500", *SHORT),
    "training.length": ("--size=32", "--cameras=4", "--times", "3", "--steps=1", "--objects=1"),
    "motion": ("--gaussians", "100", "--bodies", "2", "--size", "small", "--rounds", "1"),
    "raster.speed": ("--workloads", "W0", "tabletop-small", *ONCE),
    "raster.error": ("--workloads", "W0", "--groups", "resolution", "--repeats", "1"),
    "raster.extreme": ("--case", "duplicates at one place"),
    "training.step": ("{data}", "--gaussians", "400", "--steps", "2", "--variants", "tracks"),
    "training.network_playback": ("{field}", "--turns", "1"),
    "training.curve": ("{data}", "--iterations", "10", *SHORT),
    "raster.workloads": ("--workloads", "W0"),
    "futures.accuracy": ("--draws", "1", "--motions", "steady", "--markdown"),
    "futures.rendered": ("--scenes", "sliders", "--set", "train.iterations=10", "--set", "identity.iterations=2"),
    "futures.textures": ("--seeds", "1"),
    "playback": ("{field}", "--device", "cpu", "--gaussians", "2000", "--sizes", "24"),
    "large_scene": ("{scene}", "--gaussians", "2000", "--size", "64x36", "--frames", "1"),
    "film": ("{scene}", "--gaussians", "2000", "--size", "64x36", "--frames", "2"),
    "words": ("--encoder", "{encoder}"),
}
LONG = (  # more than five seconds each
    "association.large_scene",
    "association.synthetic",
    "cameras.dirty",
    "extrapolation.appearance",
    "extrapolation.modes",
    "futures.rendered",
    "futures.textures",
    "large_scene",
    "motion",
    "playback",
    "prepare",
    "raster.first_frame",
    "raster.frames",
    "raster.harmonics",
    "raster.static_layer",
    "training.curve",
    "training.held_out_times",
    "training.image_size",
    "training.length",
    "training.memory",
    "training.network_playback",
    "training.reconstruction",
    "words",
)


def figures(tree):
    """All numbers of a JSON tree."""
    parts = tree.values() if isinstance(tree, dict) else tree if isinstance(tree, list) else ()
    return [tree] if isinstance(tree, float | int) else [number for part in parts for number in figures(part)]


@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.nightly] * (n in LONG)) for n in PROGRAMS])
def test_a_benchmark_prints_a_table_and_writes_finite_figures(
    name, tiny, trained, baked, tmp_path, monkeypatch, capsys
):
    encoder = tmp_path / "encoder"
    if name == "words":
        pytest.importorskip("transformers", reason="needs transformers, which is not installed")
        encoder_folders.sentences(encoder)
    field = tmp_path / "field"
    if "{field}" in PROGRAMS[name]:
        run.train(tiny.root, field, tiny_datasets.settings("train.representation='field'", "train.iterations=40"))
    places = {"data": tiny.root, "run": trained.folder, "encoder": encoder, "field": field}
    if "{scene}" in PROGRAMS[name]:
        places["scene"] = scene_file.write(baked, tmp_path / "scene.r5dgs")
    given = [text.format(**places) for text in PROGRAMS[name]]
    target = tmp_path / "rows.json"
    if name == "association.synthetic":
        given += ["--out", str(target.with_suffix(""))]
    elif name not in ("raster.extreme", "raster.workloads"):
        given += ["--json", str(target)]
    monkeypatch.setattr(sys, "argv", [name, *given])
    with benchmark_modules.importing(monkeypatch) as load:
        load(name).main()
    assert capsys.readouterr().out.strip()
    if target.exists() or "--json" in given:
        found = figures(json.loads(target.read_text()))
        assert found and all(map(math.isfinite, found))


def test_a_failing_or_killed_process_ends_the_benchmark(monkeypatch):
    with benchmark_modules.importing(monkeypatch) as load:
        run_in_process = load("own_process").run
        assert run_in_process(abs, -3) == 3
        with pytest.raises(ZeroDivisionError):
            run_in_process(divmod, 1, 0)
        with pytest.raises(BrokenProcessPool):
            run_in_process(os._exit, 3)
