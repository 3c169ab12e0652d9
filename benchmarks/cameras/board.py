"""A real capture: a ChArUco board that a person carries through a room, from the videos to its poses.

    python -m benchmarks.cameras board FOLDER [--masks corners|features|none] [--without-camera NAME] [--lines 360]
        [--set KEY=VALUE] [--keep FOLDER] [--json FILE]

FOLDER is a session of caliscope with videos, ``camera_array.toml`` and the board's corners
(``mprib/caliscope``, ``tests/sessions/post_optimization``). The videos are prepared with every eighth moment held out.
With ``--masks corners``, the masks are the board's rectangle, from its corners in the world; views in which fewer than
four corners were found are unknown there. The true poses of the board are those of its corners. One constant rigid
offset between the trained group and the board is fitted over the clip, and nothing else. With ``--masks features`` and
``--masks none``, the groups that are found are compared with the masks from the corners. The corners in the world were
triangulated from those in the images; where they do not agree, the cameras did not record at the same moment, and the
true poses are wrong. ``true_mm_each`` and ``true_degrees_each`` are the largest changes of a pose that is fitted to the
corners in the images, if one camera is left out. Results: docs/results/captures.md.
"""

from __future__ import annotations

import argparse
import csv
import json
import tempfile
import time
from collections import defaultdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy import optimize
from scipy.spatial.transform import Rotation

from r5dgs_core.bake import bake
from r5dgs_core.cli.commands import prepare
from r5dgs_core.config import config
from r5dgs_core.data import dataset as datasets
from r5dgs_core.data import images, masks, unexplained
from r5dgs_core.evaluation import evaluate, ground_truth_poses, metrics
from r5dgs_core.prepare.plan import Plan
from r5dgs_core.render import warm_up
from r5dgs_core.scene.scene import Scene
from r5dgs_core.train import run

RECORDING = Path("calibration") / "extrinsic"
CORNERS = RECORDING / "CHARUCO"
LEAST = 4  # corners of a view with a mask, and of a posed board
EDGE = 20  # points per side of the rectangle, which the lens bends


class Board:
    """The board's true poses, and its corners in the images.

    Args:
        folder: The session.

    Attributes:
        moments: Numbers of the moments, increasing. [T]
        poses: Board to world; the identity if it is unknown. [T, 4, 4]
        posed: True if the pose is known. [T] bool
        outline: Corners of the printed rectangle, board axes, m. [4, 3]
    """

    def __init__(self, folder: Path):
        own, world = {}, defaultdict(dict)
        self._found: dict[tuple[int, int], dict[int, list[float]]] = defaultdict(dict)
        for row in _rows(folder / CORNERS / "xy_CHARUCO.csv"):
            key = int(row["keypoint_id"])
            own[key] = [float(row[f"obj_loc_{axis}"]) for axis in "xyz"]
            pixel = [float(row[f"img_loc_{axis}"]) for axis in "xy"]
            self._found[int(row["sync_index"]), int(row["cam_id"])][key] = pixel
        for row in _rows(folder / CORNERS / "xyz_CHARUCO.csv"):
            place = [float(row[f"{axis}_coord"]) for axis in "xyz"]
            world[int(row["sync_index"])][int(row["keypoint_id"])] = place
        self._times = defaultdict(list)
        for row in _rows(folder / RECORDING / "timestamps.csv"):
            self._times[int(row["sync_index"])].append(float(row["frame_time"]))
        self.moments = np.array(sorted(self._times))
        self.poses, self.posed = np.tile(np.eye(4), (len(self.moments), 1, 1)), np.zeros(len(self.moments), bool)
        for row, moment in enumerate(self.moments):
            ids = sorted(world[moment])
            if len(ids) >= LEAST:
                self.poses[row], self.posed[row] = _rigid([own[k] for k in ids], [world[moment][k] for k in ids]), True
        self._own, self._world = own, world
        every = np.array(list(own.values()))
        side = every[:, 0].min()
        width, height = every[:, :2].max(0) + side
        self.outline = np.array([[0, 0, 0], [width, 0, 0], [width, height, 0], [0, height, 0]])

    def times(self, zero: float, unit: float) -> np.ndarray:
        """Return the scene times of the moments, the means of the cameras' times. [T]

        Args:
            zero: Time of scene time 0, s from the first frame of all.
            unit: Seconds per unit of scene time.
        """
        times = np.array([np.mean(self._times[moment]) for moment in self.moments])
        return (times - min(min(found) for found in self._times.values()) - zero) / unit

    def mask(self, row: int, camera: int, plan: Plan, number: int) -> np.ndarray:
        """Return the ids of a frame. [H, W] uint16"""
        one = plan.cameras[number]
        ids = np.zeros((one.source.height, one.source.width), np.uint16)
        if not self.posed[row]:
            return ids
        share = np.arange(EDGE)[:, None] / EDGE
        ring = [a + share * (b - a) for a, b in zip(self.outline, np.roll(self.outline, -1, 0), strict=True)]
        pixels = _pixels(plan, number, np.concatenate(ring) @ self.poses[row, :3, :3].T + self.poses[row, :3, 3])
        if np.isfinite(pixels).all():
            known = len(self._found[int(self.moments[row]), camera]) >= LEAST
            corners = np.round((pixels - 0.5) * 16).astype(np.int32)
            cv2.fillPoly(ids, [corners], 1 if known else masks.UNKNOWN, shift=4)
        return ids

    def disagreement(self, row: int, plan: Plan) -> float:
        """Return how far the corners found in a moment are from those in the world: rms of the worst camera, px."""
        moment, worst = int(self.moments[row]), 0.0
        for number, camera in enumerate(plan.cameras):
            found = self._corners(moment, camera.name)
            keys = [key for key in found if key in self._world[moment]]
            if len(keys) >= LEAST:
                pixels = _pixels(plan, number, np.array([self._world[moment][key] for key in keys])) - 0.5
                apart = pixels - [found[key] for key in keys]
                worst = max(worst, float(np.sqrt((apart**2).sum(1).mean())))
        return worst

    def uncertainty(self, row: int, plan: Plan) -> tuple[float, float] | None:
        """Return the largest change of the fitted pose if the corners of one camera are left out, mm and degrees.

        None if fewer than three cameras show the board.
        """
        moment, true = int(self.moments[row]), self.poses[row]
        seen = [n for n, c in enumerate(plan.cameras) if len(self._corners(moment, c.name)) >= LEAST]
        if len(seen) < 3:
            return None
        start = np.concatenate([Rotation.from_matrix(true[:3, :3]).as_rotvec(), true[:3, 3]])
        center, places, turns = self.outline.mean(0), [], []
        for left_out in (None, *seen):
            cameras = [n for n in seen if n != left_out]
            found = optimize.least_squares(self._misses, start, loss="soft_l1", args=(moment, plan, cameras)).x
            turns.append(Rotation.from_rotvec(found[:3]))
            places.append(turns[-1].apply(center) + found[3:])
        moved = max(float(np.linalg.norm(place - places[0])) for place in places)
        return 1e3 * moved, max(float(np.degrees((turn.inv() * turns[0]).magnitude())) for turn in turns)

    def _corners(self, moment: int, name: str) -> dict[int, list[float]]:
        """Return the pixels of the corners that a camera shows at a moment, by id."""
        return self._found[moment, int(name.rpartition("_")[2])]

    def _misses(self, pose: np.ndarray, moment: int, plan: Plan, numbers: list[int]) -> np.ndarray:
        """Return the distances along each axis of the corners from those of a posed board, px."""
        misses = []
        for number in numbers:
            corners = self._corners(moment, plan.cameras[number].name)
            points = Rotation.from_rotvec(pose[:3]).apply([self._own[key] for key in corners]) + pose[3:]
            misses.append((_pixels(plan, number, points) - 0.5 - list(corners.values())).ravel())
        return np.concatenate(misses)


def _pixels(plan: Plan, number: int, points: np.ndarray) -> np.ndarray:
    """Return the pixels of world points [N, 3] in the recording of a camera. [N, 2]"""
    one = plan.cameras[number]
    inside = np.linalg.inv(one.pose(0))
    return one.lens(0).project(points @ inside[:3, :3].T + inside[:3, 3])


def _rigid(before: list[list[float]], after: list[list[float]]) -> np.ndarray:
    """Return the rigid motion that moves points to others best. [N][3] each -> [4, 4]"""
    a, b = np.array(before), np.array(after)
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.align_vectors(b - b.mean(0), a - a.mean(0))[0].as_matrix()
    matrix[:3, 3] = b.mean(0) - matrix[:3, :3] @ a.mean(0)
    return matrix


def _rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


def prepared(folder: Path, out: Path, kind: str, without: str | None, lines: int) -> Plan:
    """Prepare the videos, and add the true poses; ``kind`` is the source of the masks, as in ``--masks``."""
    source, calibration = folder / RECORDING, folder / "camera_array.toml"
    hold_out: dict[str, Any] = {"every": 8, "cameras": () if without is None else (without,)}
    fields = {"calibration": calibration, "lines": lines, "hold_out": hold_out}
    plan = prepare.run_prepare(source, out, masks="features" if kind == "features" else "none", **fields)
    board = Board(folder)
    if kind == "corners":
        with tempfile.TemporaryDirectory() as room:
            for number, camera in enumerate(plan.cameras):
                for row in range(len(board.moments)):
                    ids = board.mask(row, int(camera.name.rpartition("_")[2]), plan, number)
                    images.write_png(Path(room) / camera.name / f"{row:06d}.png", ids)
            (Path(room) / "objects.json").write_text(json.dumps({"1": "board"}))
            plan = prepare.run_prepare(source, out, masks=room, **fields)
    times = board.times(min(times[0] for times in plan.choice.times), plan.timeline.seconds_per_unit)
    used = board.posed & (times >= 0)
    row = {"id": 1, "name": "board", "matrices": board.poses[used].tolist()}
    truth = {"t_max": plan.timeline.t_max, "times": times[used].tolist(), "objects": [row]}
    (out / "ground_truth.json").write_text(json.dumps(truth))
    return plan


def pose_errors(scene: Scene, dataset: datasets.Dataset) -> dict[str, Any]:
    """Return errors of the board's poses, mm and degrees, at the times of the training images, and at those held out.

    Empty if no group is the board.
    """
    assert dataset.ground_truth is not None
    found = ground_truth_poses.bodies(scene, dataset.ground_truth)
    if not found:
        return {}
    body = found[0]
    predicted = ground_truth_poses.motion(scene, [body.group], body.times)[0]
    places, turns = metrics.pose_errors(predicted, body.motion, body.group.pivot)
    times = np.unique([view.t for view in dataset.train])
    trained = np.abs(body.times[:, None] - times).min(1) < 0.25 * np.median(np.diff(times))
    seen = body.times <= scene.t_max + 1e-9
    result: dict[str, Any] = {}
    for name, here in (("", seen & trained), ("held_out_", seen & ~trained)):
        result[f"{name}mm"] = float(1e3 * np.median(places[here]))
        result[f"{name}mm_worst"] = float(1e3 * places[here].max())
        result[f"{name}degrees"] = float(np.median(turns[here]))
        result[f"{name}degrees_worst"] = float(turns[here].max())
    each = {"times_each": body.times, "mm_each": 1e3 * places, "degrees_each": turns}
    return {
        **result,
        **{name: values[seen].round(2 + (name == "times_each")).tolist() for name, values in each.items()},
    }


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--masks", choices=("corners", "features", "none"), default="corners")
    parser.add_argument("--without-camera", metavar="NAME")
    parser.add_argument("--lines", type=int, default=360)
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE")
    parser.add_argument("--keep", type=Path, help="keep the data set and the run in this folder")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    warm_up.warm_up()
    with tempfile.TemporaryDirectory() as folder:
        room = args.keep or Path(folder)
        truth = room / "data"
        plan = prepared(args.folder, truth, args.masks, args.without_camera, args.lines)
        if args.masks != "corners":
            truth = room / "masked"
            prepared(args.folder, truth, "corners", args.without_camera, args.lines)
        began = time.process_time()
        trained = run.train(room / "data", room / "run", config.load(None, args.set), overwrite=True)
        seconds = time.process_time() - began
        scene = bake.bake(trained)
        dataset = datasets.read(truth)
        result = evaluate.evaluate(scene, dataset, splits=("val",), align=True)
    board = Board(args.folder)
    posed = np.flatnonzero(board.posed).tolist()
    uncertain = [board.uncertainty(k, plan) for k in posed]
    val, record = result["splits"]["val"]["rigid"], scene.provenance.get("cameras", {})
    row = {
        "val": val["psnr"],
        "val_aligned": val["psnr_aligned"],
        "val_explained": val["psnr_explained"],
        "val_objects": val["psnr_objects"],
        "iou": (val["iou_objects_matched"] or {}).get("1"),
        "cpu_seconds": seconds,
        "gaussians": len(scene.gaussians.means),
        "refined": record.get("refined"),
        "sizes": record.get("sizes"),
        "unexplained": next(row["value"] for row in scene.needs if row["name"] == unexplained.NEED),
        **pose_errors(scene, dataset),
        "corners_px_each": [round(board.disagreement(int(k), plan), 1) for k in posed],
        "true_mm_each": [None if moved is None else round(moved[0], 2) for moved in uncertain],
        "true_degrees_each": [None if moved is None else round(moved[1], 2) for moved in uncertain],
    }
    print("\n".join(f"{name:>14} {value}" for name, value in row.items()))
    if args.json:
        args.json.write_text(json.dumps(row, indent=1) + "\n")


if __name__ == "__main__":
    main()
