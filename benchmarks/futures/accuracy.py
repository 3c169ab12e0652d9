"""Accuracy of predicted motion on simulated tracks: error, confidence band, events, run time.

    python -m benchmarks.futures accuracy [--draws 20] [--noise white ...] [--motions NAME ...] [--json FILE]

Tracks of 15 poses on [0, 0.75] are drawn by `simulated_motions` and fitted by `model_selection.fit`. Columns:

    error      median error at t = 1 over a ball of the body's radius, in % of the body's size; 90 % quantile
    line       median error of a straight line and a constant spin through the last five poses
    still      median error of keeping the last pose
    holds      share of the later times at which the error is inside the 95 % band
    width      median half width of the band at t = 1, in % of the body's size
    flagged    share of tracks reported as not predictable up to t = 1
    events     share of tracks with an event; of those with true events, share found within one step; share of the
               jumps above five noise sigmas that were found
    ms         processor time per track
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from r5dgs_core.motion import models
from r5dgs_core.motion_fit import model_selection

from . import simulated_motions as simulated

BAD = 20.0  # % of the size


def _quats(turns: Rotation) -> np.ndarray:
    return np.roll(turns.as_quat(), 1, axis=-1)


def _turns(quats: np.ndarray) -> Rotation:
    return Rotation.from_quat(np.roll(quats, -1, axis=-1))


def line(track: simulated.Draw, count: int = 5) -> float:
    """Error at t = 1 of a straight line and a constant spin through the last poses, in % of the size."""
    t, last = track.times[-count:], track.turns[-1]
    slope, place = np.polyfit(t, track.places[-count:], 1)
    turned = np.concatenate([np.zeros((1, 3)), (track.turns[-count + 1 :] * track.turns[-count:-1].inv()).as_rotvec()])
    spin = np.polyfit(t, np.cumsum(turned, axis=0), 1)[0]
    end = track.later[-1]
    turns = Rotation.from_rotvec(spin * (track.later - t[-1])[:, None]) * last
    return float(simulated.errors(place + slope * track.later[:, None], turns, track)[end == track.later][0])


def still(track: simulated.Draw) -> float:
    """Error at t = 1 of keeping the last pose, in % of the size."""
    count = len(track.later)
    turns = Rotation.concatenate([track.turns[-1]] * count)
    return float(simulated.errors(np.tile(track.places[-1], (count, 1)), turns, track)[-1])


def measure(name: str, noise: simulated.Noise, seed: int) -> dict[str, Any]:
    """Fit one draw and compare it with its truth."""
    track = simulated.draw(name, noise, seed)
    relative = track.turns * track.turns[-1].inv()
    start = time.process_time()
    fit = model_selection.fit(
        track.times, _quats(relative), track.places - track.places[-1], radius=simulated.RADIUS, inertia=track.inertia
    )
    spent = 1e3 * (time.process_time() - start)
    tau = track.later - track.times[-1]
    quats, moved = models.evaluate(fit.model, tau)
    error = simulated.errors(track.places[-1] + moved, _turns(quats) * track.turns[-1], track)
    band = fit.history.band
    assert band is not None
    half = 50 / simulated.RADIUS * band.widths(track.later)
    step = track.times[1] - track.times[0]
    found = [event.time for event in fit.history.events]
    times = [event for event in track.motion.events if event < track.times[-1]]
    last = max(times, default=None)
    near = last is not None and any(abs(event - last) <= step for event in found)
    sigma = 2 * simulated.RADIUS * noise.place / step  # of a velocity between neighbouring poses
    return {
        "error": float(error[-1]),
        "line": line(track),
        "still": still(track),
        "inside": float((error <= half).mean()),
        "width": float(half[-1]),
        "flagged": band.predictable_until is not None and bool(band.predictable_until < track.later[-1]),
        "event": bool(found),
        "near": near if times else None,
        "recalled": near if times and track.motion.jump > 5 * sigma else None,
        "chosen": fit.chosen,
        "ms": spent,
    }


def summary(name: str, noise: str, found: list[dict[str, Any]]) -> dict[str, Any]:
    """Row of the table."""

    def share(key: str) -> float:
        values = [row[key] for row in found if row[key] is not None]
        return float(np.mean(values)) if values else float("nan")

    def quantile(key: str, q: float = 0.5) -> float:
        return float(np.quantile([row[key] for row in found], q))

    names, counts = np.unique([row["chosen"] for row in found], return_counts=True)
    return {
        "noise": noise,
        "motion": name,
        "error": quantile("error"),
        "error_90": quantile("error", 0.9),
        "line": quantile("line"),
        "still": quantile("still"),
        "holds": share("inside"),
        "width": quantile("width"),
        "flagged": share("flagged"),
        "event": share("event"),
        "near": share("near"),
        "recalled": share("recalled"),
        "ms": quantile("ms"),
        "chosen": {str(names[i]): int(counts[i]) for i in np.argsort(-counts)[:4]},
    }


HEAD = (
    f"{'noise':10} {'motion':28} {'error (90 %)':>14} {'line':>6} {'still':>6} {'holds':>5} {'width':>6} "
    f"{'flag':>5} {'event':>5} {'near':>5} {'big':>5} {'ms':>5}  chosen"
)


def text(row: dict[str, Any]) -> str:
    """Row as a line of the table."""
    return (
        "{noise:10} {motion:28} {error:6.1f} ({error_90:5.1f}) {line:6.1f} {still:6.1f} {holds:5.2f} {width:6.1f} "
        "{flagged:5.2f} {event:5.2f} {near:5.2f} {recalled:5.2f} {ms:5.0f}  ".format(**row)
        + ", ".join(f"{name} {count}" for name, count in row["chosen"].items())
    )


def overall(found: list[dict[str, Any]]) -> dict[str, float]:
    """Coverage, and the quality of the flag, over all tracks of a noise."""
    bad = [row["flagged"] for row in found if row["error"] > BAD]
    good = [row["flagged"] for row in found if row["error"] <= BAD]
    return {
        "tracks": len(found),
        "holds": float(np.mean([row["inside"] for row in found])),
        "failures": len(bad),
        "failures_flagged": float(np.mean(bad)) if bad else float("nan"),
        "false_alarms": float(np.mean(good)) if good else float("nan"),
    }


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=20, metavar="N")
    parser.add_argument("--first", type=int, default=0, metavar="SEED", help="seed of the first draw")
    parser.add_argument("--noise", nargs="+", choices=list(simulated.NOISES), default=["white"])
    parser.add_argument("--motions", nargs="+", choices=list(simulated.MOTIONS), default=list(simulated.MOTIONS))
    parser.add_argument("--json", type=Path, metavar="FILE")
    options = parser.parse_args()
    rows, totals = [], {}
    print(HEAD)
    for noise in options.noise:
        everything = []
        for name in options.motions:
            seeds = range(options.first, options.first + options.draws)
            found = [measure(name, simulated.NOISES[noise], seed) for seed in seeds]
            rows.append(summary(name, noise, found))
            everything += found
            print(text(rows[-1]), flush=True)
        totals[noise] = overall(everything)
        print(noise, {key: round(value, 3) for key, value in totals[noise].items()}, flush=True)
    if options.json:
        options.json.write_text(json.dumps({"draws": options.draws, "rows": rows, "totals": totals}, indent=1) + "\n")


if __name__ == "__main__":
    main()
