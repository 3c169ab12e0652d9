"""Time and memory of the rasterizer.

    python -m benchmarks.raster speed --workloads W1,W2,W3,W4 --threads 1 --json FILE

A row is one pass over one workload with one backend and number of threads. ``cpu_ms`` is the minimum processor time
over all threads (comparable on a busy machine), wall times are minimum and median, and ``peak_mb`` is the additional
resident memory of a pass, measured in separate calls (null if the system does not report it; without GPU memory). All
calls run in interleaved rounds and include input checks. Passes:

    forward           without gradients
    forward_backward  with gradients of every input
    motion            scenes only: from the scene file's arrays to Gaussians at a time (`Player.frame`)
    frame             scenes only: motion, view-dependent colors, forward, ids

Threads are those of the rasterizer. With the backend `cpu`, torch's own operations run on one thread, because its
spinning threads would count as processor time; other backends and peers get all threads.

A peer is another renderer: a Python module (dotted name, or path to a .py file) with ``NAME``,
``prepare(inputs, camera) -> state`` and ``forward(state) -> image [H, W, D]``, and optionally
``forward_backward(state, upstream)``, with the gradient of the image [H, W, D], and ``supports(workload) -> bool``.
``inputs`` are means [N, 3], quats [N, 4] (wxyz), scales [N, 3], opacities [N], channels [N, D], float32 tensors;
``camera`` has ``width``, ``height``, ``intrinsics`` [3, 3] and ``T_cam_world`` [4, 4] (OpenCV axes). Results:
docs/results/rasterizer.md.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import importlib
import importlib.util
import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

import torch

from r5dgs_core import errors
from r5dgs_core.playback import scene_player
from r5dgs_core.raster import backends, rasterize_splats
from r5dgs_core.render import scene_renderer
from r5dgs_core.scene import scene_file

from .. import timing
from . import stages, workloads
from .workloads import Workload

COLUMNS = ("workload", "backend", "threads", "pass", "cpu_ms", "wall_ms_min", "wall_ms_median", "peak_mb")
DEFAULT_WORKLOADS = ["W1", "W2", "W3", "W4"]

# Smallest processor milliseconds on one thread, (forward, forward and backward). Measured on another day on a machine
# of the kind that the committed results come from (2 cores with AVX-512, 2.6 GHz). W4 there had the real points.
ANCHORS = {
    "OpenSplat, CPU": {
        "W1": (161, 290),
        "W1h": (390, 556),
        "W2": (1062, 1867),  # 7 passes: it draws 3 channels
        "W3": (1338, 2161),
        "W4": (270, 515),
    },
    "plain numba sketch": {
        "W1": (20, 47),
        "W1h": (30, 79),
        "W2": (31, 81),
        "W3": (135, 317),
        "W4": (47, 117),
    },
    # An estimate, not a measurement: blending at 60 % of what counting its vector instructions allows, the rest tuned.
    "estimated bound": {"W1": (None, 15)},
}
PASSES = ("forward", "forward_backward")


def main(arguments: list[str] | None = None) -> None:
    """Run the benchmark."""
    parser = _parser()
    options = parser.parse_args(arguments)
    if options.json and not options.json.parent.is_dir():
        parser.error(f"--json: no folder {options.json.parent}")
    options.threads = [count for part in options.threads for count in part]
    options.backends = [name for part in options.backends for name in part]
    if min(options.threads) < 1 or options.repeats < 1:
        parser.error("--threads and --repeats: expected at least 1")
    try:
        for backend in options.backends:
            on_gpu = backend == "cuda" and torch.cuda.is_available()
            backends.choose(backend, torch.zeros(1, device="cuda" if on_gpu else "cpu"))
        chosen = _choose(options)
        peers = [load_peer(name) for name in options.peer]
    except (ValueError, OSError, errors.R5dgsError) as error:
        parser.error(str(error))
    rows: list[dict[str, Any]] = []
    print(" ".join(f"{column:>16}" for column in COLUMNS), flush=True)
    for make in chosen:
        workload = make()
        for threads in options.threads:
            with _rasterizer_threads(threads):
                contenders = list(_contenders(workload, threads, options.backends, peers))
                timing.take_turns(contenders, options.repeats)
                new = [contender.row() for contender in contenders]
                rows += new
                for row in new:
                    print(" ".join(f"{row[column]!s:>16}" for column in COLUMNS), flush=True)
                if options.stages and "cpu" in options.backends:
                    print(_split(workload, threads, options.repeats), flush=True)
        for peer in peers:
            print(_compare_images(peer, workload), end="", flush=True)
    print(ratios(rows, [peer.NAME for peer in peers]), end="")
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1) + "\n")


def load_peer(name: str) -> ModuleType:
    """Import a peer's module by dotted name or path. Raises ValueError if it is missing or incomplete."""
    if name.endswith(".py"):
        path = Path(name)
        if not path.is_file():
            raise ValueError(f"--peer {name}: no such file")
        spec = importlib.util.spec_from_file_location(f"peer_{path.stem}", path)
        assert spec is not None and spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    else:
        try:
            module = importlib.import_module(name)
        except ModuleNotFoundError as error:
            raise ValueError(
                f"--peer {name}: {error}; expected a module on PYTHONPATH or a path to a .py file"
            ) from None
    lacking = [needed for needed in ("NAME", "prepare", "forward") if not hasattr(module, needed)]
    if lacking:
        raise ValueError(f"--peer {name}: expected NAME, prepare and forward, found no {', '.join(lacking)}")
    return module


def ratios(rows: list[dict[str, Any]], peers: list[str]) -> str:
    """Format our `cpu` rows beside peers of this run, figures of another day and one thread, and frames per second."""
    found = {(row["workload"], row["backend"], row["threads"], row["pass"]): row for row in rows}
    ours = [row for row in rows if row["backend"] == "cpu"]
    lines = []
    for peer in peers:
        pairs = [(row, found.get((row["workload"], peer, row["threads"], row["pass"]))) for row in ours]
        pairs = [(row, other) for row, other in pairs if other is not None]
        if pairs:
            lines.append(f"\n{peer} / ours, in turns in this run: processor time, median wall time")
        for row, other in pairs:
            of_cpu, of_wall = (other[key] / row[key] for key in ("cpu_ms", "wall_ms_median"))
            lines.append(f"{_title(row):>44} {of_cpu:8.1f}x {of_wall:8.1f}x")
    alone = [row for row in ours if row["threads"] == 1 and row["pass"] in PASSES]
    for anchor, figures in ANCHORS.items():
        known = []
        for row in alone:
            figure = figures.get("W4" if row["workload"] == workloads.GARDEN else row["workload"], (None, None))
            if (value := figure[PASSES.index(row["pass"])]) is not None:
                known.append((row, value))
        if known:
            lines.append(f"\n{anchor} / ours, processor time; theirs is a constant from another day, such a machine")
        for row, value in known:
            lines.append(f"{_title(row):>44} {value / row['cpu_ms']:8.1f}x  ({value} ms)")
    shared = [row for row in ours if row["threads"] > 1 and (row["workload"], "cpu", 1, row["pass"]) in found]
    if shared:
        lines.append("\none thread / several, smallest wall time")
    for row in shared:
        single = found[row["workload"], "cpu", 1, row["pass"]]
        lines.append(f"{_title(row):>44} {single['wall_ms_min'] / row['wall_ms_min']:8.2f}x")
    frames = [row for row in ours if row["pass"] == "frame"]
    if frames:
        lines.append("\nframes per second of playback, median and best")
    for row in frames:
        lines.append(f"{_title(row):>44} {1e3 / row['wall_ms_median']:8.1f} {1e3 / row['wall_ms_min']:8.1f}")
    return "".join(line + "\n" for line in lines)


def _title(row: dict[str, Any]) -> str:
    return f"{row['workload']} {row['pass']}, {row['threads']} thread{'s' * (row['threads'] > 1)}"


def _contenders(
    workload: Workload, threads: int, backends: list[str], peers: list[ModuleType]
) -> Iterator[timing.Contender]:
    """Contenders of a workload with a given number of threads."""
    upstream = make_upstream(workload)

    def contender(backend: str, name: str, run: Callable[[], object]) -> timing.Contender:
        row = {"workload": workload.name, "backend": backend, "threads": threads, "pass": name}
        return timing.Contender(row, run, 1 if backend == "cpu" else threads)

    for backend in backends:
        placed, gradient = workload, upstream
        if backend == "cuda":
            placed = dataclasses.replace(workload, inputs=[tensor.cuda() for tensor in workload.inputs])
            gradient = upstream.cuda()
        yield contender(backend, "forward", functools.partial(draw, placed, backend))
        yield contender(backend, "forward_backward", functools.partial(step, placed, backend, gradient))
        if workload.scene is not None:
            yield contender(backend, "motion", functools.partial(move, workload))
            yield contender(backend, "frame", functools.partial(play, workload, backend))
    for peer in peers:
        if hasattr(peer, "supports") and not peer.supports(workload.name):
            print(f"{peer.NAME} does not support {workload.name}")
            continue
        state = peer.prepare(workload.inputs, workload.camera)
        yield contender(peer.NAME, "forward", functools.partial(peer.forward, state))
        if hasattr(peer, "forward_backward"):
            yield contender(peer.NAME, "forward_backward", functools.partial(peer.forward_backward, state, upstream))


def make_upstream(workload: Workload) -> torch.Tensor:
    """A random gradient of the image. [H, W, D]"""
    shape = (workload.camera.height, workload.camera.width, workload.n_channels)
    return torch.randn(shape, generator=torch.Generator().manual_seed(1))


@torch.no_grad()
def draw(workload: Workload, backend: str) -> torch.Tensor:
    """Image of a workload, after the device has finished. [H, W, D]"""
    image = rasterize_splats(*workload.inputs, workload.camera, settings=workload.settings, backend=backend).image
    if image.is_cuda:
        torch.cuda.synchronize()
    return image


def step(workload: Workload, backend: str, upstream: torch.Tensor) -> None:
    """Image of a workload, and gradients of all its inputs."""
    leaves = [tensor.detach().requires_grad_() for tensor in workload.inputs]
    drawn = rasterize_splats(*leaves, workload.camera, settings=workload.settings, backend=backend)
    drawn.image.backward(upstream)
    if upstream.is_cuda:
        torch.cuda.synchronize()


def move(workload: Workload) -> None:
    """Move the Gaussians of a scene to its time, from the arrays of its file."""
    assert workload.scene is not None
    scene_player.Player(workload.scene).frame(workload.t)


def play(workload: Workload, backend: str) -> None:
    """One frame of a scene, from its file's arrays to pixels."""
    assert workload.scene is not None
    frame = scene_player.Player(workload.scene).frame(workload.t)
    scene_renderer.render_frame(workload.scene, frame, workload.camera, backend=backend)


def _split(workload: Workload, threads: int, repeats: int) -> str:
    """Format the median wall time of each kernel in both passes."""
    upstream = make_upstream(workload)
    runs = {"forward": lambda: draw(workload, "cpu"), "forward_backward": lambda: step(workload, "cpu", upstream)}
    lines = []
    torch.set_num_threads(1)
    for name, run in runs.items():
        parts = ", ".join(f"{stage} {ms:.2f}" for stage, ms in stages.measure(run, repeats).items())
        lines.append(f"    {workload.name} {name}, {threads} threads, median wall ms: {parts}")
    return "\n".join(lines)


def _compare_images(peer: ModuleType, workload: Workload) -> str:
    """Print the difference between a peer's image and ours, to check that both did the same work."""
    if hasattr(peer, "supports") and not peer.supports(workload.name):
        return ""
    theirs = peer.forward(peer.prepare(workload.inputs, workload.camera))
    if not isinstance(theirs, torch.Tensor):
        return ""
    ours = draw(workload, "cpu")
    if theirs.shape != ours.shape:
        return f"{peer.NAME} on {workload.name}: image of shape {tuple(theirs.shape)}, ours {tuple(ours.shape)}\n"
    difference = (theirs.detach() - ours).abs()
    return (
        f"{peer.NAME} on {workload.name}: its image differs from ours by {difference.mean().item():.1e} on average, "
        f"{difference.max().item():.1e} at most\n"
    )


@contextmanager
def _rasterizer_threads(count: int) -> Iterator[None]:
    from r5dgs_core.raster import thread_pool

    before = thread_pool.threads()
    thread_pool.set_threads(count)
    try:
        yield
    finally:
        thread_pool.set_threads(before)


def _choose(options: argparse.Namespace) -> list[Callable[[], Workload]]:
    """Return makers of the requested workloads. Raises an error for wrong names before anything is measured."""
    names = [name for part in options.workloads or [] for name in part]
    if not names and options.scene is None:
        names = list(DEFAULT_WORKLOADS)
    if options.garden is not None:
        names.append(workloads.GARDEN)
    names = list(dict.fromkeys(names))
    for name in names:
        workloads.check(name, options.garden)
    chosen: list[Callable[[], Workload]] = [lambda name=name: workloads.make(name, options.garden) for name in names]
    if options.scene is not None:
        scene = scene_file.read(options.scene)
        camera = workloads.find_camera(scene, options.camera)
        t = scene.t_max if options.time is None else options.time
        posed = workloads.pose_scene(options.scene.stem, scene, camera, t)
        chosen.append(lambda: posed)
    return chosen


def _parser() -> argparse.ArgumentParser:
    listed, numbers = workloads.name_list, workloads.number_list
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0], epilog="Separate the items of lists by commas or spaces."
    )
    parser.add_argument(
        "--workloads",
        type=listed,
        nargs="+",
        help=f"of {', '.join(workloads.GENERATED)}; default {','.join(DEFAULT_WORKLOADS)}, none with --scene",
    )
    parser.add_argument("--garden", type=Path, help=f"gsplat's test_garden.npz: adds {workloads.GARDEN}")
    parser.add_argument("--scene", type=Path, help="a .r5dgs file: adds it as a workload, named as the file")
    parser.add_argument("--camera", default="0", help="of the scene: name, or number from 0; default 0")
    parser.add_argument("--time", type=float, help="scene time at which it is posed; default t_max")
    parser.add_argument("--backends", type=listed, nargs="+", default=[["cpu"]], help="of cpu, reference, cuda")
    parser.add_argument("--threads", type=numbers, nargs="+", default=[[1, 2]], help="default 1,2")
    parser.add_argument("--repeats", type=int, default=15, help="rounds; default 15")
    parser.add_argument("--peer", action="append", default=[], metavar="MODULE", help="another renderer; repeatable")
    parser.add_argument("--stages", action="store_true", help="also split the time of the backend cpu into its kernels")
    parser.add_argument("--json", type=Path, help="also write the rows to this file")
    return parser


if __name__ == "__main__":
    main()
