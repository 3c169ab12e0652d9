"""Predictions of real tosses of a cube, from noisy poses of their beginning.

    python -m benchmarks.contact TOSSES [--which even|odd] [--until impact|share] [--samples N] [--json FILE]

TOSSES is the folder ``assets/contactnets_cube`` of https://github.com/DAIRLab/dair_pll (BSD-3): 550 tosses of a cube
of 10.5 cm on a table, poses and rates at 148 Hz. Each is observed at 30 Hz, with noise of 1 % of the width and 1 degree
per axis. ``impact`` stops before the first contact, ``share`` after 60 % of the toss. Rows:

    still      the last observed pose
    smooth     the motion law that `motion_fit` selects, without contacts
    known      with ``impact``: a simulation with the published friction 0.18 and restitution 0.125
    contact    a simulation whose friction, restitution and state were fitted; the band is that of its samples

Errors are those of the end of the toss: place in widths, rotation in degrees. ``covered`` is the share of
tosses whose end lies in the 90 % band, ``radius`` the median radius of the band, ``face_auroc`` how well the share of
samples on other faces than the predicted one finds predictions on a wrong face. Odd tosses tuned nothing.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
import torch

from r5dgs_core.contact import futures, identify, observed_track, simulation, stepping, world
from r5dgs_core.motion import models, rotations
from r5dgs_core.motion_fit import model_selection
from r5dgs_core.shapes import solid

WIDTH, RATE, OBSERVED = 0.1048, 148.0, 5  # metres, poses per second, every fifth pose is observed
TABLE = -0.0018  # height of the plane in which a resting cube's lowest corners are measured
PLACE_NOISE, TURN_NOISE = 0.01 * WIDTH, np.radians(1.0)
KNOWN = world.Material(0.18, 0.125)
SHARE = 0.6
UP = np.array([0.0, 0.0, 1.0])


def read(folder: Path, which: str) -> list[np.ndarray]:
    """Tosses with odd or even numbers: quaternions, places, body spins and velocities. [T, 13] each"""
    paths = sorted(folder.glob("*.pt"), key=lambda path: int(path.stem))
    if not paths:
        raise SystemExit(f"{folder}: expected the files 0.pt, 1.pt, ... of the data set, found none")
    chosen = [path for path in paths if int(path.stem) % 2 == (which == "odd")]
    return [torch.load(path, weights_only=True).numpy().reshape(-1, 13) for path in chosen]


def cube_world() -> world.World:
    """Cube in its own frame, over the table."""
    corners = 0.5 * WIDTH * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    plane = world.Plane(UP, TABLE)
    return world.World((world.Body(solid.of(corners)),), plane, np.array([0.0, 0.0, -9.81]))


def observe(toss: np.ndarray, until: str, place: world.World, rng: np.random.Generator) -> observed_track.Track | None:
    """Noisy poses of the beginning of a toss; None if they are fewer than three."""
    rows = np.arange(0, len(toss), OBSERVED)
    assert place.plane is not None
    gaps = world.gaps(place.bodies[0], place.plane, toss[:, 4:7], toss[:, :4])
    last = int(np.argmax(gaps < 0.004 - TABLE)) - 1 if until == "impact" else int(SHARE * len(toss))
    turns = rotations.rotvecs_to_quats(rng.normal(0, TURN_NOISE, (len(rows), 3)))
    quats = rotations.multiply(turns, rotations.normalize(toss[rows, :4]))
    places = toss[rows, 4:7] + rng.normal(0, PLACE_NOISE, (len(rows), 3))
    count = int((rows <= last).sum())
    if count < 3:
        return None
    ones = np.ones(count)
    return observed_track.Track(
        rows[:count] / RATE, quats[:count], places[:count], PLACE_NOISE * ones, TURN_NOISE * ones
    )


def study(toss: np.ndarray, until: str, samples: int, seed: int) -> dict[str, Any] | None:
    """Errors of all predictions of a toss."""
    rng, place = np.random.default_rng(seed), cube_world()
    track = observe(toss, until, place, rng)
    if track is None:
        return None
    truth, end = (toss[-1, :4], toss[-1, 4:7]), (len(toss) - 1) / RATE
    speed = float(np.linalg.norm(toss[:, 10:13], axis=1).max())
    draft = simulation.Simulation(place, stepping.choose(speed, WIDTH, 9.81, end, draft=True))
    fitter = identify.Fitter(draft, track)
    estimate = fitter.run()
    future = np.array([end])
    found = {
        "still": (track.quats[-1], track.places[-1]),
        "smooth": _smooth(track, end),
        "contact": _last(fitter.poses(estimate.state, estimate.material, future - estimate.time)),
    }
    if until == "impact":
        exact = fitter.run(identify.Prior(KNOWN, 1e-3, 1e-3))
        found["known"] = _last(fitter.poses(exact.state, KNOWN, future - exact.time))
    row: dict[str, Any] = {name: _errors(pose, truth) for name, pose in found.items()}
    sampled = futures.sample(fitter, estimate, future, samples, rng)
    center = np.median(sampled.places, axis=1)
    apart = float(np.linalg.norm(center - truth[1]))
    radius = float(sampled.radii(center, 0.9)[0])
    row |= {"covered": apart <= radius, "radius": radius / WIDTH}
    row["other_faces"] = sampled.other_faces(found["contact"][0], UP)
    row["wrong_face"] = bool(futures.on_other_face(found["contact"][0], rotations.normalize(truth[0]), UP))
    row |= {"friction": estimate.material.friction, "restitution": estimate.material.restitution}
    return row


def _last(poses: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    return poses[0][-1], poses[1][-1]


def _smooth(track: observed_track.Track, end: float) -> tuple[np.ndarray, np.ndarray]:
    """Prediction of the law that is fitted to the poses without contacts."""
    last = track.quats[-1], track.places[-1]
    quats = rotations.multiply(track.quats, rotations.conjugate(last[0]))
    fit = model_selection.fit(track.times, quats, track.places - last[1], radius=0.5 * WIDTH, up=UP)
    turn, moved = models.evaluate(fit.model, end - track.times[-1])
    return rotations.multiply(turn, last[0]), last[1] + moved


def _errors(pose: tuple[np.ndarray, np.ndarray], truth: tuple[np.ndarray, np.ndarray]) -> tuple[float, float]:
    angle = np.degrees(rotations.angle_between(pose[0], rotations.normalize(truth[0])))
    return float(np.linalg.norm(pose[1] - truth[1]) / WIDTH), float(angle)


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Medians and 90 % quantiles over tosses."""
    result: dict[str, Any] = {"tosses": len(rows)}
    for name in (name for name in ("still", "smooth", "known", "contact") if name in rows[0]):
        errors = np.array([row[name] for row in rows])
        result[name] = {
            "place": np.median(errors[:, 0]),
            "place_90": np.quantile(errors[:, 0], 0.9),
            "turn": np.median(errors[:, 1]),
            "turn_90": np.quantile(errors[:, 1], 0.9),
        }
    wrong = np.array([row["wrong_face"] for row in rows])
    result |= {
        "covered": np.mean([row["covered"] for row in rows]),
        "radius": np.median([row["radius"] for row in rows]),
        "wrong_faces": wrong.mean(),
        "face_auroc": _auroc(np.array([row["other_faces"] for row in rows]), wrong),
        "friction": np.quantile([row["friction"] for row in rows], [0.1, 0.5, 0.9]).tolist(),
        "restitution": np.quantile([row["restitution"] for row in rows], [0.1, 0.5, 0.9]).tolist(),
    }
    return result


def _auroc(scores: np.ndarray, wrong: np.ndarray) -> float | None:
    if wrong.all() or not wrong.any():
        return None
    pairs = scores[wrong][:, None] - scores[~wrong][None]
    return float(((pairs > 0) + 0.5 * (pairs == 0)).mean())


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tosses", type=Path)
    parser.add_argument("--which", choices=("even", "odd"), default="even")
    parser.add_argument("--until", choices=("impact", "share"), default="share")
    parser.add_argument("--samples", type=int, default=64)
    parser.add_argument("--stride", type=int, default=1, help="take every n-th toss")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    rows = []
    for number, toss in enumerate(read(args.tosses, args.which)[:: args.stride]):
        row = study(toss, args.until, args.samples, number)
        if row is not None:
            rows.append(row)
    found = summary(rows)
    print(json.dumps(found, indent=1, default=float))
    if args.json is not None:
        args.json.write_text(json.dumps({"summary": found, "rows": rows}, indent=1, default=float) + "\n")


if __name__ == "__main__":
    main()
