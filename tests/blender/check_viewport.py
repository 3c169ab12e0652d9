"""Check the engine R5DGS in Blender's window: Rendered viewports at rest and moving, F12, the live preview.

    xvfb-run -a -s "-screen 0 1280x800x24 +extension GLX" \\
        blender --factory-startup --python tests/blender/check_viewport.py -- SCENE.r5dgs

`R5DGS_PYTHON` sets the worker's Python if it is not found automatically. Exits with 1 if a picture is missing, F12
differs from the worker's picture, or a timer or job is still active after the file is closed.
"""

import sys
import time
from pathlib import Path

import bpy
import numpy as np
from mathutils import Quaternion

sys.path.insert(0, str(Path(__file__).parent))
from window import STEP_S, run, service, wait  # noqa: E402


def full_picture():
    """The full-size picture of the only viewport, or None."""
    viewports = [
        viewport
        for viewport in service("engine.viewport")._viewports
        if viewport._shown is not None and viewport.next() is None
    ]
    return viewports[0]._shown if viewports else None


def checks(path: str):
    """Run the check. Yields the seconds to wait after each step."""
    window = bpy.context.window_manager.windows[0]
    area = max((a for a in window.screen.areas if a.type == "VIEW_3D"), key=lambda a: a.width * a.height)
    region, space = next(r for r in area.regions if r.type == "WINDOW"), area.spaces[0]
    region_3d = space.region_3d
    with bpy.context.temp_override(window=window, area=area, region=region):
        bpy.ops.r5dgs.load_scene(filepath=path)
        bpy.ops.r5dgs.use_engine()
        bpy.ops.r5dgs.show_colors_as_trained()
    scene = window.scene
    scene.render.dither_intensity = 0
    scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = 320, 240, 100
    space.shading.type = "RENDERED"
    for kind in ("PERSP", "ORTHO", "CAMERA"):
        region_3d.view_perspective = kind
        area.tag_redraw()
        yield 0.5
        yield from wait(full_picture, kind)
        request, smaller = full_picture()
        assert smaller == 1 and (request.camera.width, request.camera.height) == (region.width, region.height), kind
        print(f"viewport {kind}: {region.width} x {region.height}", flush=True)

    region_3d.view_perspective = "PERSP"
    sizes, end = set(), time.monotonic() + 5
    while time.monotonic() < end:
        region_3d.view_rotation = region_3d.view_rotation @ Quaternion((0, 1, 0), 0.02)
        yield STEP_S
        sizes |= {
            (id(viewport._shown[0]), viewport._shown[1])
            for viewport in service("engine.viewport")._viewports
            if viewport._shown
        }
    print(f"moving: {len(sizes)} pictures in 5 s", flush=True)
    assert len(sizes) > 1

    with bpy.context.temp_override(window=window, area=area, region=region):
        bpy.ops.render.render("INVOKE_DEFAULT")
    yield 0.2
    yield from wait(lambda: not bpy.app.is_job_running("RENDER"), "F12")
    yield 0.5
    saved = Path(bpy.app.tempdir) / "rendered.png"
    bpy.data.images["Render Result"].save_render(str(saved))
    rendered = pixels(bpy.data.images.load(str(saved)))
    with bpy.context.temp_override(window=window):
        picture = service("engine.render_request")
        _, arrays = picture.render(picture.shown(bpy.context.evaluated_depsgraph_get()))
    error = float(np.square(rendered - np.clip(arrays["color"], 0, 1)).mean())
    print(f"F12: {-10 * np.log10(max(error, 1e-12)):.1f} dB", flush=True)
    assert error < 10**-4.5

    live = service("engine.live_preview")
    live.start()
    asked = []
    for frame in (10, 20, 30):
        scene.frame_set(frame)
        before = live._last_steps
        yield from wait(lambda before=before: live._last_steps is not before and live._job is None, "live preview")
        asked.append(live._last_steps)
    assert asked[0] != asked[1] != asked[2] and live.message() == ""
    bpy.ops.wm.read_homefile(app_template="")
    yield 2.0
    assert not live.running() and not bpy.app.timers.is_registered(service("engine.viewport").poll)
    print("closed: nothing goes on", flush=True)


def pixels(image: bpy.types.Image) -> np.ndarray:
    """Display-referred colours of an image, rows from the top. [H, W, 3]"""
    values = np.empty(4 * image.size[0] * image.size[1], np.float32)
    image.pixels.foreach_get(values)
    return values.reshape(image.size[1], image.size[0], 4)[::-1, :, :3]


if __name__ == "__main__":
    run(checks, sys.argv[sys.argv.index("--") + 1])
