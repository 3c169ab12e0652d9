"""Processor time per training step while the live page bakes, and while it does not.

    python -m benchmarks.live_view [DATA] [--pairs N] [--seconds S] [--threads N] [--json FILE]

Trains a data set (by default the bundled one) in a process of its own. In every other period of ``--seconds``, by
default the minute after which `r5dgs view --live` bakes again, one `live_bake` runs as the live page starts it. The
order within a pair alternates, so that slow changes of the training cancel. ``ratio`` is the processor time per step
of a period with a bake divided by that of the other one of its pair, ``busy`` the share of the period that the bake
takes. Results: docs/results/training.md.
"""

from __future__ import annotations

import argparse
import json
import os
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
        self.step, self.seconds = 0, 0.0  # at the last report; processor seconds
        threading.Thread(target=self._follow, daemon=True).start()

    def _follow(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            event = json.loads(line)
            if event["event"] == "step":
                self.step, self.seconds = event["iteration"], event["cpu_seconds"]

    def period(self, seconds: float) -> float:
        """Processor milliseconds per step of the next period."""
        step, spent = self.step, self.seconds
        time.sleep(seconds)
        if self.process.poll() is not None or self.step == step:
            raise SystemExit("the training has ended or stands still")
        return 1e3 * (self.seconds - spent) / (self.step - step)


class Bake:
    """A bake as the live page starts it."""

    def __init__(self, run: Path, folder: Path):
        one = {name: "1" for name in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")}
        command = [sys.executable, "-m", "r5dgs_core.cli.live_bake", str(run), str(folder), "--idle"]
        self._began = time.monotonic()
        self._process = subprocess.Popen(command, env={**os.environ, **one}, start_new_session=True)
        self._seconds = 0.0
        self._waiting = threading.Thread(target=self._wait)
        self._waiting.start()

    def _wait(self) -> None:
        self._process.wait()
        self._seconds = time.monotonic() - self._began

    def seconds(self) -> float:
        """Seconds that the bake took, after its end."""
        self._waiting.join()
        if self._process.returncode:
            raise SystemExit("the bake failed")
        return self._seconds


def measure(data: Path, pairs: int, seconds: float, threads: int) -> list[dict[str, float]]:
    """Rows of all pairs."""
    rows = []
    with tempfile.TemporaryDirectory() as name:
        run, folder = Path(name, "run"), Path(name, "live")
        folder.mkdir()
        training = Training(data, run, threads)
        try:
            while training.step < WARM or not (run / live_run.CHECKPOINT).exists():
                time.sleep(1.0)
                if training.process.poll() is not None:
                    raise SystemExit("the training has ended")
            for number in range(pairs):
                spent, busy = {}, 0.0
                for baking in ((False, True), (True, False))[number % 2]:
                    bake = Bake(run, folder) if baking else None
                    spent[baking] = training.period(seconds)
                    busy = busy if bake is None else min(bake.seconds() / seconds, 1.0)
                rows.append({"off": spent[False], "on": spent[True], "ratio": spent[True] / spent[False], "busy": busy})
                print("  ".join(f"{key} {value:.4g}" for key, value in rows[-1].items()), flush=True)
        finally:
            training.process.kill()
            training.process.wait()
    return rows


def main() -> None:
    """Run the benchmark."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("data", type=Path, nargs="?", default=ROOT / "examples" / "tabletop")
    p.add_argument("--pairs", type=int, default=6)
    p.add_argument("--seconds", type=float, default=live_run.EVERY_S)
    p.add_argument("--threads", type=int, default=1, help="threads of the training (default: 1)")
    p.add_argument("--json", type=Path, help="file for the rows")
    args = p.parse_args()
    rows = measure(args.data, args.pairs, args.seconds, args.threads)
    ratios = sorted(row["ratio"] for row in rows)
    print(f"ratio, median of {len(rows)}: {statistics.median(ratios):.4f} ({ratios[0]:.4f} to {ratios[-1]:.4f})")
    if args.json is not None:
        args.json.write_text(json.dumps({"rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
