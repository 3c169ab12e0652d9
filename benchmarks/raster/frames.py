"""Frames per second of a moving scene, motion included.

    python -m benchmarks.raster frames [--json FILE]

A generated scene is played over its observed time and as long past it. In the ``cube``, moving bodies are slabs of a
cube of static Gaussians and cover most of the image. In the ``room``, they are small balls in front of static walls.
``share`` of all Gaussians belong to the bodies.

``fps`` is computed from the median time of whole frames, from scene time to picture. Medians of the parts:
``ms_motion`` poses the Gaussians, ``ms_colors`` evaluates harmonics and sky, ``ms_raster`` is the rest. ``fps_stage``
and ``ms_stage`` are those of whole frames drawn by an `IncrementalRenderer`, which caches the static layer; each of its
pictures is compared with a complete drawing. Results: docs/results/rasterizer.md.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import time
from pathlib import Path

import numpy as np
import torch

from r5dgs_core.motion import models, rotations
from r5dgs_core.playback import scene_player
from r5dgs_core.raster import RenderOutput, thread_pool
from r5dgs_core.render import incremental_renderer, posed_scene, scene_renderer
from r5dgs_core.scene import row_runs
from r5dgs_core.scene.cameras import Camera
from r5dgs_core.scene.instance import Instance
from r5dgs_core.scene.scene import Gaussians, MotionGroup, Scene, SceneObject, Shading, Tracks

PLAIN = ("fps", "ms_frame", "ms_motion", "ms_colors", "ms_raster")
COLUMNS = ("kind", "share", "threads", "sh_degree", "sky_degree", *PLAIN, "fps_stage", "ms_stage")
T_MAX = 0.75
RADIUS_PX = 4.0  # median of three standard deviations along the longest axis
KINDS = ("cube", "room")
SHARE = 2 / 3  # of the Gaussians that belong to bodies
BALL = 0.12  # radius of a body in the room, half of whose width is 1
TOLERANCE = 1e-6  # between pictures of the stage and of everything drawn anew


def make_camera(size: int) -> Camera:
    """A camera 3 units before the origin, looking along z, with a field of view of 50 degrees."""
    focal = 0.5 * size / np.tan(np.radians(25.0))
    T_cam_world = np.eye(4)
    T_cam_world[2, 3] = 3.0
    return Camera(size, size, np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1.0]]), T_cam_world)


def make_scene(
    count: int,
    bodies: int,
    sh_degree: int,
    sky_degree: int,
    camera: Camera,
    seed: int = 0,
    kind: str = "cube",
    share: float = SHARE,
) -> Scene:
    """The scene of this kind: still Gaussians first, then body by body."""
    random = np.random.default_rng(seed)
    still = round(count * (1 - share))
    cuts = [0, *np.linspace(still, count, bodies + 1).round().astype(int).tolist()]
    means = random.uniform(-1, 1, (count, 3))
    means = means[np.argsort(means[:, 0])]
    if kind == "room":
        means = _room(random, cuts)
    scales = np.exp(0.5 * random.normal(size=(count, 1)) + 0.5 * random.normal(size=(count, 3)))
    scales *= RADIUS_PX / 3 / np.median(scales.max(1) * camera.intrinsics[0, 0] / (means[:, 2] + 3))
    ids = np.repeat(np.arange(bodies + 1), np.diff(cuts)).astype(np.int32)
    times = np.linspace(0, T_MAX, 46)
    groups, objects, poses = [], [], []
    for k in range(bodies + 1):
        model = models.STATIC
        if k:
            model = models.MotionModel(
                "ballistic_spin", velocity=0.3 * random.normal(size=3), angular_velocity=random.normal(size=3)
            )
        pivot = means[cuts[k] : cuts[k + 1]].mean(0) if cuts[k] < cuts[k + 1] else np.zeros(3)
        quats, displacements, _, _ = models.curve(model, times - T_MAX)
        poses.append(np.concatenate([rotations.normalize(quats), displacements], -1))
        groups.append(MotionGroup(k, k, "body" if k else "pinned", cuts[k], pivot, model))
        objects.append(SceneObject(k, f"body {k}", (), "", (0.5, 0.5, 0.5), cuts[k], cuts[k + 1] - cuts[k]))
    fade = 0.6 / (1 + np.arange(16))[:, None]
    return Scene(
        name="benchmark",
        gaussians=Gaussians(
            means=means.astype(np.float32),
            quats=rotations.normalize(random.normal(size=(count, 4))).astype(np.float32),
            log_scales=np.log(scales).astype(np.float32),
            opacity_logits=np.log(1 / random.uniform(0.01, 0.9, count) - 1).astype(np.float32),
            sh=(fade * random.normal(size=(count, 16, 3)))[:, : (sh_degree + 1) ** 2].astype(np.float32),
            object_ids=ids,
            motion_ids=ids,
        ),
        objects=tuple(objects),
        groups=tuple(groups),
        tracks=Tracks(times=times, poses=np.stack(poses)),
        t_max=T_MAX,
        frames_per_unit=60.0,
        world_convention="blender",
        cameras=(camera,),
        background_sh=(fade * random.normal(size=(16, 3)))[: (sky_degree + 1) ** 2].astype(np.float32),
        shading=Shading((0.2 * random.normal(size=(count, 3))).astype(np.float32), np.array([0.0, 0.0, 1.0])),
    )


def _room(random: np.random.Generator, cuts: list[int]) -> np.ndarray:
    """Centres on floor, ceiling, back and side walls up to row ``cuts[1]``, then in balls up to each further cut."""
    means = random.uniform(-1, 1, (cuts[-1], 3))
    walls = random.integers(5, size=cuts[1])
    means[np.arange(cuts[1]), np.array([0, 0, 1, 1, 2])[walls]] = np.array([-1, 1, -1, 1, 1])[walls]
    for k, (start, stop) in enumerate(zip(cuts[1:-1], cuts[2:], strict=True)):
        directions = rotations.normalize(random.normal(size=(stop - start, 3)))
        angle = 2 * math.pi * k / (len(cuts) - 2)
        means[start:stop] = BALL * np.cbrt(random.uniform(size=(stop - start, 1))) * directions
        means[start:stop] += 0.55 * np.array([math.cos(angle), math.sin(angle), -0.5])
    return means


def instances_at(scene: Scene, t: float) -> list[Instance]:
    """The groups at a time in the form of the add-on's requests: ranges of Gaussians, each with a matrix."""
    quats, displacements = scene_player.Player(scene).group_poses(t)
    turns = rotations.quats_to_rotmats(quats)
    found = []
    for start, stop, g in row_runs.runs(scene.gaussians.motion_ids):
        matrix, pivot = np.eye(4), scene.groups[g].pivot
        matrix[:3, :3], matrix[:3, 3] = turns[g], pivot + displacements[g] - turns[g] @ pivot
        found.append(Instance(start, stop - start, matrix))
    return found


def compare(staged: RenderOutput, scene: Scene, instances: list[Instance], camera: Camera) -> None:
    """Raise AssertionError if the picture of a stage differs from a complete drawing."""
    anew = scene_renderer.render_frame(scene, posed_scene.pose_instances(scene, instances), camera)
    for name in ("color", "alpha"):
        difference = np.abs(getattr(staged, name) - getattr(anew, name)).max()
        if not difference <= TOLERANCE:
            raise AssertionError(f"{name}: expected the stage's within {TOLERANCE:g}, found {difference:g} beside it")


def measure(scene: Scene, camera: Camera, frames: int) -> dict[str, float]:
    """Medians over frames spread over twice the observed time, in milliseconds, and frames per second."""
    parts: dict[str, list[float]] = {"ms_frame": [], "ms_motion": [], "ms_colors": [], "ms_stage": []}
    theatre = incremental_renderer.IncrementalRenderer(scene)
    for t in [0.1 * T_MAX, *np.linspace(0, 2 * T_MAX, frames)]:  # the first one warms up and is not counted
        start = time.perf_counter()
        frame = scene_player.Player(scene).frame(float(t))
        moved = time.perf_counter()
        scene_renderer.render_frame(scene, frame, camera)
        drawn = time.perf_counter()
        posed = posed_scene.pose_frame(scene, frame)
        scene_renderer.colors(posed, camera)
        scene_renderer.sky(scene, camera)
        colored = time.perf_counter()
        instances = instances_at(scene, float(t))
        staged = theatre.render(instances, camera)
        played = time.perf_counter()
        for name, seconds in zip(parts, (drawn - start, moved - start, colored - drawn, played - colored), strict=True):
            parts[name].append(1e3 * seconds)
        compare(staged, scene, instances, camera)
    found = {name: statistics.median(values[1:]) for name, values in parts.items()}
    found["ms_raster"] = found["ms_frame"] - found["ms_motion"] - found["ms_colors"]
    rates = {"fps": round(1e3 / found["ms_frame"], 1), "fps_stage": round(1e3 / found["ms_stage"], 1)}
    return {**rates, **{name: round(value, 3) for name, value in found.items()}}


def main(arguments: list[str] | None = None) -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=40_000, help="Gaussians")
    parser.add_argument("--size", type=int, default=400, help="width and height in px")
    parser.add_argument("--bodies", type=int, default=6)
    parser.add_argument("--kind", choices=KINDS, default="cube", help="bodies are slabs of a cube, or balls in a room")
    parser.add_argument("--share", type=float, default=SHARE, help="of the Gaussians, on bodies (2/3)")
    parser.add_argument("--threads", default="1,2")
    parser.add_argument("--degrees", nargs="+", default=["0,0", "0,2", "3,2"], help="of colours and sky: SH,SKY")
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--json", type=Path, help="also write the rows to this file")
    options = parser.parse_args(arguments)
    if options.json and not options.json.parent.is_dir():
        parser.error(f"--json: no folder {options.json.parent}")
    if not 0 <= options.share <= 1:
        parser.error(f"--share: expected 0 to 1, got {options.share:g}")
    if options.bodies < 1:
        parser.error(f"--bodies: expected 1 or more, got {options.bodies}")
    camera, rows = make_camera(options.size), []
    print(" ".join(f"{column:>10}" for column in COLUMNS))
    for degrees in options.degrees:
        sh_degree, sky_degree = map(int, degrees.split(","))
        scene = make_scene(
            options.count, options.bodies, sh_degree, sky_degree, camera, kind=options.kind, share=options.share
        )
        for threads in map(int, options.threads.split(",")):
            thread_pool.set_threads(threads)
            torch.set_num_threads(threads)
            rows.append(
                {
                    "kind": options.kind,
                    "share": round(options.share, 3),
                    "threads": threads,
                    "sh_degree": sh_degree,
                    "sky_degree": sky_degree,
                    **measure(scene, camera, options.frames),
                }
            )
            print(" ".join(f"{rows[-1][column]!s:>10}" for column in COLUMNS), flush=True)
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
