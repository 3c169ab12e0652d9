"""Time per training step while the live page bakes, and while it does not.

    python -m benchmarks.live_view [DATA] [--pairs N] [--seconds S] [--threads N] [--json FILE]

Trains a data set (by default the bundled one) in a process of its own. `r5dgs view --live` bakes during a tenth of
the time at most; here bakes follow each other without a pause, and are suspended in every other period of
``--seconds``. The order within a pair of periods alternates, so that slow changes of the training cancel. ``wall`` and
``processor`` are the milliseconds per step of the periods with a bake divided by those of the others. Results:
docs/results/player.md.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

from r5dgs_core.cli import live_run

ROOT = Path(__file__).resolve().parents[1]
LOG_EVERY = 5  # steps between two reports
NEVER = 10_000_000  # steps
WARM = 1000  # steps before the first period


class Training:
    """A training process that reports its steps."""

    def __init__(self, data: Path, run: Path, threads: int):
        settings = [f"train.iterations={NEVER}", f"train.log_every={LOG_EVERY}", "train.checkpoint_every=100"]
        command = [sys.executable, "-m", "r5dgs_core.cli", "train", str(data), "--out", str(run), "--progress", "json"]
        for setting in settings:
            command += ["--set", setting]
        command += ["--threads", str(threads)]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
        self.last = (0, 0.0, 0.0)  # step, seconds and processor seconds of the last report
        threading.Thread(target=self._follow, daemon=True).start()

    def _follow(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            event = json.loads(line)
            if event["event"] == "step":
                self.last = (event["iteration"], time.monotonic(), event["cpu_seconds"])

    def period(self, seconds: float) -> tuple[float, float]:
        """Milliseconds and processor milliseconds per step of the next period."""
        before = self.last
        time.sleep(seconds)
        steps, wall, processor = (now - then for now, then in zip(self.last, before, strict=True))
        if self.process.poll() is not None or not steps:
            raise SystemExit("the training has ended or stands still")
        return 1e3 * wall / steps, 1e3 * processor / steps


class Bakes:
    """Bakes as the live page starts them, one after another, until `end`."""

    def __init__(self, run: Path, folder: Path):
        self._command = [sys.executable, "-m", "r5dgs_core.cli.live_bake", str(run), str(folder), "--idle"]
        self._ended, self._running = False, True
        self.seconds: list[float] = []  # processor seconds of each finished bake
        self._begin()
        self._thread = threading.Thread(target=self._repeat)
        self._thread.start()

    def _begin(self) -> None:
        one = {name: "1" for name in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")}
        self._process = subprocess.Popen(self._command, env={**os.environ, **one}, start_new_session=True)
        self.run(self._running)

    def _repeat(self) -> None:
        while True:
            _, status, usage = os.wait4(self._process.pid, 0)
            self._process.returncode = os.waitstatus_to_exitcode(status)
            if self._ended or self._process.returncode:
                return
            self.seconds.append(usage.ru_utime + usage.ru_stime)
            self._begin()

    def run(self, running: bool) -> None:
        """Continue or suspend the bake."""
        self._running = running
        if self._process.returncode:
            raise SystemExit("a bake failed")
        self._process.send_signal(signal.SIGCONT if running else signal.SIGSTOP)

    def end(self) -> None:
        """Stop the bake for good."""
        self._ended = True
        self._process.kill()
        self._thread.join()


def measure(data: Path, pairs: int, seconds: float, threads: int) -> dict[str, list[float]]:
    """Ratios of all pairs and processor seconds of the bakes."""
    ratios: dict[str, list[float]] = {"wall": [], "processor": []}
    with tempfile.TemporaryDirectory() as name:
        run, folder = Path(name, "run"), Path(name, "live")
        folder.mkdir()
        training = Training(data, run, threads)
        bakes: Bakes | None = None
        try:
            while training.last[0] < WARM or not (run / live_run.CHECKPOINT).exists():
                time.sleep(1.0)
                if training.process.poll() is not None:
                    raise SystemExit("the training has ended")
            bakes = Bakes(run, folder)
            for number in range(pairs):
                spent: dict[bool, tuple[float, float]] = {}
                for baking in ((False, True), (True, False))[number % 2]:
                    bakes.run(baking)
                    spent[baking] = training.period(seconds)
                for kind, on, off in zip(ratios, spent[True], spent[False], strict=True):
                    ratios[kind].append(on / off)
        finally:
            training.process.kill()
            training.process.wait()
            if bakes is not None:
                bakes.end()
    return {**ratios, "bake_seconds": bakes.seconds if bakes else []}


def interval(values: list[float]) -> tuple[float, float, float]:
    """Median of values and the bounds of its 95 % confidence interval (order statistics)."""
    ordered = sorted(values)
    half = 0.98 * len(ordered) ** 0.5
    low, high = int(len(ordered) / 2 - half), int(len(ordered) / 2 + half + 0.5)
    return statistics.median(ordered), ordered[max(low, 0)], ordered[min(high, len(ordered) - 1)]


def main() -> None:
    """Run the benchmark."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("data", type=Path, nargs="?", default=ROOT / "examples" / "tabletop")
    p.add_argument("--pairs", type=int, default=60)
    p.add_argument("--seconds", type=float, default=5.0)
    p.add_argument("--threads", type=int, default=1, help="threads of the training (default: 1)")
    p.add_argument("--json", type=Path, help="file for the ratios")
    args = p.parse_args()
    found = measure(args.data, args.pairs, args.seconds, args.threads)
    for kind in ("wall", "processor"):
        median, low, high = interval(found[kind])
        print(f"{kind}: median of {args.pairs} pairs {median:.4f}, 95 % interval {low:.4f} to {high:.4f}")
    if found["bake_seconds"]:
        print(f"processor seconds of a bake: {statistics.median(found['bake_seconds']):.1f}")
    if args.json is not None:
        args.json.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
