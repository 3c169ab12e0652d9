"""Measurements and tests of the extension that need no window.

    blender -b --factory-startup --python-exit-code 1 --python tests/blender/run.py -- [--scene FILE.r5dgs]

runs in a Blender, ``python tests/blender/run.py`` in the bpy module. It measures the time of loading 40,000 and a
million Gaussians (the smaller of clock and processor time), the largest distance of points from the core's playback on
and between frames, the number of keys relative to one key per frame, and frame changes per second. Positions and keys
are measured on ``--scene``, by default on a synthetic scene. Tests run if pytest is installed; tests that need torch
are left out if it is missing. The exit code is 0 if nothing failed.
"""

import argparse
import importlib
import importlib.util
import json
import math
import os
import platform
import sys
import tempfile
import time
from pathlib import Path

import bpy
import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from r5dgs_core.scene import scene_file  # noqa: E402  (the line before finds it)
from tests.blender import check_playback  # noqa: E402
from tests.support import scenes  # noqa: E402

LOAD_LIMITS_S = {40_000: 0.5, 1_000_000: 5.0}
POSITION_TOLERANCE = check_playback.POSITION_TOLERANCE  # of the scene's size
KEYS_LIMIT = 0.25  # of one key per frame
KEY_TOLERANCE = 1e-3  # of the size of the smallest object
FRAMES_LIMIT = 200.0  # frame changes per second
BODIES = 12


class Table:
    """Table of measurements, printed row by row."""

    def __init__(self):
        self.rows: list[dict] = []

    def add(self, what: str, value: float, text: str, wanted: str, good: bool) -> None:
        """Add a value, with True if it is within its limit."""
        self.rows.append({"what": what, "value": value, "wanted": wanted, "good": good})
        print(f"  {what:<52} {text:>14}   {wanted:<24} {'ok' if good else 'FAILED'}", flush=True)

    @property
    def failed(self) -> list[str]:
        return [row["what"] for row in self.rows if not row["good"]]


def load(path: Path, **options):
    """Load a scene into an empty file. Returns its collection, clock seconds and processor seconds."""
    bpy.ops.wm.read_homefile(app_template="", use_empty=True)
    wall, processor = time.perf_counter(), time.process_time()
    if bpy.ops.r5dgs.load_scene(filepath=str(path), **options) != {"FINISHED"}:
        raise SystemExit(f"{path}: was not loaded")
    seconds = time.perf_counter() - wall, time.process_time() - processor
    return next(c for c in bpy.data.collections if c.r5dgs.is_scene), *seconds


def synthetic(count: int, folder: Path, sh_degree: int = 0) -> Path:
    """Scene of twelve bodies and a floor."""
    scene = scenes.make_scene(n=count, objects=BODIES, sh_degree=sh_degree, seed=1, identities=False)
    return scene_file.write(scene, folder / f"synthetic_{count}_{sh_degree}.r5dgs")


def measure_loading(table: Table, folder: Path) -> None:
    """Measure the seconds of loading, keys included; best of three for the small scene."""
    for count, limit in LOAD_LIMITS_S.items():
        path = synthetic(count, folder)
        times = [load(path)[1:] for _ in range(3 if count < 1_000_000 else 1)]
        wall, processor = min(t[0] for t in times), min(t[1] for t in times)
        good, wanted = min(wall, processor) <= limit, f"one of them at most {limit:g} s"
        table.add(
            f"load {count:,} Gaussians, clock and processor", wall, f"{wall:.2f}, {processor:.2f} s", wanted, good
        )


def measure_positions(table: Table, path: Path, modules) -> None:
    """Measure the largest distance from playback, on every frame and at two sub-frames after each frame."""
    scene = modules["scene_file"].read(path)
    collection, *_ = load(path)
    blender, state = bpy.context.scene, collection.r5dgs
    worst = {"frames": 0.0, "sub-frames": 0.0}
    last = state.t_start + (blender.frame_end - blender.frame_start) / state.frames_per_unit
    for frame in range(blender.frame_start, blender.frame_end + 1):
        for kind, fraction in (("frames", 0.0), ("sub-frames", 0.31), ("sub-frames", 0.77)):
            t = (frame + fraction - state.frame_zero) / state.frames_per_unit
            if state.t_start <= t <= min(last, state.t_end):
                error = check_playback.position_error(collection, scene, modules, t)
                worst[kind] = max(worst[kind], error)
    for kind, error in worst.items():
        wanted = f"at most {POSITION_TOLERANCE:g} of size"
        table.add(
            f"{path.stem}: points off playback, {kind}", error, f"{error:.1e}", wanted, error <= POSITION_TOLERANCE
        )


def measure_keys(table: Table, path: Path, modules, package: str) -> None:
    """Count keys for a tolerance of 0.1 % of the smallest moving object, relative to one key per frame."""
    compat = importlib.import_module(f"{package}.r5dgs_addon.compat")
    scene = modules["scene_file"].read(path)
    sizes = []
    for group in scene.groups:
        members = scene.gaussians.means[scene.gaussians.motion_ids == group.id]
        if group.id != 0 and len(members):
            low, high = np.quantile(members, [0.02, 0.98], axis=0)
            sizes.append(float(np.linalg.norm(high - low)))
    if not sizes:
        return
    collection, *_ = load(path, key_tolerance=max(KEY_TOLERANCE * min(sizes) / scene.extent, 1e-7))
    frames = bpy.context.scene.frame_end - bpy.context.scene.frame_start + 1
    keys = curves = 0
    for obj in collection.all_objects:
        found = [len(curve.keyframe_points) for curve in compat.fcurves(obj)]
        keys, curves = keys + sum(found), curves + len(found)
    share = keys / max(frames * curves, 1)
    text = f"{100 * share:.0f} %"
    wanted = f"at most {100 * KEYS_LIMIT:.0f} %"
    what = f"{path.stem}: {keys} keys of {frames * curves}, one per frame"
    table.add(what, share, text, wanted, share <= KEYS_LIMIT)


def measure_playing(table: Table, path: Path) -> None:
    """Measure frame changes per second over the timeline and back, by the smaller of clock and processor time."""
    load(path)
    blender = bpy.context.scene
    order = [*range(blender.frame_start, blender.frame_end + 1), *range(blender.frame_end, blender.frame_start - 1, -1)]
    for frame in order:  # warm, after the first round
        blender.frame_set(frame)
    best = 0.0
    for _ in range(5):
        wall, processor = time.perf_counter(), time.process_time()
        for frame in order:
            blender.frame_set(frame)
        spent = min(time.perf_counter() - wall, time.process_time() - processor)
        best = max(best, len(order) / max(spent, 1e-9))
    what = f"frame changes, {BODIES} bodies, 40,000 Gaussians"
    table.add(what, best, f"{best:.0f} /s", f"at least {FRAMES_LIMIT:g} /s", best >= FRAMES_LIMIT)


def figures(path: Path | None) -> Table:
    """Measure everything with the extension registered, then unregister it."""
    package = check_playback.extension_package()
    modules = {
        name: importlib.import_module(f"{package}.r5dgs_core.{room}.{name}")
        for room, name in (("scene", "cameras"), ("playback", "scene_player"), ("scene", "scene_file"))
    }
    table = Table()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        measure_loading(table, folder)
        moving = synthetic(40_000, folder)
        for scene in (moving,) if path is None else (moving, path.resolve()):
            measure_positions(table, scene, modules)
            measure_keys(table, scene, modules, package)
        measure_playing(table, moving)
    bpy.ops.wm.read_homefile(app_template="", use_empty=True)
    if package == "r5dgs":
        sys.modules[package].unregister()
        for name in [name for name in sys.modules if name == package or name.startswith(f"{package}.")]:
            del sys.modules[name]
    return table


def _without_torch(pytest, left_out: list[str]):
    """Return a plugin for pytest that skips tests for which torch or numba is missing, and collects their files.

    It skips files that cannot be imported and tests that need a picture.
    """
    packages = "torch", "numba"
    missing = [name for name in packages if importlib.util.find_spec(name) is None]
    lacking = [f"{name} is not installed; remedy" for name in missing]
    lacking += [f"{sys.executable} lacks {', '.join(missing)}"] if missing else []

    class Plugin:
        @pytest.hookimpl(wrapper=True)
        def pytest_make_collect_report(self, collector):
            report = yield
            text = str(report.longrepr)
            wanted = next((name for name in packages if f"No module named '{name}'" in text), None)
            if report.outcome == "failed" and wanted is not None:
                why = f"Skipped: {wanted} is not installed"
                report.outcome, report.longrepr = "skipped", (str(collector.path), 0, why)
                left_out.append(collector.path.name)
            elif report.outcome == "skipped" and "torch is not installed" in str(report.longrepr):
                left_out.append(collector.path.name)
            return report

        @pytest.hookimpl(wrapper=True)
        def pytest_runtest_makereport(self, item, call):
            report = yield
            if report.outcome == "failed" and any(said in str(call.excinfo.value) for said in lacking):
                report.outcome, report.longrepr = "skipped", (str(item.path), 0, f"Skipped: {call.excinfo.value}")
                left_out.append(item.path.name)
            return report

    return Plugin()


def tests(arguments: list[str]) -> str:
    """Run the extension's tests in this process. Returns a summary, which begins with "FAILED" if tests failed."""
    if importlib.util.find_spec("pytest") is None:
        return "not run: pytest is not installed in this Python"
    if any(name.endswith(".r5dgs_addon") for name in sys.modules):
        return "not run: the extension is enabled in this Blender; start it with --factory-startup"
    import pytest

    os.chdir(ROOT)
    absent: list[str] = []
    options = ["-q", "-p", "no:cacheprovider", "--rootdir", str(ROOT)]
    code = pytest.main([*options, *arguments], plugins=[_without_torch(pytest, absent)])
    left_out = f"; left out for want of torch: {', '.join(sorted(set(absent)))}" if absent else ""
    return f"{'passed' if code == 0 else f'FAILED with code {int(code)}'}{left_out}"


def main(arguments: list[str]) -> int:
    """Measure and test. Returns the exit code."""
    parser = argparse.ArgumentParser(description="Figures and tests of the extension in this Blender.")
    parser.add_argument("--scene", type=Path, help="positions and keys of this scene, too")
    parser.add_argument("--json", type=Path, help="write the figures there")
    parser.add_argument("--no-figures", action="store_true", help="tests only")
    parser.add_argument("--no-tests", action="store_true", help="figures only")
    parser.add_argument(
        "tests", nargs="*", help="which tests and how, as for pytest; all of the extension's by default"
    )
    options, others = parser.parse_known_args(arguments)
    kind = "program" if bpy.app.binary_path else "module"
    print(f"Blender {bpy.app.version_string} ({kind}), Python {platform.python_version()}, numpy {np.__version__}")
    failed, result = [], {"blender": bpy.app.version_string, "kind": kind, "rows": []}
    if not options.no_figures:
        table = figures(options.scene)
        failed += table.failed
        result["rows"] = [{**row, "value": row["value"] if math.isfinite(row["value"]) else None} for row in table.rows]
    if not options.no_tests:
        result["tests"] = tests([*(options.tests or ["tests/addon"]), *others])
        failed += ["tests"] if result["tests"].startswith("FAILED") else []
        print(f"  tests: {result['tests']}")
    if options.json:
        options.json.write_text(json.dumps(result, indent=1) + "\n")
    print(f"FAILED: {', '.join(failed)}" if failed else "OK", flush=True)
    return int(bool(failed))


if __name__ == "__main__":
    given = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:]
    code = main(given)
    if not bpy.app.binary_path:
        sys.stdout.flush()
        os._exit(code)  # the module of 4.5 beside torch hangs while its libraries are unloaded
    if code:
        raise SystemExit(code)
