"""Time to load a scene in Blender.

    python benchmarks/load.py [--json FILE]

In Blender instead of bpy: ``blender -b --factory-startup --python benchmarks/load.py -- [--json FILE]``. Synthetic
scenes of twelve moving bodies are loaded into an empty file in turn, ``--rounds`` times. ``wall`` and ``cpu`` are the
minimum wall and processor seconds of the whole operator; ``read``, ``keys`` and ``rest`` are the processor seconds of
reading the file, writing keys, and creating objects and points. ``mb`` is the file size. Results:
docs/results/blender.md.
"""

import argparse
import importlib
import json
import sys
import tempfile
import time
from pathlib import Path

import bpy

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from tests.blender import check_playback, run  # noqa: E402  (the line before finds them)

CASES = ((40_000, 0), (40_000, 3), (1_000_000, 0), (1_000_000, 3))  # Gaussians, degree of the harmonics
COLUMNS = ("gaussians", "sh_degree", "mb", "wall", "cpu", "read", "keys", "rest")


class Clock:
    """Sums up the processor time of a function of a module while it is open."""

    def __init__(self, module, name: str):
        self.module, self.name, self.seconds = module, name, 0.0

    def __enter__(self):
        self.function = getattr(self.module, self.name)

        def timed(*arguments, **named):
            started = time.process_time()
            try:
                return self.function(*arguments, **named)
            finally:
                self.seconds += time.process_time() - started

        setattr(self.module, self.name, timed)
        return self

    def __exit__(self, *_):
        setattr(self.module, self.name, self.function)


def measure(path: Path, rounds: int, package: str) -> dict[str, float]:
    """Times of a scene, from the round with the least processor time."""
    reading = importlib.import_module(f"{package}.r5dgs_core.scene.scene_file")
    keying = importlib.import_module(f"{package}.r5dgs_addon.motion.keyframes")
    found = []
    for _ in range(rounds):
        with Clock(reading, "read") as read, Clock(keying, "animate") as keys:
            _, wall, cpu = run.load(path)
        rest = cpu - read.seconds - keys.seconds
        found.append({"wall": wall, "cpu": cpu, "read": read.seconds, "keys": keys.seconds, "rest": rest})
    return {**min(found, key=lambda row: row["cpu"]), "wall": min(row["wall"] for row in found)}


def main(arguments: list[str]) -> None:
    """Measure and print a table."""
    parser = argparse.ArgumentParser(description="Measure the time to load a scene in Blender.")
    parser.add_argument("--json", type=Path, help="write the rows to this file")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--gaussians", type=int, nargs="*", help="only scenes of these sizes")
    options = parser.parse_args(arguments)
    package = check_playback.extension_package()
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for count, degree in CASES:
            if options.gaussians and count not in options.gaussians:
                continue
            path = run.synthetic(count, Path(folder), degree)
            size = {"gaussians": count, "sh_degree": degree, "mb": path.stat().st_size / 1e6}
            rows.append({**size, **measure(path, options.rounds, package)})
            path.unlink()
    print(f"Blender {bpy.app.version_string}")
    print("".join(f"{name:>10}" for name in COLUMNS))
    for row in rows:
        print(
            "".join(f"{row[name]:>10.2f}" if isinstance(row[name], float) else f"{row[name]:>10}" for name in COLUMNS)
        )
    if options.json:
        options.json.write_text(json.dumps({"blender": bpy.app.version_string, "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main(sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:])
