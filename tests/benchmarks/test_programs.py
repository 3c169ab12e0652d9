"""The benchmarks of the rasterizer: what their rows hold, how peers take part, and what they draw."""

import json
import math
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from r5dgs_core.raster import rasterize_splats
from r5dgs_core.scene import scene_file
from r5dgs_core.scene.cameras import Camera
from tests.support import benchmark_modules, scenes

ROOT = Path(__file__).parents[2]
COLUMNS = ["workload", "backend", "threads", "pass", "cpu_ms", "wall_ms_min", "wall_ms_median", "peak_mb"]
REPORT_COLUMNS = {"task", "mode", "method", "setting", "error_kind", "error", "ms", "pareto"}

# A renderer that knows one thing, the mean colour, and says so of W0 only.
PEER = """
import torch

NAME = "flat"


def supports(workload):
    return workload == "W0"


def prepare(inputs, camera):
    return inputs, camera


def forward(state):
    inputs, camera = state
    return inputs[-1].mean(0).expand(camera.height, camera.width, -1)


def forward_backward(state, upstream):
    inputs, camera = state
    leaves = [tensor.detach().requires_grad_() for tensor in inputs]
    forward((leaves, camera)).backward(upstream)
"""


@pytest.fixture
def load(monkeypatch):
    """Imports a benchmark by name, see `benchmark_modules.importing`."""
    with benchmark_modules.importing(monkeypatch) as load:
        yield load


def check_times(rows):
    for row in rows:
        assert list(row) == COLUMNS
        assert 0 < row["wall_ms_min"] <= row["wall_ms_median"]
        assert row["cpu_ms"] >= 0  # 0 for a peer that takes less than the rounding
        assert row["peak_mb"] is None or row["peak_mb"] >= 0


def test_the_command_line_writes_a_row_for_each_pass(tmp_path):
    target = tmp_path / "rows.json"
    command = [sys.executable, benchmark_modules.FOLDER / "raster.py", "--workloads", "W0,train", "--threads", "1"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    subprocess.run(
        [*command, "--repeats", "1", "--json", target], check=True, capture_output=True, cwd=tmp_path, env=environment
    )
    rows = json.loads(target.read_text())
    check_times(rows)
    assert [(row["workload"], row["backend"], row["threads"], row["pass"]) for row in rows] == [
        (workload, "cpu", 1, name) for workload in ("W0", "train") for name in ("forward", "forward_backward")
    ]


def test_a_peer_takes_turns_on_the_workloads_that_it_supports(load, tmp_path, capsys):
    (tmp_path / "flat.py").write_text(PEER)
    target = tmp_path / "rows.json"
    arguments = ["--workloads", "W0", "train", "--threads", "1,2", "--repeats", "1", "--json", str(target)]
    load("raster").main([*arguments, "--peer", str(tmp_path / "flat.py")])
    rows = json.loads(target.read_text())
    check_times(rows)
    theirs = [(row["workload"], row["threads"], row["pass"]) for row in rows if row["backend"] == "flat"]
    assert theirs == [("W0", threads, name) for threads in (1, 2) for name in ("forward", "forward_backward")]
    printed = capsys.readouterr().out
    assert "flat does not support train" in printed
    row, other = (next(r for r in rows if r["backend"] == backend) for backend in ("cpu", "flat"))
    ratio = f"{other['cpu_ms'] / row['cpu_ms']:.1f}x"
    assert ratio in next(line for line in printed.splitlines() if "W0 forward, 1 thread " in line)
    assert "flat on W0: its image differs" in printed


def test_ratios_are_of_processor_time_beside_constants_that_say_so(load):
    raster = load("raster")
    row = {"workload": "W1", "threads": 1, "wall_ms_min": 4.0, "wall_ms_median": 5.0, "peak_mb": None}
    rows = [
        {**row, "backend": "cpu", "pass": "forward_backward", "cpu_ms": 29.0},
        {**row, "backend": "other", "pass": "forward_backward", "cpu_ms": 58.0, "wall_ms_median": 20.0},
        {**row, "backend": "cpu", "threads": 2, "pass": "forward_backward", "cpu_ms": 30.0, "wall_ms_min": 2.0},
    ]
    lines = raster.ratios(rows, ["other"]).splitlines()
    assert next(line for line in lines if line.endswith("2.0x      4.0x")).strip().startswith("W1 forward_backward")
    published = lines.index(next(line for line in lines if line.startswith("OpenSplat, CPU / ours")))
    assert "another day" in lines[published]
    assert lines[published + 1].endswith("10.0x  (290 ms)")
    assert lines[-1].endswith("2.00x")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--workloads", "W0,W9"], "'W9'"),
        (["--workloads", "W4garden"], "--garden"),
        (["--workloads", "W0", "--peer", "no_such_peer"], "no_such_peer"),
        (["--workloads", "W0", "--peer", "no_such_peer.py"], "no such file"),
        (["--workloads", "W0", "--backends", "fast"], "'fast'"),
        (["--workloads", "W0", "--threads", "0"], "at least 1"),
        (["--scene", "no_such.r5dgs"], "no_such.r5dgs"),
    ],
)
def test_what_cannot_be_measured_is_named_before_anything_is(load, capsys, arguments, message):
    raster = load("raster")
    with pytest.raises(SystemExit) as stop:
        raster.main(arguments)
    captured = capsys.readouterr()
    assert stop.value.code == 2
    assert message in captured.err
    assert not captured.out


def test_a_peer_that_lacks_a_function_is_refused(load, tmp_path, capsys):
    (tmp_path / "half.py").write_text("NAME = 'half'\ndef prepare(inputs, camera): return None\n")
    raster = load("raster")
    with pytest.raises(SystemExit):
        raster.main(["--workloads", "W0", "--peer", str(tmp_path / "half.py")])
    assert "found no forward" in capsys.readouterr().err


def test_a_scene_file_is_drawn_at_a_time_by_one_of_its_cameras(load, tmp_path, capsys):
    scene = scenes.make_scene(300, sh_degree=1)
    path = scene_file.write(scene, tmp_path / "toys.r5dgs")
    arguments = ["--scene", str(path), "--threads", "1", "--repeats", "1", "--json", str(tmp_path / "rows.json")]
    raster = load("raster")
    raster.main([*arguments, "--camera", scene.cameras[1].name, "--time", "0.9"])
    rows = json.loads((tmp_path / "rows.json").read_text())
    check_times(rows)
    assert [row["pass"] for row in rows] == ["forward", "forward_backward", "motion", "frame"]
    assert {row["workload"] for row in rows} == {"toys"}
    with pytest.raises(SystemExit):
        raster.main([*arguments, "--camera", "7"])
    assert scene.cameras[0].name in capsys.readouterr().err


def test_stages_add_up_to_the_call_and_leave_the_kernels_as_they_were(load):
    raster, stages, workloads = load("raster"), load("stages"), load("workloads")
    workload = workloads.make("W0")
    upstream = raster.make_upstream(workload)
    before = raster.draw(workload, "cpu")
    found = stages.measure(lambda: raster.step(workload, "cpu", upstream), 3)
    names = list(found)
    assert names[-1] == "rest of the call"
    assert names.index("project") < names.index("blend") < names.index("blend_backward")
    assert all(ms >= 0 for ms in found.values())
    assert torch.equal(raster.draw(workload, "cpu"), before)
    assert "blend" in stages.measure(lambda: raster.draw(workload, "cpu"), 1)


def test_the_generated_garden_is_as_heavy_as_the_real_points(load):
    workloads = load("workloads")
    # `benchmarks/workloads.py --garden FILE` on gsplat's test_garden.npz
    real = {
        "gaussians": 138766,
        "visible": 77388,
        "radius_median": 5.29,
        "radius_p95": 14.35,
        "tile_pairs": 218748,
        "pairs": 5730578,
        "pairs_per_px": 55.31,
        "finished": 0.64,
    }
    assert workloads.describe(workloads.make("W4")) == pytest.approx(real, rel=0.06)


def test_pairs_are_the_pixels_where_a_gaussian_is_strong_enough_until_they_are_finished(load):
    workloads = load("workloads")
    focal, depth, scale, opacity = 100.0, 2.0, 0.1, 0.9
    camera = Camera(64, 48, np.array([[focal, 0, 32], [0, focal, 24], [0, 0, 1]]), np.eye(4))

    def stack(count):
        arrays = [[[0, 0, depth]], [[1, 0, 0, 0]], [[scale] * 3], [opacity], [[0.5]]]
        inputs = [
            torch.tensor(array, dtype=torch.float32).repeat(count, *[1] * (np.ndim(array) - 1)) for array in arrays
        ]
        return workloads.describe(workloads.Workload("stack", inputs, camera))

    variance = (focal * scale / depth) ** 2 + 0.3
    x, y = np.meshgrid(np.arange(64) + 0.5 - 32, np.arange(48) + 0.5 - 24)
    alpha = opacity * np.exp(-(x * x + y * y) / (2 * variance))
    one = stack(1)
    assert one["pairs"] == (alpha >= 1 / 255).sum()
    assert one["radius_median"] == pytest.approx(3 * math.sqrt(variance))
    assert one["finished"] == 0
    many = stack(40)
    layers = np.floor(np.log(1e-4) / np.log1p(-alpha))  # as many as leave a transmittance of 1e-4
    expected = np.where(alpha >= 1 / 255, np.minimum(layers, 40), 0)
    assert many["pairs"] == expected.sum()
    assert many["finished"] == pytest.approx(((alpha >= 1 / 255) & (layers < 40)).mean())


def test_a_posed_scene_gives_what_the_scene_shows(load):
    from r5dgs_core.playback import scene_player
    from r5dgs_core.render import scene_renderer

    workloads = load("workloads")
    posed = workloads.make("tabletop-small")
    drawn = rasterize_splats(*posed.inputs, posed.camera, settings=posed.settings, backend="cpu").image
    frame = scene_player.frame(posed.scene, posed.t)
    shown = scene_renderer.render_frame(posed.scene, frame, posed.camera, background=None, backend="cpu").color
    torch.testing.assert_close(drawn, shown, atol=1e-5, rtol=0)  # exp and sigmoid in another precision
    still = scene_player.frame(posed.scene, posed.scene.t_max)
    assert np.abs(frame.means - still.means).max() > 0.1


def test_polynomials_are_exact_at_zero_and_better_with_each_degree(load):
    polynomials = load("polynomials")
    fitted = [polynomials.fit(degree) for degree in range(1, 7)]
    errors = [polynomials.worst_error(coefficients) for coefficients in fitted]
    assert all(coefficients[0] == 1 for coefficients in fitted)
    assert all(better < worse / 15 for worse, better in zip(errors[:-1], errors[1:], strict=True))
    assert errors[4] < 9.3e-8  # that of the rasterizer's own, in exact arithmetic, is 9.2e-8


def test_the_pareto_front_keeps_what_nothing_else_beats(load):
    front = load("raster_error").front
    assert front([(1, 4), (2, 3), (2, 5), (3, 3), (4, 1)]) == [True, True, False, False, True]
    assert front([(1, 1), (1, 1)]) == [True, True]


def test_errors_of_the_settings_shrink_as_the_cut_off_does(load, tmp_path, capsys):
    raster_error = load("raster_error")
    target, picture = tmp_path / "rows.json", tmp_path / "picture.png"
    arguments = ["--workloads", "W0", "--groups", "cut-offs,resolution", "--repeats", "1"]
    raster_error.main([*arguments, "--json", str(target), "--plot", str(picture)])
    rows = json.loads(target.read_text())
    assert all(set(row) == REPORT_COLUMNS for row in rows)
    rms = {row["setting"]: row["error"] for row in rows if row["error_kind"] == "rms"}
    cut_offs = ["alpha_min 1/4096", "alpha_min 1/1024", "alpha_min 1/512", "defaults", "alpha_min 1/64"]
    errors = [rms[setting] for setting in cut_offs]
    assert errors == sorted(errors)
    assert 0 < errors[0] < errors[-1] / 10
    assert rms["resolution 1/2, dilation 0.3"] > rms["resolution 3/4, dilation 0.3"] > rms["defaults"]
    psnr = {row["setting"]: row["error"] for row in rows if row["error_kind"] == "psnr_db"}
    assert psnr["defaults"] == pytest.approx(-20 * math.log10(rms["defaults"]))
    for kind in ("max_abs", "rms"):
        own = [row for row in rows if row["error_kind"] == kind]
        exactest = min(own, key=lambda row: (row["error"], row["ms"]))
        assert exactest["pareto"]
        assert any(row["pareto"] and row["ms"] == min(r["ms"] for r in own) for row in own)
    assert picture.stat().st_size > 10_000
    assert "the defaults" in capsys.readouterr().out


@pytest.mark.slow
def test_another_polynomial_is_drawn_with_in_a_process_of_its_own(load):
    raster_error = load("raster_error")
    variants = [v for v in raster_error.VARIANTS if v.setting in ("defaults", "exp2 of degree 2")]
    raster_error.measure("W0", variants, 1)
    default, coarse = (raster_error.Drawers("W0").make(v) for v in variants)
    assert torch.equal(default(), coarse())  # in this process both have the rasterizer's own
    remote = load("polynomials").Remote(
        {}, load("polynomials").fit(2), raster_error.functools.partial(raster_error.make_drawer, "W0", variants[1])
    )
    try:
        difference = (remote.draw() - default()).abs().max().item()
    finally:
        remote.close()
    assert 1e-5 < difference < 1e-2  # the polynomial's relative error is 2e-3
