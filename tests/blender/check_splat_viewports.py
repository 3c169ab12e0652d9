"""Check that splats follow what a viewport shows: projection, visibility, quad view, windows, undo, files, renders.

    xvfb-run -a -s "-screen 0 1280x800x24 +extension GLX" \\
        blender --factory-startup --python tests/blender/check_splat_viewports.py -- SCENE.r5dgs [PICTURES [CHECK ...]]

Needs ImageMagick, but no worker: pictures are compared with those drawn after all cached data was dropped. Exits with 1
if one differs. CHECK is the name of a function in `CHECKS`; all run by default.
"""

import inspect
import sys
import tempfile
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix, Vector

sys.path.insert(0, str(Path(__file__).parent))
from check_splats import MIN_DB, psnr, redraw, screenshot, shown_region  # noqa: E402
from window import area_of, hover, inside, main_window, press, region_of, run, service  # noqa: E402

out = Path()


def seen(name: str) -> np.ndarray:
    """Screenshot of the 3D view, saved under a name."""
    redraw()
    return shown_region(screenshot(out / f"{name}.png"))[0]


def compare(what: str, found: np.ndarray, wanted: np.ndarray) -> None:
    """Print the difference of two pictures, and fail if it is too large."""
    value = psnr(found, wanted)
    print(f"{what}: {value:.1f} dB", flush=True)
    assert value > MIN_DB


def checks(path: str, folder: str = "", *chosen: str):
    """Run the checks. Yields the seconds to wait after each step."""
    global out
    out = Path(folder or tempfile.mkdtemp())
    out.mkdir(parents=True, exist_ok=True)
    bpy.context.preferences.view.show_splash = False
    for obj in list(bpy.data.objects):
        bpy.data.objects.remove(obj)
    with inside():
        bpy.ops.ed.undo_push(message="Empty")
        bpy.ops.r5dgs.load_scene(filepath=path)
    space = area_of("VIEW_3D").spaces[0]
    space.overlay.show_overlays, space.show_gizmo = False, False
    with inside():
        bpy.ops.ed.undo_push(message="Load")
    yield 0.5
    before = seen("before")
    given = chosen or [check.__name__ for check in CHECKS]
    for check in (check for check in CHECKS if check.__name__ in given):
        yield from check(before)
        print(f"ok: {inspect.getdoc(check)}", flush=True)
    print("message:", repr(service("splats.viewport_splats").message(bpy.context)), flush=True)


def check_projection(before: np.ndarray):
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
    assert psnr(seen("covered"), before) < MIN_DB
    space.show_object_viewport_mesh = False
    yield 0.5
    compare("mesh hidden in this viewport only", seen("uncovered"), before)
    space.show_object_viewport_mesh = True
    bpy.data.objects.remove(cube)
    yield 0.5


def check_quad_view(before: np.ndarray):
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


def check_viewport_render(before: np.ndarray):
    """*Viewport Render with Splats* equals the window, and a mesh hides what is behind it."""
    scene, area = main_window().scene, area_of("VIEW_3D")
    region, space = region_of(area), area.spaces[0]
    scene.render.resolution_x, scene.render.resolution_y = region.width, region.height
    inner = shown_region(screenshot(out / "window.png"))[1]
    for shading in ("SOLID", "MATERIAL"):
        space.shading.type = shading
        yield 1.0
        compare(f"viewport render, {shading}", viewport_render(shading.lower())[inner], seen(f"window_{shading}"))
    middle, toward = space.region_3d.view_location, space.region_3d.view_rotation @ Vector((0, 0, 1))
    for shading in ("MATERIAL", "SOLID"):
        space.shading.type = shading
        for name, away in (("before", 0.5), ("behind", -3.0)):
            distance = away * space.region_3d.view_distance
            bpy.ops.mesh.primitive_plane_add(size=50 * space.region_3d.view_distance)
            wall = bpy.context.object
            wall.matrix_world = Matrix.LocRotScale(middle + distance * toward, space.region_3d.view_rotation, None)
            wall.select_set(False)
            yield 1.0
            found = viewport_render(f"{shading.lower()}_{name}")[inner]
            same = (np.abs(found - seen(f"window_{shading}_{name}")).max(-1) < 0.1).mean()
            print(
                f"viewport render, {shading}, wall {name}: {100 * same:.1f} % of the pixels as on the screen",
                flush=True,
            )
            assert same > 0.95 and (found.std(axis=(0, 1)).max() < 0.05) == (name == "before")
            bpy.data.objects.remove(wall)
    last, scene.frame_end = scene.frame_end, 2
    scene.render.filepath = str(out / "viewport_")
    with inside():
        bpy.ops.r5dgs.viewport_render(animation=True)
    scene.frame_end = last
    assert all((out / f"viewport_{frame:04d}.png").stat().st_size > 1000 for frame in (1, 2))
    yield 0.5


def viewport_render(name: str) -> np.ndarray:
    """Picture of *Viewport Render with Splats*, also saved under a name. [H, W, 3]"""
    with inside():
        assert bpy.ops.r5dgs.viewport_render() == {"FINISHED"}
    image = bpy.data.images["R5DGS Viewport"]
    values = np.empty(4 * image.size[0] * image.size[1], np.float32)
    image.pixels.foreach_get(values)
    image.filepath_raw, image.file_format = str(out / f"render_{name}.png"), "PNG"
    image.save()
    return values.reshape(image.size[1], image.size[0], 4)[::-1, :, :3]


def check_local_view(before: np.ndarray):
    """A local view shows its own splats only, like a view in which the others are hidden."""
    clouds = [obj for obj in main_window().scene.objects if obj.r5dgs.role == "CLOUD"]
    chosen = max((one for one in clouds if one.r5dgs.object_id > 0), key=lambda one: one.r5dgs.count)
    with inside():
        bpy.ops.object.select_all(action="DESELECT")
        chosen.select_set(True)
        bpy.ops.view3d.localview(frame_selected=False)
    yield 0.5
    found = seen("local_view")
    with inside():
        bpy.ops.view3d.localview(frame_selected=False)
    compare("after a local view", seen("after_local_view"), before)
    for cloud in clouds:
        cloud.hide_set(cloud != chosen)
    yield 0.5
    compare("local view", found, seen("others_hidden"))
    assert psnr(found, before) < MIN_DB
    for cloud in clouds:
        cloud.hide_set(False)
    yield 0.5


def check_selection(before: np.ndarray):
    """A selected object is marked at its corners, and a mesh elsewhere changes nothing in the picture."""
    space, scene = area_of("VIEW_3D").spaces[0], main_window().scene
    space.overlay.show_overlays, space.overlay.show_cursor, space.overlay.show_text = True, False, False
    with inside():
        bpy.ops.object.select_all(action="DESELECT")
    yield 0.5
    plain = seen("overlays")
    compare("overlays", plain, before)
    chosen = max((one for one in scene.objects if one.r5dgs.role == "ANCHOR"), key=lambda one: one.r5dgs.object_id)
    chosen.select_set(True)
    bpy.context.view_layer.objects.active = chosen
    yield 0.5
    found = seen("selected")
    marked = (np.abs(found - plain).max(-1) > 0.1).mean()
    print(f"selection: {100 * marked:.2f} % of the pixels", flush=True)
    assert 1e-4 < marked < 0.02
    bpy.ops.mesh.primitive_cube_add(location=(1e3, 1e3, 1e3))
    cube = bpy.context.object
    cube.select_set(False)
    chosen.select_set(True)
    bpy.context.view_layer.objects.active = chosen
    yield 0.5
    compare("beside a mesh", seen("selected_beside_mesh"), found)
    bpy.data.objects.remove(cube)
    light = bpy.data.objects.new("light", bpy.data.lights.new("light", "POINT"))
    scene.collection.objects.link(light)
    view = space.region_3d
    light.location = view.view_location + view.view_rotation @ Vector((0, 0, 0.7 * view.view_distance))
    yield 0.5
    assert (np.abs(seen("light") - found).max(-1) > 0.1).sum() > 30, "a light before the splats is not visible"
    bpy.data.objects.remove(light)
    space.overlay.show_overlays = False
    yield 0.5


def check_undo_of_loading(before: np.ndarray):
    """Undo of loading removes the picture, and redo brings it back."""
    steps = 0
    while any(one.r5dgs.is_scene for one in bpy.data.collections):
        with inside():
            bpy.ops.ed.undo()
        steps += 1
        assert steps < 50
        yield 0.1
    yield 1.0
    assert seen("unloaded").std() < 0.02, "something is visible after undo"
    for _ in range(steps):
        with inside():
            bpy.ops.ed.redo()
        yield 0.1
    yield 1.0
    compare("after redo of loading", seen("loaded_again"), before)


def check_camera_images(before: np.ndarray):
    """A captured image is visible over the splats in the view through its camera, and only there; it follows keys."""
    space, scene = area_of("VIEW_3D").spaces[0], main_window().scene
    loaded = next(one for one in bpy.data.collections if one.r5dgs.is_scene)
    camera, frame = service("scene.captured_cameras").all_of(loaded)[0], scene.frame_current
    folder, view = out / "images", space.region_3d
    kept = {"view_rotation": view.view_rotation.copy(), "view_location": view.view_location.copy()}
    kept["view_distance"] = view.view_distance
    for number, color in enumerate(((1, 0, 0, 1), (0, 0, 1, 1))):
        image = bpy.data.images.new("plain", 8, 8)
        image.pixels.foreach_set(np.tile(np.float32(color), 64))
        path = folder / camera["r5dgs_captured"]["name"] / f"{number}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        image.filepath_raw, image.file_format = str(path), "PNG"
        image.save()
        bpy.data.images.remove(image)
    with inside():
        bpy.ops.ed.undo_push(message="Before")
        bpy.ops.r5dgs.use_captured_camera(camera=camera.name)
    yield 0.5
    through = seen("through_camera")
    with inside():
        bpy.ops.r5dgs.show_captured_images(directory=str(folder))
    space.overlay.show_overlays = True
    yield 0.5
    for key, (first, second) in (("shift+Left", (0, 2)), ("shift+Right", (2, 0))):  # first and last frame
        yield from hover(region_of(area_of("VIEW_3D")))
        yield from press(key)
        yield 0.5
        found = seen(f"captured_image_{key}")
        share = (found[..., first] - found[..., second] > 0.3).mean()
        print(f"captured image after {key}, frame {scene.frame_current}: {share:.0%} of the pixels", flush=True)
        assert 0.1 < share < 1
    scene.frame_set(frame)
    space.overlay.show_overlays = False
    yield 0.5
    compare("without overlays", seen("without_image"), through)
    view.view_perspective = "PERSP"  # seen from the camera
    for name, value in kept.items():
        setattr(view, name, value)
    with inside():
        bpy.ops.ed.undo_push(message="After")
    yield 0.5


def check_undo(before: np.ndarray):
    """Undo of a change and its redo change the picture, and undo brings the first one back."""
    anchor = next(obj for obj in main_window().scene.objects if obj.r5dgs.role == "CLOUD" and obj.r5dgs.object_id > 0)
    with inside():
        bpy.ops.ed.undo_push(message="Before")
        anchor.hide_viewport = True
        bpy.ops.ed.undo_push(message="Hide")
    yield 0.5
    changed = seen("changed")
    for step, wanted in (("undo", before), ("redo", changed), ("undo", before)):
        with inside():
            getattr(bpy.ops.ed, step)()
        yield 1.0
        compare(step, seen(step), wanted)
    assert psnr(changed, before) < 60


def check_scene_switch(before: np.ndarray):
    """Another Blender scene shows no splats; the first one shows its own again."""
    window = main_window()
    first, other = window.scene, bpy.data.scenes.new("empty")
    window.scene = other
    yield 1.0
    empty = seen("empty_scene")
    assert empty.std() < 0.02, "an empty scene shows something"
    window.scene = first
    yield 1.0
    bpy.data.scenes.remove(other)
    compare("after a scene switch", seen("after_switch"), before)


def check_reopen(before: np.ndarray):
    """A saved and reopened file shows the same splats; without the extension it shows points."""
    bpy.ops.wm.save_as_mainfile(filepath=str(out / "saved.blend"))
    yield 1.0
    compare("after saving", seen("after_saving"), before)
    bpy.ops.wm.open_mainfile(filepath=str(out / "saved.blend"))
    yield 2.0
    compare("after reopening", seen("after_reopening"), before)
    extension = sys.modules["r5dgs"]
    extension.unregister()
    yield 1.0
    points = seen("disabled")
    extension.register()
    yield 1.0
    assert points.std() > 0.02, "nothing is visible without the extension"
    compare("after enabling again", seen("enabled"), before)


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


CHECKS = (
    check_projection,
    check_meshes,
    check_local_view,
    check_selection,
    check_viewport_render,
    check_quad_view,
    check_windows,
    check_scene_switch,
    check_undo,
    check_undo_of_loading,
    check_camera_images,
    check_reopen,
    check_render,
)


if __name__ == "__main__":
    run(checks, *sys.argv[sys.argv.index("--") + 1 :])
