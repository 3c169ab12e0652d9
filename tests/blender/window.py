"""Helpers of checks that run inside Blender's window: the extension, waiting, and simulated keys and mouse.

Keys and mouse events are sent by ``xdotool``. Without a window manager they go to the window under the pointer.
"""

import importlib
import importlib.util
import os
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path

import bpy

ROOT = Path(__file__).resolve().parents[2]
PATIENCE_S = 240.0  # the first picture may compile the rasterizer
STEP_S = 0.02
KEY_S = 0.3  # until Blender has processed an action of the user


def register() -> None:
    """Register the extension of this repository."""
    spec = importlib.util.spec_from_file_location("r5dgs", ROOT / "__init__.py", submodule_search_locations=[str(ROOT)])
    module = importlib.util.module_from_spec(spec)
    sys.modules["r5dgs"] = module
    spec.loader.exec_module(module)
    module.register()


def service(name: str):
    """Module of the add-on."""
    return importlib.import_module(f"r5dgs.r5dgs_addon.{name}")


def wait(condition: Callable[[], object], what: str) -> Iterator[float]:
    """Let Blender run until a condition holds."""
    end = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < end, f"{what}: nothing within {PATIENCE_S:g} s"
        yield STEP_S


def main_window() -> bpy.types.Window:
    """Blender's first window."""
    return bpy.context.window_manager.windows[0]


def area_of(kind: str) -> bpy.types.Area:
    """The largest area of a kind in the first window."""
    areas = [area for area in main_window().screen.areas if area.type == kind]
    return max(areas, key=lambda area: area.width * area.height)


def region_of(area: bpy.types.Area, kind: str = "WINDOW") -> bpy.types.Region:
    """The region of a kind in an area."""
    return next(region for region in area.regions if region.type == kind)


def inside(kind: str = "VIEW_3D", region: str = "WINDOW"):
    """A context in the largest area of a kind."""
    area = area_of(kind)
    return bpy.context.temp_override(window=main_window(), area=area, region=region_of(area, region))


def hover(region: bpy.types.Region, x: float | None = None, y: float | None = None) -> Iterator[float]:
    """Move the mouse to a pixel of a region, counted from its lower left corner; by default to its middle."""
    x = region.width / 2 if x is None else x
    y = region.height / 2 if y is None else y
    place = round(region.x + x), round(main_window().height - 1 - region.y - y)
    _xdotool("mousemove", *place)
    yield KEY_S


def press(*keys: str) -> Iterator[float]:
    """Press keys, such as ``ctrl+z``, in the region under the mouse."""
    for key in keys:
        _xdotool("key", key)
        yield KEY_S


def write(text: str) -> Iterator[float]:
    """Type a text."""
    _xdotool("type", "--delay", 40, text)
    yield KEY_S


def click() -> Iterator[float]:
    """Click the left button at the position of the mouse."""
    _xdotool("click", 1)
    yield KEY_S


def drag(region: bpy.types.Region, *path: tuple[float, float]) -> Iterator[float]:
    """Drag with the left button along pixels of a region."""
    yield from drag_across(*((region, place) for place in path))


def drag_across(*path: tuple[bpy.types.Region, tuple[float, float]]) -> Iterator[float]:
    """Drag with the left button along pixels of several regions."""
    (region, place), *others = path
    yield from hover(region, *place)
    _xdotool("mousedown", 1)
    yield KEY_S
    for region, place in others:
        yield from hover(region, *place)
    _xdotool("mouseup", 1)
    yield KEY_S


def run(checks: Callable[..., Iterator[float]], *arguments) -> None:
    """Run a generator of seconds to wait from a timer, then exit Blender with 0, or with 1 if it raised an error."""
    bpy.context.preferences.view.show_splash = False
    register()
    steps = checks(*arguments)

    def step():
        try:
            return next(steps)
        except StopIteration:
            code = 0
        except BaseException:
            traceback.print_exc()
            code = 1
        service("worker.jobs").stop()
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)  # quitting exits with 0

    bpy.app.timers.register(step, first_interval=1.0, persistent=True)


def _xdotool(*arguments) -> None:
    subprocess.run(["xdotool", *map(str, arguments)], check=True, timeout=30)
