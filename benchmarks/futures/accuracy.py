"""Accuracy of predicted motion on simulated tracks: error, confidence band, events, run time.

    python -m benchmarks.futures accuracy [--draws 20] [--noise white ...] [--motions NAME ...] [--json FILE]

A long run can be split: write parts with --tracks, and tabulate them with --merge.

Tracks of 15 poses on [0, 0.75] are drawn by `simulated_tracks` and fitted by `model_selection.fit`. Columns:

    error      median error at t = 1 over a ball of the body's radius, in % of the body's size; 90 % quantile
    line       median error of a straight line and a constant spin through the last five poses
    still      median error of keeping the last pose
    holds      share of the later times at which the error is inside the 95 % band
    width      median half width of the band at t = 1, in % of the body's size
    flagged    share of tracks reported as not predictable up to t = 1
    event      share of tracks with an event
    found      share of the true events that were found within one time step
    big        the same for those with velocity jumps above five standard deviations of a velocity between neighbours
    surplus    found events without a true event within one time step, per track
    slip       share of tracks with a slipped rotation
    ms         processor time per track

The totals of a noise are: tracks; errors inside the band; median half width; failures (error above 20 % of the size),
the share of them that is flagged, and the share of the other tracks that is flagged; found events, big and all; surplus
events per track; and the share of tracks without true events in which an event was found.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from r5dgs_core.motion import models
from r5dgs_core.motion_fit import model_selection
from r5dgs_core.motion_fit import noise as noises

from . import scoring
from . import simulated_tracks as simulated


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
        track.times,
        _quats(relative),
        track.places - track.places[-1],
        radius=simulated.RADIUS,
        inertia=track.inertia,
        least_noise=noises.of_images(simulated.RADIUS) if noise.slow else (0.0, 0.0),
        drift=track.claimed,
    )
    spent = 1e3 * (time.process_time() - start)
    tau = track.later - track.times[-1]
    quats, moved = models.evaluate(fit.model, tau)
    error = simulated.errors(track.places[-1] + moved, _turns(quats) * track.turns[-1], track)
    band = fit.history.band
    assert band is not None
    half = scoring.half_widths(band, track.later, 2 * simulated.RADIUS)
    step = track.times[1] - track.times[0]
    found = [event.time for event in fit.history.events]
    true = [event for event in track.motion.events if event < track.times[-1]]
    sigma = 2 * simulated.RADIUS * noise.place / step  # of a velocity between neighbouring poses
    big = track.motion.jump > 5 * sigma
    return {
        "error": float(error[-1]),
        "line": line(track),
        "still": still(track),
        "inside": float((error <= half).mean()),
        "width": float(half[-1]),
        "flagged": scoring.flagged(band, track.later[-1]),
        "widest": float(half.max()),
        "event": bool(found),
        "true": len(true),
        "found": sum(any(abs(time - event) <= step for time in found) for event in true),
        "big": len(true) if big else 0,
        "surplus": sum(all(abs(time - event) > step for event in true) for time in found),
        "slip": bool(fit.slips),
        "chosen": fit.chosen,
        "ms": spent,
    }


def _recall(found: list[dict[str, Any]]) -> float:
    """Share of true events that were found; NaN without any."""
    true = sum(row["true"] for row in found)
    return sum(row["found"] for row in found) / true if true else float("nan")


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
        "found": _recall(found),
        "big": _recall([row for row in found if row["big"]]),
        "surplus": share("surplus"),
        "slip": share("slip"),
        "ms": quantile("ms"),
        "chosen": {str(names[i]): int(counts[i]) for i in np.argsort(-counts)[:4]},
    }


HEAD = (
    f"{'noise':10} {'motion':28} {'error (90 %)':>14} {'line':>6} {'still':>6} {'holds':>5} {'width':>6} "
    f"{'flag':>5} {'event':>5} {'found':>5} {'big':>5} {'more':>5} {'slip':>5} {'ms':>5}  chosen"
)


def text(row: dict[str, Any]) -> str:
    """Row as a line of the table."""
    return (
        "{noise:10} {motion:28} {error:6.1f} ({error_90:5.1f}) {line:6.1f} {still:6.1f} {holds:5.2f} {width:6.1f} "
        "{flagged:5.2f} {event:5.2f} {found:5.2f} {big:5.2f} {surplus:5.2f} {slip:5.2f} {ms:5.0f}  ".format(**row)
        + ", ".join(f"{name} {count}" for name, count in row["chosen"].items())
    )


MARKDOWN = (
    "| motion | draws | error, median (90 %) | line | still | holds | width | flagged | with an event | events found |",
    "|---|---|---|---|---|---|---|---|---|---|",
)
MARKDOWN_TOTALS = (
    "| noise | tracks | errors inside the band | half width, median | failures | of these flagged | false alarms "
    "| jumps above 5 sigma found | smooth tracks with an event |",
    "|---|---|---|---|---|---|---|---|---|",
)


def _share(value: float, digits: int) -> str:
    return "-" if math.isnan(value) else f"{value:.{digits}f}"


def markdown(row: dict[str, Any]) -> str:
    """Row as a line of the tables in docs/results/predicted_motion.md."""

    def percent(value: float) -> str:
        return f"{value:.1f}" if value < 99.95 else f"{value:.0f}"

    cells = [
        row["motion"],
        str(row["draws"]),
        f"{percent(row['error'])} ({percent(row['error_90'])})",
        *(percent(row[key]) for key in ("line", "still")),
        f"{row['holds']:.2f}",
        percent(row["width"]),
        *(f"{row[key]:.2f}" for key in ("flagged", "event")),
        _share(row["found"], 2),
    ]
    return f"| {' | '.join(cells)} |"


def markdown_totals(noise: str, total: dict[str, float]) -> str:
    """Totals of a noise as a line of the table of all noises in docs/results/predicted_motion.md."""
    flagged = total["failures_flagged"] * total["failures"] if total["failures"] else 0.0
    cells = [
        noise,
        str(total["tracks"]),
        f"{total['holds']:.3f}",
        f"{total['width']:.1f}",
        str(total["failures"]),
        f"{flagged:.0f}",
        *(_share(total[key], 3) for key in ("false_alarms", "big_events_found", "smooth_with_event")),
    ]
    return f"| {' | '.join(cells)} |"


def overall(found: list[dict[str, Any]]) -> dict[str, float]:
    """Coverage, median half width, quality of the flag, and found events, over all tracks of a noise."""
    bad = [row["flagged"] for row in found if row["error"] > scoring.BAD]
    good = [row["flagged"] for row in found if row["error"] <= scoring.BAD]
    smooth = [row["event"] for row in found if row["true"] == 0]
    return {
        "tracks": len(found),
        "holds": float(np.mean([row["inside"] for row in found])),
        "width": float(np.median([row["width"] for row in found])),
        "failures": len(bad),
        "failures_flagged": float(np.mean(bad)) if bad else float("nan"),
        "false_alarms": float(np.mean(good)) if good else float("nan"),
        "big_events_found": _recall([row for row in found if row["big"]]),
        "events_found": _recall(found),
        "surplus_events": float(np.mean([row["surplus"] for row in found])),
        "smooth_with_event": float(np.mean(smooth)) if smooth else float("nan"),
    }


def _defined(value: Any) -> Any:
    """Return a JSON tree with None instead of NaN."""
    if isinstance(value, dict):
        return {key: _defined(one) for key, one in value.items()}
    if isinstance(value, list):
        return [_defined(one) for one in value]
    return None if isinstance(value, float) and math.isnan(value) else value


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=20, metavar="N")
    parser.add_argument("--first", type=int, default=0, metavar="SEED", help="seed of the first draw")
    parser.add_argument("--noise", nargs="+", choices=list(simulated.NOISES), default=["white"])
    parser.add_argument("--motions", nargs="+", choices=list(simulated.MOTIONS), default=list(simulated.MOTIONS))
    parser.add_argument("--json", type=Path, metavar="FILE")
    parser.add_argument("--tracks", type=Path, metavar="FILE", help="write the results of all tracks, as JSON")
    parser.add_argument("--merge", type=Path, nargs="+", metavar="FILE", help="tabulate files of --tracks instead")
    parser.add_argument("--markdown", action="store_true", help="print the tables of the documentation")
    options = parser.parse_args()
    rows, totals, tracks = [], {}, []
    merged = [track for path in options.merge or () for track in json.loads(path.read_text())]
    if not options.markdown:
        print(HEAD)
    for noise in options.noise:
        everything = []
        if options.markdown:
            print(f"{noise}\n\n{MARKDOWN[0]}\n{MARKDOWN[1]}")
        for name in options.motions:
            seeds = range(options.first, options.first + options.draws)
            if options.merge:
                found = [track for track in merged if (track["noise"], track["motion"]) == (noise, name)]
            else:
                found = [measure(name, simulated.NOISES[noise], seed) for seed in seeds]
            if not found:
                continue
            rows.append({"draws": len(found), **summary(name, noise, found)})
            everything += found
            print(markdown(rows[-1]) if options.markdown else text(rows[-1]), flush=True)
            tracks += [{**row, "noise": noise, "motion": name} for row in found]
        totals[noise] = overall(everything)
        if options.markdown:
            print(flush=True)
        else:
            print(noise, {key: round(value, 3) for key, value in totals[noise].items()}, flush=True)
    if options.markdown:
        print("\n".join([*MARKDOWN_TOTALS, *(markdown_totals(noise, total) for noise, total in totals.items())]))
    if options.tracks:
        options.tracks.write_text(json.dumps(tracks) + "\n")
    if options.json:
        result = _defined({"rows": rows, "totals": totals})
        options.json.write_text(json.dumps(result, indent=1, allow_nan=False) + "\n")


if __name__ == "__main__":
    main()
