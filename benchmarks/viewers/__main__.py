"""Pictures of exported glTF files in PlayCanvas, Babylon.js and three.js against the rasterizer.

    python -m benchmarks.viewers demo.r5dgs [--cases demo harmonics ...] [--engines playcanvas ...] [--json FILE]

Exports each case as .glb, shows it in each engine in headless Chromium with software WebGL, and compares pictures of
captured cameras before and past `t_max` with ours, with the shading of `t_max`, which is what the file holds. Needs
Node 18, npm and Chromium; the npm packages of `web/package-lock.json` are installed into a temporary folder. PSNR is
that of whole pictures, the median error that of pixels of objects; the displacement of an object is the shift that best
explains the difference of both pictures in its box. Results: docs/results/viewers.md.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from r5dgs_core.evaluation import metrics
from r5dgs_core.formats import glb, registry
from r5dgs_core.formats.glb_motion import seconds_per_unit
from r5dgs_core.playback.scene_player import Frame, Player
from r5dgs_core.render import scene_renderer
from r5dgs_core.scene import cameras, predictability, scene_file, spherical_harmonics
from r5dgs_core.scene.scene import Scene

from . import cases

WEB = Path(__file__).with_name("web")
ENGINES = {  # engine and settings
    "playcanvas": ("playcanvas", {}),
    "babylon": ("babylon", {}),
    "three": ("three", {}),
    "three-linear": ("three", {"linear": True}),
}
SIDE = 512  # pixels
Y_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
FEWEST_PIXELS = 400  # of an object whose displacement is measured
COLUMNS = ("case", "engine", "gaussians", "psnr", "psnr_least", "median", "shift", "shift_most", "boot_ms")


def main() -> None:
    """Run the benchmark."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("scene", type=Path, help=".r5dgs file")
    p.add_argument("--cases", nargs="+", choices=cases.CASES, default=list(cases.CASES))
    p.add_argument("--engines", nargs="+", choices=ENGINES, default=list(ENGINES))
    p.add_argument("--cameras", type=int, default=3, metavar="N", help="number of cameras (default: 3)")
    p.add_argument("--json", type=Path, help="file for the rows")
    p.add_argument("--keep", type=Path, metavar="FOLDER", help="folder for files and pictures (default: temporary)")
    args = p.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        web = Path(folder, "web")
        shutil.copytree(WEB, web)
        install = ["npm", "ci", "--ignore-scripts", "--no-audit", "--no-fund", "--legacy-peer-deps", "--silent"]
        subprocess.run(install, cwd=web, check=True)
        rows = []
        for name in args.cases:
            scene = cases.CASES[name](scene_file.read(args.scene))
            work = (args.keep or Path(folder)) / name
            work.mkdir(parents=True, exist_ok=True)
            for row in measured(scene, work, web, args.engines, args.cameras):
                rows.append({"case": name} | row)
                print(
                    "  ".join(
                        f"{key} {rows[-1][key]:.4g}" if isinstance(rows[-1][key], float) else str(rows[-1][key])
                        for key in COLUMNS
                    ),
                    flush=True,
                )
                if args.json is not None:
                    args.json.write_text(json.dumps({"rows": rows}, indent=1) + "\n")


def measured(scene: Scene, folder: Path, web: Path, engines: list[str], count: int) -> Iterator[dict[str, Any]]:
    """Rows of one scene, one for each engine."""
    (path,) = glb.export(scene, folder / "scene.glb", registry.Options((0.0,)))
    start, end = float(scene.tracks.times[0]), predictability.horizon(scene)
    times = [start, 0.5 * (start + scene.t_max), scene.t_max, 0.4 * scene.t_max + 0.6 * end, end]
    views = [cameras.resized(camera, SIDE) for camera in spread(scene.cameras, count)]
    views = [squared(view) for view in views]
    wanted = {(k, i): frozen(scene, t, view) for k, view in enumerate(views) for i, t in enumerate(times)}
    sky = np.clip(spherical_harmonics.dc_to_rgb(scene.background_sh[0]), 0, 1).tolist()
    up = Y_UP @ cameras.WORLD_TO_BLENDER[scene.world_convention]
    for name in engines:
        engine, settings = ENGINES[name]
        pictures = folder / name
        pictures.mkdir(exist_ok=True)
        plan = {
            "engine": engine,
            "glb": str(path.resolve()),
            "sky": sky,
            "size": SIDE,
            "folder": str(pictures.resolve()),
            "times": [(min(t, end) - start) * seconds_per_unit(scene.units) - 1e-4 * (t == end) for t in times],
            "cameras": [pose_of(view, up, scene) for view in views],
            **settings,
        }
        (folder / "plan.json").write_text(json.dumps(plan))
        command = ["node", "shoot.mjs", shutil.which("chromium") or "chromium", str((folder / "plan.json").resolve())]
        done = subprocess.run(command, cwd=web, check=True, capture_output=True, text=True)
        row = {"engine": name, "gaussians": len(scene.gaussians.means)} | compared(wanted, pictures)
        yield row | json.loads(done.stdout.splitlines()[-1])


def spread(views: tuple[cameras.Camera, ...], count: int) -> list[cameras.Camera]:
    """Cameras that are far apart in the list."""
    return [views[k] for k in sorted({number * len(views) // count for number in range(count)})]


def squared(view: cameras.Camera) -> cameras.Camera:
    """Square picture with a centred principal point and square pixels, as engines have it."""
    intrinsics = view.intrinsics.copy()
    intrinsics[0, 0] = intrinsics[1, 1]
    intrinsics[:2, 2] = SIDE / 2
    return dataclasses.replace(view, width=SIDE, height=SIDE, intrinsics=intrinsics)


def pose_of(view: cameras.Camera, up: np.ndarray, scene: Scene) -> dict[str, Any]:
    """Pose of a camera in the world of the file, column by column, and its vertical field of view."""
    pose = cameras.cam_world_to_opengl(view.T_cam_world)
    pose[:3] = up @ pose[:3]
    pose[:3, 3] *= scene.units.meters_per_unit or 1.0
    fovy = float(2 * np.arctan(SIDE / 2 / view.intrinsics[1, 1]))
    return {"pose": pose.T.reshape(-1).tolist(), "fovy": fovy}


def frozen(scene: Scene, t: float, view: cameras.Camera) -> tuple[np.ndarray, np.ndarray]:
    """Picture in [0, 1] with the shading of t_max, and the object of each pixel."""
    player = Player(scene)
    frame: Frame = player.frame(t, origin=view.center)
    frame = dataclasses.replace(frame, shading_factor=player.frame(scene.t_max).shading_factor)
    found = scene_renderer.render_frame(scene, frame, view)
    assert found.ids is not None
    return np.clip(found.color, 0, 1), np.asarray(found.ids).reshape(SIDE, SIDE)


def compared(wanted: dict[tuple[int, int], tuple[np.ndarray, np.ndarray]], folder: Path) -> dict[str, float]:
    """PSNR, errors and displacements of all pictures of an engine."""
    quality, errors, shifts = [], [], []
    for (k, i), (picture, ids) in wanted.items():
        shown = np.asarray(Image.open(folder / f"{k}_{i}.png").convert("RGB"), np.float32) / 255
        quality.append(float(metrics.psnr(shown, picture)))
        errors.append(np.abs(shown - picture)[ids > 0].ravel() * 255)
        for number in np.unique(ids[ids > 0]):
            y, x = np.nonzero(ids == number)
            if len(y) >= FEWEST_PIXELS:
                box = np.s_[max(y.min() - 3, 0) : y.max() + 4, max(x.min() - 3, 0) : x.max() + 4]
                shifts.append(displacement(picture[box], shown[box]))
    return {
        "psnr": float(np.mean(quality)),
        "psnr_least": float(np.min(quality)),
        "median": float(np.median(np.concatenate(errors))),
        "shift": float(np.median(shifts)),
        "shift_most": float(np.max(shifts)),
    }


def displacement(wanted: np.ndarray, shown: np.ndarray) -> float:
    """Length of the shift that best explains the difference of two pictures, pixels."""
    first, second = wanted.mean(-1), shown.mean(-1)
    down, right = np.gradient(first)
    system = np.stack([right.ravel(), down.ravel()], axis=1)
    return float(np.hypot(*np.linalg.lstsq(system, (first - second).ravel(), rcond=None)[0]))


if __name__ == "__main__":
    main()
