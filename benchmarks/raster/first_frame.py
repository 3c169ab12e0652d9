"""Seconds until the first frame of a new process.

    python -m benchmarks.raster first_frame [--json FILE]

Every row is the median of several processes, each with its own cache of compiled kernels in a temporary folder: empty
for ``cold``, filled by another process for ``warm``. ``import_s``: importing torch, numba and the core; ``first_s``:
from there to the first picture of the scene of `frames`, including motion; ``second_s``: the next picture. Results:
docs/results/rasterizer.md.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

COLUMNS = ("cache", "sh_degree", "sky_degree", "import_s", "first_s", "second_s")
TIMES = COLUMNS[3:]
ROOT = Path(__file__).resolve().parents[2]


def first_frame(count: int, size: int, sh_degree: int, sky_degree: int) -> dict[str, float]:
    """Seconds of the imports and of the first two frames. This process must not have drawn before."""
    start = time.perf_counter()
    from r5dgs_core.playback import scene_player
    from r5dgs_core.raster.cpu import autograd, sky  # noqa: F401  (all that frames import)
    from r5dgs_core.render import scene_renderer  # noqa: F401  (all that frames import)

    from . import frames

    imported = time.perf_counter()
    camera = frames.make_camera(size)
    scene = frames.make_scene(count, 6, sh_degree, sky_degree, camera)
    marks = [time.perf_counter()]
    for t in (0.1, 0.2):
        scene_renderer.render_frame(scene, scene_player.Player(scene).frame(t), camera)
        marks.append(time.perf_counter())
    return dict(zip(TIMES, (imported - start, marks[1] - marks[0], marks[2] - marks[1]), strict=True))


def in_fresh_process(cache: Path, options: argparse.Namespace, degrees: str) -> dict[str, float]:
    """`first_frame` in a process that keeps its kernels in a folder."""
    paths = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
    shape = ["--count", str(options.count), "--size", str(options.size)]
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.raster.first_frame", "--alone", degrees, *shape],
        env={**os.environ, "NUMBA_CACHE_DIR": str(cache), "PYTHONPATH": paths},
        stdout=subprocess.PIPE,
        stderr=None if options.verbose else subprocess.DEVNULL,
        check=True,
    )
    return json.loads(done.stdout)


def measure(options: argparse.Namespace, degrees: str) -> list[dict]:
    """Rows of cold and warm processes, which alternate."""
    found: dict[str, list[dict[str, float]]] = {"cold": [], "warm": []}
    for _ in range(options.repeats):
        with tempfile.TemporaryDirectory(prefix="r5dgs-first-frame-") as folder:
            for cache in found:
                found[cache].append(in_fresh_process(Path(folder), options, degrees))
    sh_degree, sky_degree = map(int, degrees.split(","))
    return [
        {
            "cache": cache,
            "sh_degree": sh_degree,
            "sky_degree": sky_degree,
            **{name: round(statistics.median(times[name] for times in runs), 4) for name in TIMES},
        }
        for cache, runs in found.items()
    ]


def main(arguments: list[str] | None = None) -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=40_000, help="Gaussians")
    parser.add_argument("--size", type=int, default=400, help="width and height in px")
    parser.add_argument("--degrees", nargs="+", default=["0,0", "3,2"], help="of colours and sky: SH,SKY")
    parser.add_argument("--repeats", type=int, default=3, help="processes of each kind")
    parser.add_argument("--json", type=Path, help="also write the rows to this file")
    parser.add_argument("--verbose", action="store_true", help="show the output of the processes, notices included")
    parser.add_argument("--alone", metavar="SH,SKY", help="measure in this process and print its times as JSON")
    options = parser.parse_args(arguments)
    if options.json and not options.json.parent.is_dir():
        parser.error(f"--json: no folder {options.json.parent}")
    if options.alone:
        sh_degree, sky_degree = map(int, options.alone.split(","))
        print(json.dumps(first_frame(options.count, options.size, sh_degree, sky_degree)))
        return
    rows = []
    print(" ".join(f"{column:>10}" for column in COLUMNS))
    for degrees in options.degrees:
        for row in measure(options, degrees):
            rows.append(row)
            print(" ".join(f"{row[column]!s:>10}" for column in COLUMNS), flush=True)
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
