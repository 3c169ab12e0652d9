"""Time to pose the Gaussians of a frame, compared with TRACE's networks.

    python -m benchmarks.motion [--json FILE]

A generated scene of ``--gaussians`` Gaussians in ``--bodies`` moving bodies, with dynamics of single Gaussians, is
played past t_max in every mode by a `scene_player.Player`. Rows:

    networks   deformation field and TRD of TRACE's sizes for all Gaussians (random weights), then TRACE's midpoint
               steps of all of them
    poses      poses of the bodies alone, for each kind of motion model
    frame      Gaussians at a time: centres, rotations and shading, with the centres relative to a camera
    bending    frames in the observed time in which every Gaussian has residuals

``ms`` is the minimum and ``ms_median`` the median processor time of a call, on one thread, in interleaved rounds; every
call uses another time. ``times_faster`` is the networks' median over the row's. Results: docs/results/motion.md.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from r5dgs_core.model import deformation, trd
from r5dgs_core.motion import knots as trajectory_knots
from r5dgs_core.motion import models, point_dynamics, rotations, se3
from r5dgs_core.playback import group_dynamics, scene_player
from r5dgs_core.scene.scene import Dynamics, Gaussians, MotionGroup, Scene, SceneObject, Shading, Tracks

T_MAX = 0.75
KNOTS = 16
COLUMNS = ("stage", "what", "ms", "ms_median", "times_faster")
ORIGIN = np.array([3.0, -2.0, 1.5])  # of the camera


def make_scene(count: int, bodies: int, kind: str = "ballistic_spin", seed: int = 0) -> Scene:
    """Row of bodies, one per kind of motion, whose members' own dynamics differ slightly from that of the body."""
    rng = np.random.default_rng(seed)
    ids = np.sort(rng.integers(1, bodies + 1, count)).astype(np.int32)
    centers = np.concatenate([np.zeros((1, 3)), rng.uniform(-2, 2, (bodies, 3))])
    means = (centers[ids] + rng.uniform(-0.3, 0.3, (count, 3))).astype(np.float32)
    times = np.linspace(0.0, T_MAX, KNOTS)
    groups = [MotionGroup(0, 0, "pinned", -1, np.zeros(3), models.STATIC)]
    poses, own = [np.tile([1.0, 0, 0, 0, 0, 0, 0], (KNOTS, 1))], np.zeros((count, 12))
    for g in range(1, bodies + 1):
        v, a, w, eps = rng.normal(size=(4, 3)) * [[0.5], [0.5], [1.5], [0.7]]
        inertia = np.diag([0.4, 0.8, 1.0]) if models.KINDS[kind].needs_inertia else None
        rates = {"velocity": v, "acceleration": a, "angular_velocity": w, "angular_acceleration": eps}
        free = models.MotionModel("ballistic_spin", **rates)
        path = np.linspace(0.0, T_MAX, KNOTS)
        turns, places, spins, velocities = models.curve(free, path)
        knots = trajectory_knots.pack(path, (turns, places), (velocities, velocities), (spins, spins))
        model = models.MotionModel(
            kind,
            **rates,
            inertia=inertia,
            knots=knots if models.KINDS[kind].needs_knots else None,
            radius=0.5,
            offset_rotvec=rng.normal(size=3) * 0.01,
        )
        quats, displacements, _, _ = models.curve(free, times - T_MAX)
        poses.append(np.concatenate([rotations.normalize(quats), displacements], -1))
        rows = np.flatnonzero(ids == g)
        anchor = int(rows[np.argmin(((means[rows] - centers[g]) ** 2).sum(-1))]) if len(rows) else -1
        groups.append(MotionGroup(g, g, "body", anchor, centers[g], model))
        v_i, a_i = se3.recentre(w, v, eps, a, means[rows] - centers[g])
        own[rows] = np.concatenate([v_i, w + 0 * v_i, a_i, eps + 0 * v_i], -1)
    own += rng.normal(scale=0.05, size=own.shape)
    starts = np.searchsorted(ids, np.arange(1, bodies + 2))
    objects = [
        SceneObject(g, f"body {g}", (), "", (1.0, 1.0, 1.0), int(start), int(stop - start))
        for g, start, stop in zip(range(1, bodies + 1), starts[:-1], starts[1:], strict=True)
    ]
    return Scene(
        name=f"{bodies} bodies",
        gaussians=Gaussians(
            means=means,
            quats=rotations.normalize(rng.normal(size=(count, 4))).astype(np.float32),
            log_scales=np.full((count, 3), -4.0, np.float32),
            opacity_logits=np.full(count, 3.0, np.float32),
            sh=rng.normal(size=(count, 1, 3)).astype(np.float32),
            object_ids=ids,
            motion_ids=ids,
        ),
        objects=(SceneObject(0, "background", (), "", (0.5, 0.5, 0.5), 0, 0), *objects),
        groups=tuple(groups),
        tracks=Tracks(times=times, poses=np.stack(poses)),
        t_max=T_MAX,
        frames_per_unit=60.0,
        world_convention="blender",
        cameras=(),
        background_sh=np.zeros((1, 3), np.float32),
        dynamics=Dynamics(own.astype(np.float32), means + np.float32(0.01)),
        shading=Shading(rng.normal(scale=0.2, size=(count, 3)).astype(np.float32), np.array([0.0, 0.0, 1.0])),
    )


def bending(scene: Scene) -> Scene:
    """The scene with residuals of all Gaussians."""
    shape, rng = (len(scene.gaussians.means), len(scene.tracks.times), 3), np.random.default_rng(1)
    fade = (T_MAX - scene.tracks.times)[:, None]
    turns = rotations.rotvecs_to_quats(rng.normal(scale=0.3, size=shape) * fade)
    return scene.with_arrays(
        residual_rows=np.arange(len(scene.gaussians.means), dtype=np.int32),
        residual_offsets=(rng.normal(scale=0.05, size=shape) * fade).astype(np.float32),
        residual_quats=turns.astype(np.float32),
        residual_log_scales=(rng.normal(scale=0.1, size=shape) * fade).astype(np.float32),
    )


class Networks:
    """TRACE's networks of a size, evaluated for every frame past t_max."""

    def __init__(self, scene: Scene, size: str):
        generator = torch.Generator().manual_seed(0)
        self.field = deformation.DeformationField(deformation.SHAPES[size], generator)
        self.trd = trd.TRD(trd.SHAPES[size], generator)
        self.means = torch.from_numpy(scene.gaussians.means)

    def deform(self) -> torch.Tensor:
        """The deformation field at t_max."""
        with torch.no_grad():
            return self.means + self.field(self.means, T_MAX).offsets

    def states(self) -> trd.MotionState:
        """The TRD at t_max."""
        with torch.no_grad():
            return self.trd(self.means, T_MAX)

    def frame(self, t: float) -> None:
        """Field, TRD, and TRACE's midpoint steps of every Gaussian."""
        points, state = self.deform(), self.states()
        with torch.no_grad():
            point_dynamics.rk2(
                points, state.equiv_velocity, state.angular_velocity, state.equiv_acceleration,
                state.angular_acceleration, t - T_MAX, point_dynamics.TRACE_STEP,
            )  # fmt: skip


def contenders(count: int, bodies: int, size: str, horizon: float) -> dict[tuple[str, str], Callable[[float], object]]:
    """Timed functions of a share of the horizon, in [0, 1], by stage and name."""
    scene = make_scene(count, bodies)
    networks, bent = Networks(scene, size), scene_player.Player(bending(scene))
    calls: dict[tuple[str, str], Callable[[float], object]] = {
        ("networks", "field"): lambda _: networks.deform(),
        ("networks", "TRD"): lambda _: networks.states(),
        ("networks", "field, TRD, steps"): lambda s: networks.frame(T_MAX + s * horizon),
    }
    for kind in models.KINDS:
        motion = group_dynamics.GroupMotion(make_scene(bodies * 4, bodies, kind))
        calls["poses", kind] = lambda s, motion=motion: motion.poses(T_MAX + s * horizon)
    calls["poses", "observed"] = lambda s, motion=motion: motion.poses(s * T_MAX)
    for mode in scene_player.modes(scene):
        player = scene_player.Player(scene, mode)
        calls["frame", mode] = lambda s, player=player: player.frame(T_MAX + s * horizon, ORIGIN)
    player = scene_player.Player(scene)
    calls["frame", "observed"] = lambda s: player.frame(s * T_MAX, ORIGIN)
    calls["bending", "observed"] = lambda s: bent.frame(s * T_MAX, ORIGIN)
    return calls


def measure(calls: dict[tuple[str, str], Callable[[float], object]], rounds: int) -> list[dict[str, Any]]:
    """Rows of `COLUMNS`, measured in interleaved rounds."""
    spent: dict[tuple[str, str], list[float]] = {name: [] for name in calls}
    shares = np.random.default_rng(0).uniform(0.05, 1.0, rounds)
    for call in calls.values():
        for share in (0.5, 1.0):
            call(share)  # fills what is kept
    for share in shares:
        for (stage, what), call in calls.items():
            if stage == "networks" and len(spent[stage, what]) >= max(3, rounds // 10):
                continue
            start = time.process_time()
            call(float(share))
            spent[stage, what].append(1e3 * (time.process_time() - start))
    slow = statistics.median(spent["networks", "field"]) + statistics.median(spent["networks", "TRD"])
    rows = []
    for (stage, what), found in spent.items():
        median = statistics.median(found)
        rows.append(dict(zip(COLUMNS, (stage, what, min(found), median, slow / max(median, 1e-9)), strict=True)))
    return rows


def main(arguments: list[str] | None = None) -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gaussians", type=int, default=40000, metavar="N")
    parser.add_argument("--bodies", type=int, default=12, metavar="K")
    parser.add_argument("--size", choices=sorted(deformation.SHAPES), default="complex", help="of the networks")
    parser.add_argument("--horizon", type=float, default=T_MAX / 3, metavar="T", help="played time past t_max")
    parser.add_argument("--rounds", type=int, default=30, metavar="R")
    parser.add_argument("--json", type=Path, metavar="FILE")
    options = parser.parse_args(arguments)
    if options.json and not options.json.parent.is_dir():
        parser.error(f"--json: no folder {options.json.parent}")
    torch.set_num_threads(1)
    rows = measure(contenders(options.gaussians, options.bodies, options.size, options.horizon), options.rounds)
    print(f"{options.gaussians} Gaussians, {options.bodies} bodies, networks of size {options.size}, one thread")
    print(f"{'stage':10} {'what':22} {'ms':>9} {'ms_median':>10} {'times_faster':>13}")
    for row in rows:
        print("{stage:10} {what:22} {ms:9.3f} {ms_median:10.3f} {times_faster:13.1f}".format(**row))
    if options.json:
        settings = {name: getattr(options, name) for name in ("gaussians", "bodies", "size", "horizon", "rounds")}
        options.json.write_text(json.dumps({**settings, "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
