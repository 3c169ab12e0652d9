"""Check a scene inside Blender against the core: every point at every kind of time, the preview, and rendered images.

    blender -b --python-exit-code 1 --python tests/blender/check_playback.py -- SCENE.r5dgs

runs it in Blender, ``python tests/blender/check_playback.py SCENE.r5dgs`` in the bpy module. Options are ``--worker
PYTHON`` and ``--no-preview``. Registers the extension of this repository if none is enabled. A second process of the
worker's Python renders the reference images from the scene file. Exits with 1 if a difference exceeds its limit.
"""

import argparse
import importlib.util
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix

ROOT = Path(__file__).resolve().parents[2]
POSITION_TOLERANCE = 1e-5  # of the scene's size
PICTURE_PSNR_DB = 45.0

REFERENCE = """
import json, sys
import numpy as np
from r5dgs_core.render import scene_renderer
from r5dgs_core.playback import scene_player
from r5dgs_core.scene import scene_file
path, times, out = sys.argv[1], json.loads(sys.argv[2]), sys.argv[3]
scene = scene_file.read(path)
frames = [scene_player.Player(scene).frame(t) for t in times]
images = [scene_renderer.render_frame(scene, frame, scene.cameras[0]).color for frame in frames]
np.save(out, np.stack(images))
"""


def extension_package() -> str:
    """Name of the extension's package. Registers the extension of this repository if none is enabled."""
    for name in list(sys.modules):
        if name.endswith(".r5dgs_addon") and "r5dgs_core" not in name:
            return name.removesuffix(".r5dgs_addon")
    spec = importlib.util.spec_from_file_location("r5dgs", ROOT / "__init__.py", submodule_search_locations=[str(ROOT)])
    module = importlib.util.module_from_spec(spec)
    sys.modules["r5dgs"] = module
    spec.loader.exec_module(module)
    module.register()
    return "r5dgs"


def times_to_check(scene) -> list[float]:
    """Times at knots, between knots, next to t_max, and past it, on frames and between them."""
    first, last = float(scene.tracks.times[0]), float(scene.t_max)
    span = max(last - first, 1e-3)
    frame = 1.0 / scene.frames_per_unit
    end = max(last + span / 3, 1.0)
    inside = first + span * np.array([0.0, 0.137, 0.31, 0.5, 0.763, 0.9])
    past = last + (end - last) * np.array([0.03, 0.21, 0.5, 0.777, 1.0])
    beside = [last - 0.37 * frame, last, min(last + 0.41 * frame, end)]
    knots = scene.tracks.times[:: max(len(scene.tracks.times) // 3, 1)]
    return sorted({float(t) for t in (*inside, *knots, *beside, *past)})


def set_time(collection, t: float) -> None:
    """Set the frame and sub-frame of a scene time."""
    state = collection.r5dgs
    frame = state.frame_zero + t * state.frames_per_unit
    bpy.context.scene.frame_set(int(np.floor(frame)), subframe=float(frame - np.floor(frame)))


def position_error(collection, scene, modules, t: float) -> float:
    """Largest distance between a point as Blender evaluates it and playback, as a fraction of the scene's size."""
    set_time(collection, t)
    expected = modules["scene_player"].Player(scene).frame(t).means.astype(np.float64)
    world = modules["cameras"].WORLD_TO_BLENDER[scene.world_convention]
    depsgraph = bpy.context.evaluated_depsgraph_get()
    worst, seen = 0.0, 0
    for cloud in collection.all_objects:
        state = cloud.r5dgs
        if state.role != "CLOUD":
            continue
        evaluated = cloud.evaluated_get(depsgraph)
        points = np.empty(3 * len(evaluated.data.points), np.float32)
        evaluated.data.attributes["position"].data.foreach_get("vector", points)
        matrix = np.array(evaluated.matrix_world, np.float64)
        placed = points.reshape(-1, 3).astype(np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
        rows = slice(state.start, state.start + state.count)
        worst = max(worst, float(np.linalg.norm(placed - expected[rows] @ world.T, axis=-1).max(initial=0)))
        seen += len(placed)
    if seen != len(expected):
        raise SystemExit(f"{scene.name}: expected {len(expected)} points in Blender, found {seen}")
    return worst / scene.extent


def add_camera(collection, scene, modules) -> None:
    """The scene's first camera as Blender's active one, with its resolution."""
    camera = scene.cameras[0]
    data = bpy.data.cameras.new("check")
    data.sensor_fit = "HORIZONTAL"
    data.lens = camera.intrinsics[0, 0] * data.sensor_width / camera.width
    data.shift_x = (0.5 * camera.width - camera.intrinsics[0, 2]) / camera.width
    data.shift_y = (camera.intrinsics[1, 2] - 0.5 * camera.height) / camera.width
    obj = bpy.data.objects.new("check", data)
    bpy.context.scene.collection.objects.link(obj)
    obj.parent = collection.r5dgs.root
    obj.matrix_basis = Matrix(modules["cameras"].cam_world_to_opengl(camera.T_cam_world).tolist())
    render = bpy.context.scene.render
    render.resolution_x, render.resolution_y, render.resolution_percentage = camera.width, camera.height, 100
    bpy.context.scene.camera = obj


def previews(collection, times: list[float]) -> np.ndarray:
    """The preview image at each time, top row first. [T, H, W, 3]"""
    pictures = []
    for t in times:
        set_time(collection, t)
        if bpy.ops.r5dgs.preview() != {"FINISHED"}:
            raise SystemExit(f"the preview at t = {t:.4f} did not finish")
        pictures.append(pixels_of(bpy.data.images["R5DGS Preview"]))
    return np.stack(pictures)


def renders(collection, times: list[float]) -> np.ndarray:
    """Images that the engine R5DGS renders and Blender saves at each time, top row first. [T, H, W, 3]"""
    bpy.ops.r5dgs.use_engine()
    bpy.ops.r5dgs.show_colors_as_trained()
    settings, pictures = bpy.context.scene.render, []
    if hasattr(settings.image_settings, "media_type"):  # 5.0 on
        settings.image_settings.media_type = "IMAGE"
    settings.image_settings.file_format, settings.image_settings.color_mode = "PNG", "RGB"
    settings.dither_intensity = 0.0
    with tempfile.TemporaryDirectory() as folder:
        for number, t in enumerate(times):
            set_time(collection, t)
            settings.filepath = str(Path(folder) / f"{number}.png")
            if bpy.ops.render.render(write_still=True) != {"FINISHED"}:
                raise SystemExit(f"the render at t = {t:.4f} did not finish")
            image = bpy.data.images.load(settings.filepath)
            pictures.append(pixels_of(image))
            bpy.data.images.remove(image)
    return np.stack(pictures)


def pixels_of(image: bpy.types.Image) -> np.ndarray:
    """Stored values of an image of 8 bits per channel, / 255, top row first. [H, W, 3]"""
    pixels = np.empty(4 * image.size[0] * image.size[1], np.float32)
    image.pixels.foreach_get(pixels)
    return pixels.reshape(image.size[1], image.size[0], 4)[::-1, :, :3]


def references(path: Path, times: list[float], python: str, package_root: Path) -> np.ndarray:
    """The core's own renders of the scene's first camera. [T, H, W, 3]"""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "reference.npy"
        environment = {**os.environ, "PYTHONPATH": str(package_root)}
        subprocess.run(
            [python, "-c", REFERENCE, str(path), json.dumps(times), str(out)], check=True, env=environment, cwd=folder
        )
        return np.load(out)


def main(arguments: list[str]) -> int:
    """Run the check. Returns the exit code."""
    parser = argparse.ArgumentParser(description="Check a scene inside Blender against the core.")
    parser.add_argument("scene", type=Path)
    parser.add_argument("--worker", help="Python with torch for preview and reference; else the add-on's choice")
    parser.add_argument("--no-preview", action="store_true", help="check positions only, no pictures")
    options = parser.parse_args(arguments)
    if options.worker:
        os.environ["R5DGS_PYTHON"] = options.worker
    package = extension_package()
    modules = {
        name: importlib.import_module(f"{package}.r5dgs_core.{room}.{name}")
        for room, name in (("scene", "cameras"), ("playback", "scene_player"), ("scene", "scene_file"))
    }
    path = options.scene.resolve()
    scene = modules["scene_file"].read(path)
    before = set(bpy.data.collections)
    if bpy.ops.r5dgs.load_scene(filepath=str(path)) != {"FINISHED"}:
        raise SystemExit(f"{path}: was not loaded")
    collection = next(c for c in bpy.data.collections if c not in before and c.r5dgs.is_scene)

    failed = False
    print(
        f"Blender {bpy.app.version_string}, {path.name}: {len(scene.gaussians.means)} Gaussians, t_max {scene.t_max:g}"
    )
    for t in times_to_check(scene):
        error = position_error(collection, scene, modules, t)
        failed |= not error <= POSITION_TOLERANCE
        kind = "observed" if t <= scene.t_max else "extrapolated"
        print(f"  t {t:8.5f} {kind:12} largest error {error:.2e} of the scene's size (at most {POSITION_TOLERANCE:g})")
    if not options.no_preview:
        worker = importlib.import_module(f"{package}.r5dgs_addon.preferences").worker_python()
        core_root = Path(importlib.import_module(f"{package}.r5dgs_core").__file__).resolve().parents[1]
        add_camera(collection, scene, modules)
        chosen = times_to_check(scene)
        chosen = [chosen[1], chosen[len(chosen) // 2], chosen[-2]]
        expected = np.clip(references(path, chosen, worker, core_root), 0, 1)
        for kind, pictures in (("preview", previews(collection, chosen)), ("render", renders(collection, chosen))):
            for t, shown, wanted in zip(chosen, pictures, expected, strict=True):
                psnr = -10 * np.log10(max(float(np.square(shown.astype(np.float64) - wanted).mean()), 1e-12))
                failed |= not psnr > PICTURE_PSNR_DB
                print(f"  t {t:8.5f} {kind} against core {psnr:.1f} dB (over {PICTURE_PSNR_DB:g})")
    print("FAILED" if failed else "OK")
    return int(failed)


if __name__ == "__main__":
    given = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:]
    if code := main(given):
        raise SystemExit(code)
