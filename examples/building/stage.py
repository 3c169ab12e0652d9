"""Setup of a scene: an empty file with lights, its capture, and the scripts' command line."""

from __future__ import annotations

import argparse
import importlib.util
import json
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType

import bpy
from mathutils import Euler, Vector

from . import motion


def new(sky: Sequence[float], sky_strength: float) -> None:
    """Empty the file, and set up a constant sky, the timeline, and Cycles for matte surfaces."""
    bpy.ops.wm.read_homefile(use_factory_startup=True, use_empty=True)
    scene = bpy.context.scene
    scene.frame_start, scene.frame_end = motion.FIRST_FRAME, motion.FIRST_FRAME + motion.FRAMES_PER_UNIT
    scene.render.fps = 30
    scene.render.engine = "CYCLES"
    scene.cycles.max_bounces = 4
    scene.cycles.use_adaptive_sampling = False
    scene.view_settings.view_transform = "Standard"
    world = bpy.data.worlds.new("Sky")
    world.use_nodes = True
    background = next(node for node in world.node_tree.nodes if node.type == "BACKGROUND")
    background.inputs["Color"].default_value = (*sky, 1.0)
    background.inputs["Strength"].default_value = sky_strength
    scene.world = world


def sun(strength: float, rotation_deg: Sequence[float], *, angle_deg: float, color: Sequence[float]) -> None:
    """A sun with soft shadows."""
    light = bpy.data.lights.new("Sun", "SUN")
    light.energy, light.angle, light.color = strength, math.radians(angle_deg), color
    lamp = bpy.data.objects.new("Sun", light)
    lamp.rotation_euler = Euler([math.radians(angle) for angle in rotation_deg])
    bpy.context.scene.collection.objects.link(lamp)


def area_light(
    name: str,
    place: Sequence[float],
    target: Sequence[float],
    size: Sequence[float],
    power: float,
    color: Sequence[float] = (1.0, 1.0, 1.0),
) -> None:
    """A rectangle of light that faces a target; cameras do not see it.

    Args:
        name: Name of the light.
        place: Its middle.
        target: Point that it faces.
        size: Lengths of its two edges; larger lights cast softer shadows.
        power: Watts.
        color: Its colour.
    """
    light = bpy.data.lights.new(name, "AREA")
    light.shape, light.size, light.size_y = "RECTANGLE", *size
    light.energy, light.color = power, color
    lamp = bpy.data.objects.new(name, light)
    lamp.location = place
    lamp.rotation_euler = (Vector(target) - Vector(place)).to_track_quat("-Z", "Y").to_euler()
    lamp.visible_camera = False
    bpy.context.scene.collection.objects.link(lamp)


def capture_service() -> ModuleType:
    """The add-on's capture service, from the folder above the examples as the package ``r5dgs``."""
    root = Path(__file__).resolve().parents[2]
    if "r5dgs" not in sys.modules:
        spec = importlib.util.spec_from_file_location(
            "r5dgs", root / "__init__.py", submodule_search_locations=[str(root)]
        )
        package = importlib.util.module_from_spec(spec)
        sys.modules["r5dgs"] = package
        spec.loader.exec_module(package)
    return importlib.import_module("r5dgs.r5dgs_addon.capture.capture")


def save(blend: Path) -> None:
    """Save the open file."""
    bpy.ops.wm.save_as_mainfile(filepath=str(blend.absolute()))


def capture(service: ModuleType, settings) -> None:
    """Capture the open file, and print a line of JSON for each image.

    Args:
        service: The `capture_service`.
        settings: Its ``CaptureSettings``.
    """
    result = service.capture(bpy.context, settings, lambda state: print(json.dumps(vars(state)), flush=True))
    print(f"{result.directory}: {result.images}, objects {result.objects}, not seen {result.unseen or 'none'}")


def add_rendering(parser: argparse.ArgumentParser, samples: int, views: int) -> None:
    """Add the options of rendered images, with default numbers of Cycles samples per pixel and of observed cameras."""
    parser.add_argument("--size", type=int, default=128, help="width and height of the images in pixels")
    parser.add_argument("--samples", type=int, default=samples, help="Cycles samples per pixel")
    parser.add_argument("--views", type=int, default=views, help="observed cameras")
    parser.add_argument("--threads", type=int, default=0, help="threads of Cycles, 0 for one per core")


def use_threads(count: int) -> None:
    """Set the number of threads of Cycles; 0 keeps one per core."""
    if count > 0:
        render = bpy.context.scene.render
        render.threads_mode, render.threads = "FIXED", count


def parser(prog: str, description: str) -> argparse.ArgumentParser:
    """Return a parser with the arguments of all builders."""
    built = argparse.ArgumentParser(prog=prog, description=description)
    built.add_argument("--blend", type=Path, help="save the scene here")
    built.add_argument("--dataset", type=Path, help="capture the scene into this new folder")
    return built


def arguments() -> list[str]:
    """Return the arguments of the script, which follow ``--`` if Blender runs it."""
    if "--" in sys.argv:
        return sys.argv[sys.argv.index("--") + 1 :]
    return sys.argv[1:] if bpy.app.binary_path == "" else []
