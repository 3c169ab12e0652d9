"""Check that splats follow what a viewport shows: projection, local visibility, quad view, windows, renders.

    xvfb-run -a -s "-screen 0 1280x800x24 +extension GLX" \\
        blender --factory-startup --python tests/blender/check_splat_viewports.py -- SCENE.r5dgs [PICTURES]

Needs ImageMagick, but no worker: pictures are compared with those drawn after all cached data was dropped. Exits with 1
if one differs.
"""

import sys
import tempfile
from pathlib import Path

import bpy
import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
from check_splats import LEAST_DB, psnr, redraw, screenshot, shown_region  # noqa: E402
from window import area_of, inside, main_window, run, service  # noqa: E402

out = Path()


def seen(name: str) -> np.ndarray:
    """Screenshot of the 3D view, saved under a name."""
    redraw()
    return shown_region(screenshot(out / f"{name}.png"))[0]


def compare(what: str, found: np.ndarray, wanted: np.ndarray) -> None:
    """Print the difference of two pictures, and fail if it is too large."""
    value = psnr(found, wanted)
    print(f"{what}: {value:.1f} dB", flush=True)
    assert value > LEAST_DB


def checks(path: str, folder: str = ""):
    """Run the checks. Yields the seconds to wait after each step."""
    global out
    out = Path(folder or tempfile.mkdtemp())
    out.mkdir(parents=True, exist_ok=True)
    bpy.context.preferences.view.show_splash = False
    for obj in list(bpy.data.objects):
        bpy.data.objects.remove(obj)
    with inside():
        bpy.ops.r5dgs.load_scene(filepath=path)
    space = area_of("VIEW_3D").spaces[0]
    space.overlay.show_overlays, space.show_gizmo = False, False
    yield 0.5
    before = seen("before")
    yield from check_projection()
    yield from check_meshes(before)
    yield from check_quad_view()
    yield from check_windows(before)
    yield from check_render(before)
    print("message:", repr(service("splats.viewport_splats").message(bpy.context)), flush=True)


def check_projection():
    """The orthographic view equals that of a viewport that was never in perspective."""
    with inside():
        bpy.ops.view3d.view_persportho()
    yield 0.5
    found = seen("orthographic")
    service("splats.viewport_splats")._state.forget()
    compare("orthographic", found, seen("orthographic_again"))
    with inside():
        bpy.ops.view3d.view_persportho()
    yield 0.5


def check_meshes(before: np.ndarray):
    """A mesh that is hidden in the viewport does not occlude splats."""
    space = area_of("VIEW_3D").spaces[0]
    bpy.ops.mesh.primitive_cube_add(size=0.2 * space.region_3d.view_distance, location=space.region_3d.view_location)
    cube = bpy.context.object
    cube.select_set(False)
    yield 0.5
    assert psnr(seen("covered"), before) < LEAST_DB
    space.show_object_viewport_mesh = False
    yield 0.5
    compare("mesh hidden in this viewport only", seen("uncovered"), before)
    space.show_object_viewport_mesh = True
    bpy.data.objects.remove(cube)
    yield 0.5


def check_quad_view():
    """Each part of a quad view shows its own view."""
    pictures = service("splats.viewport_splats")._state.pictures
    with inside():
        bpy.ops.screen.region_quadview()
    yield 0.5
    redraw()
    screenshot(out / "quad_view.png")
    assert len(pictures) == 4, len(pictures)
    with inside():
        bpy.ops.screen.region_quadview()
    yield 0.5


def check_windows(before: np.ndarray):
    """A second window with another scene and frame changes nothing in the first, and leaves no data when it closes."""
    layers, pictures = service("splats.visible_splats")._layers, service("splats.viewport_splats")._state.pictures
    scene = main_window().scene
    bpy.ops.wm.window_new_main()
    second = bpy.context.window_manager.windows[-1]
    second.scene = other = bpy.data.scenes.new("other")
    other.collection.children.link(next(one for one in bpy.data.collections if one.r5dgs.is_scene))
    other.frame_set(scene.frame_current + 7)
    yield 1.0
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            area.tag_redraw()
    yield 2.0
    print(f"two windows: {len(layers)} view layers, {len(pictures)} pictures", flush=True)
    assert len(layers) == 2
    with bpy.context.temp_override(window=second):
        bpy.ops.wm.window_close()
    bpy.data.scenes.remove(other)
    area_of("VIEW_3D").spaces[0].region_3d.view_distance *= 1.001
    yield 1.0
    redraw()
    assert len(layers) == 1 and len(pictures) == 1, (len(layers), len(pictures))
    area_of("VIEW_3D").spaces[0].region_3d.view_distance /= 1.001
    yield 0.5
    compare("after a second window was closed", seen("after_windows"), before)


def check_render(before: np.ndarray):
    """Rendering an animation in a thread does not change the viewport."""
    scene, done = main_window().scene, []
    scene.camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    scene.collection.objects.link(scene.camera)
    scene.render.engine, scene.render.filepath = "BLENDER_WORKBENCH", str(out / "animation")
    scene.render.resolution_x = scene.render.resolution_y = 64
    scene.frame_start, scene.frame_end = 1, 30
    frame = scene.frame_current
    bpy.app.handlers.render_complete.append(lambda *_: done.append(True))
    bpy.context.preferences.view.render_display_type = "NONE"
    with inside():
        bpy.ops.render.render("INVOKE_DEFAULT", animation=True)
    while not done:
        area_of("VIEW_3D").tag_redraw()
        yield 0.05
    scene.frame_set(frame)
    yield 1.0
    compare("after an animation was rendered", seen("after_render"), before)
    assert not service("splats.viewport_splats").message(bpy.context)


if __name__ == "__main__":
    run(checks, *sys.argv[sys.argv.index("--") + 1 :])
