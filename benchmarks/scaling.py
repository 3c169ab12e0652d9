"""Growth of the cost of every phase with the size of the input. Linux only.

    python -m benchmarks.scaling [AXIS ...] [--smallest N] [--largest N] [--json FILE]

Axes: ``gaussians``, ``lines`` (of the images), ``views``, ``times``, ``objects``. On each axis one number grows, the
others stay as in `BASE`. Each case is a capture of moving balls (`benchmarks.training.memory`), which a process of its
own reads, trains, bakes, evaluates, associates, stores and plays; Blender loads and plays the scene if bpy is
installed. Prints processor seconds and peak memory of each phase. ``exponent`` is the slope of the logarithm of the
seconds between the two largest cases, where constant costs matter least. Results: docs/results/training.md.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import importlib.util
import io
import json
import math
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any

from . import own_process, timing
from .training import memory


@dataclasses.dataclass(frozen=True)
class Case:
    """Size of an input. The number of views is ``cameras`` times ``times``."""

    gaussians: int = 6000
    lines: int = 128
    cameras: int = 6
    times: int = 4
    objects: int = 3


BASE = Case()
SMALL = Case(gaussians=2000, lines=48, cameras=5, times=4)  # for many images
AXES = {
    "gaussians": [dataclasses.replace(BASE, gaussians=n) for n in (1000, 10_000, 100_000, 1_000_000, 2_000_000)],
    "lines": [dataclasses.replace(BASE, lines=n, times=2) for n in (128, 256, 512, 1080, 2160)],
    "views": [dataclasses.replace(SMALL, cameras=n // SMALL.times) for n in (12, 100, 1000, 10_000)],
    "times": [dataclasses.replace(SMALL, times=n) for n in (2, 20, 200, 2000)],
    "objects": [dataclasses.replace(BASE, objects=n) for n in (1, 10, 100, 1000)],
}
PHASES = (
    *("read", "start", "step", "densify", "identities", "bake", "evaluate", "associate", "write", "load", "frame"),
    *("Blender load", "Blender frame"),
)
STEPS, IDENTITY_STEPS, EVALUATED, FRAMES = 10, 4, 8, 10
Row = dict[str, list[float]]  # processor seconds and peak MB by phase


def size_of(case: Case, axis: str) -> int:
    """The number that grows on an axis."""
    return case.cameras * case.times if axis == "views" else getattr(case, axis)


class Phases:
    """Processor seconds and peak memory of phases, collected in `row`."""

    def __init__(self) -> None:
        self.row: Row = {}
        self.begin()

    def begin(self) -> None:
        timing.reset_peak_mb()
        self._start = time.process_time()

    def end(self, phase: str, repeats: int = 1) -> None:
        """Store the phase since the last `begin` or `end`."""
        self.row[phase] = [(time.process_time() - self._start) / repeats, timing.status_mb("VmHWM")]
        self.begin()


def settings_of(case: Case) -> tuple[list[str], int]:
    """Settings that grow the scene to a number of Gaussians, and the steps that this takes."""
    placed = min(case.gaussians, 4000)
    growth = 2 * math.ceil(math.log2(max(2.0, 2 * case.gaussians / placed)))
    steps = growth + STEPS
    return [
        f"train.iterations={steps}",
        *("train.log_every=1", f"train.probe_every={10 * steps}", "curriculum.first=0", "curriculum.grow=0"),
        f"densify.max_gaussians={case.gaussians}",
        *(f"init.background_points={placed // 2}", f"init.object_points={max(placed // 2 // case.objects, 20)}"),
        *("densify.start=2", "densify.every=2", "densify.gradient=0", "densify.share=1", "densify.prune_opacity=0"),
        *(f"densify.stop={growth / steps}", f"identity.iterations={IDENTITY_STEPS}"),
    ], growth


def train(data: Path, folder: Path, case: Case, phases: Phases) -> Path:
    """Train a run; returns its folder. The cost of a step is the median of the last, that of densifying the rest."""
    from r5dgs_core.config import config
    from r5dgs_core.train import run

    settings, growth = settings_of(case)
    clock: list[float] = []

    def watch(event: dict[str, Any]) -> None:
        if event["event"] == "step":
            clock.append(time.process_time())
            if event["iteration"] == 1:
                phases.end("start")
        elif event["event"] == "prepare" and "labels" in event["text"]:
            phases.end("step")
        elif event["event"] == "trained":
            phases.end("identities")

    done = run.train(data, folder / "run", config.load(None, settings), progress=watch)
    spent = [after - before for before, after in zip(clock, clock[1:], strict=False)]
    step = statistics.median(spent[growth:])
    phases.row["step"][0] = step
    phases.row["densify"] = [max(spent[max(growth - 3, 0) : growth]) - step, phases.row["step"][1]]
    return done.folder


def measure(data: Path, folder: Path, case: Case) -> tuple[Row, int]:
    """Return the row of a case and its number of Gaussians."""
    from r5dgs_core.bake import bake
    from r5dgs_core.cli.commands import associate
    from r5dgs_core.data import dataset as datasets
    from r5dgs_core.evaluation import evaluate
    from r5dgs_core.playback import scene_player
    from r5dgs_core.render import scene_renderer
    from r5dgs_core.scene import scene_file
    from r5dgs_core.train import warm_up

    warm_up.warm_up()
    phases = Phases()
    dataset = datasets.read(data)
    for view in dataset.train:
        datasets.load_image(view, None)
        datasets.load_mask(view)
    phases.end("read")
    run = train(data, folder, case, phases)
    path = folder / "scene.r5dgs"
    phases.begin()
    bake.run_bake(run, path)
    phases.end("bake")
    scene = scene_file.read(path)
    phases.begin()
    evaluate.evaluate(scene, dataset)
    phases.end("evaluate")
    with contextlib.redirect_stdout(io.StringIO()):
        associate.run_associate(path, data, out=folder / "masks")
    phases.end("associate")
    scene_file.write(scene, folder / "again.r5dgs")
    phases.end("write")
    scene = scene_file.read(path)
    phases.end("load")
    player = scene_player.Player(scene)
    for number in range(FRAMES):
        t = 1.2 * scene.t_max * number / FRAMES
        scene_renderer.render_frame(scene, player.frame(t), scene.cameras[0])
    phases.end("frame", FRAMES)
    return phases.row, len(scene.gaussians.means)


def measure_blender(path: Path) -> Row:
    """Return the costs of loading and playing a scene in Blender."""
    import bpy

    from tests.blender import check_playback, run

    check_playback.extension_package()
    phases = Phases()
    run.load(path)
    phases.end("Blender load")
    for frame in range(FRAMES):
        bpy.context.scene.frame_set(frame)
    phases.end("Blender frame", FRAMES)
    return phases.row


def exponent(rows: list[tuple[int, Row]], phase: str) -> float | None:
    """Slope of the logarithm of the seconds between the two largest cases; None if a time is too short for a clock."""
    found = [(size, row[phase][0]) for size, row in rows if phase in row][-2:]
    if len(found) < 2 or min(seconds for _, seconds in found) <= 1e-4 or found[0][0] == found[1][0]:
        return None
    (small, quick), (large, slow) = found
    return math.log(slow / quick) / math.log(large / small)


def table(axis: str, rows: list[tuple[int, Row]]) -> str:
    """Table of an axis in Markdown: seconds and MB by phase and size."""
    lines = [f"| {axis} | " + " | ".join(f"{size:,}" for size, _ in rows) + " | exponent |"]
    lines.append("|---" * (len(rows) + 2) + "|")
    for phase in PHASES:
        if not any(phase in row for _, row in rows):
            continue
        cells = [f"{row[phase][0]:.3g} s, {row[phase][1]:.0f} MB" if phase in row else "" for _, row in rows]
        slope = exponent(rows, phase)
        lines.append(f"| {phase} | " + " | ".join(cells) + f" | {'' if slope is None else f'{slope:.2f}'} |")
    return "\n".join(lines)


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("axes", nargs="*", choices=[*AXES, []], metavar="AXIS", help=f"{', '.join(AXES)}; all if none")
    parser.add_argument("--largest", type=int, help="leave out larger cases")
    parser.add_argument("--smallest", type=int, default=0, help="leave out smaller cases")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    found: dict[str, list[tuple[int, Row]]] = {}
    for axis in args.axes or AXES:
        rows = found.setdefault(axis, [])
        for case in AXES[axis]:
            if not args.smallest <= size_of(case, axis) <= (args.largest or math.inf):
                continue
            with tempfile.TemporaryDirectory() as name:
                folder = Path(name)
                memory.make_dataset(folder / "data", case.lines, case.cameras, case.times, case.objects)
                row, gaussians = own_process.run(measure, folder / "data", folder, case)
                if importlib.util.find_spec("bpy") is not None:
                    row |= own_process.run(measure_blender, folder / "scene.r5dgs")
            rows.append((gaussians if axis == "gaussians" else size_of(case, axis), row))
            print(axis, rows[-1][0], {phase: round(seconds, 3) for phase, (seconds, _) in row.items()}, flush=True)
        print("\n" + table(axis, rows) + "\n", flush=True)
        if args.json:
            args.json.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
