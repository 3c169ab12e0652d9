"""Check actions of a user with keys and mouse in Blender's window: load, undo, type, click, stop long work by Esc.

    xvfb-run -a -s "-screen 0 1280x800x24 +extension GLX" blender --factory-startup --window-geometry 0 0 1280 800 \\
        --python tests/blender/check_window.py -- SCENE.r5dgs [CHECK ...]

Needs ``xdotool``. `R5DGS_PYTHON` sets the worker's Python if it is not found automatically. CHECK is the name of a
function in `CHECKS`; all run by default. Exits with 1 if one fails.
"""

import contextlib
import inspect
import os
import sys
import tempfile
import time
from pathlib import Path

import bpy
import numpy as np
from bpy_extras import view3d_utils

sys.path.insert(0, str(Path(__file__).parent))
import window as w  # noqa: E402
from check_viewport import full_picture, pixels  # noqa: E402

SIDEBAR = "R5DGS"


def loaded():
    """Collections of loaded scenes."""
    return [collection for collection in bpy.data.collections if collection.r5dgs.is_scene]


def load(path: Path) -> None:
    """Load the scene if none is loaded."""
    if not loaded():
        with w.inside():
            bpy.ops.r5dgs.load_scene(filepath=str(path))


def nothing_runs() -> bool:
    """Return True if no operator waits for events and no job waits for the worker."""
    return not w.main_window().modal_operators and not w.service("worker.jobs").busy()


def choose(folder: Path, name: str = ""):
    """Choose a file or folder in the open file browser, and press Enter."""
    yield from w.wait(lambda: any(area.type == "FILE_BROWSER" for area in w.main_window().screen.areas), "browser")
    yield 0.5
    params = w.area_of("FILE_BROWSER").spaces.active.params
    if params.directory != str(folder).encode() + b"/":
        params.directory = str(folder).encode() + b"/"
    if name:
        params.filename = name
    yield 0.5
    yield from w.hover(w.region_of(w.area_of("FILE_BROWSER")))
    yield from w.press("Return")


def browsing(path: Path, folder: Path):
    """The file browser and a drop load a scene; Ctrl+Z removes it, Ctrl+Shift+Z restores it."""
    with w.inside():
        bpy.ops.r5dgs.load_scene("INVOKE_DEFAULT")
    yield from choose(path.parent, path.name)
    yield from w.wait(loaded, "loading from the file browser")
    assert nothing_runs()
    view = w.region_of(w.area_of("VIEW_3D"))
    for x in (0.9, 0.5):  # leaving a message closes it
        yield 1.0
        yield from w.hover(view, x * view.width, 0.2 * view.height)
    yield 1.0
    yield from w.press("ctrl+z")
    yield from w.wait(lambda: not loaded() and not bpy.data.pointclouds, "Ctrl+Z")
    yield from w.press("ctrl+shift+z")
    yield from w.wait(lambda: len(loaded()) == 1, "Ctrl+Shift+Z")
    yield from w.press("ctrl+z")
    with w.inside():  # Blender calls this operator for a dropped file
        bpy.ops.wm.drop_import_file("INVOKE_DEFAULT", directory=str(path.parent), files=[{"name": path.name}])
    yield from w.wait(lambda: len(loaded()) == 1, "a drop")


def typing(path: Path, folder: Path):
    """Enter searches a prompt that was typed into the sidebar's field."""
    area = w.area_of("VIEW_3D")
    area.spaces.active.show_region_ui = True
    yield 0.5
    sidebar = w.region_of(area, "UI")
    sidebar.active_panel_category = SIDEBAR
    yield 1.0
    session = bpy.context.window_manager.r5dgs_words
    name = next(entry.name for entry in loaded()[0].r5dgs.table if entry.object_id > 0)
    for y in range(sidebar.height - 8, 0, -8):
        yield from w.hover(sidebar, 0.35 * sidebar.width, y)
        with w.inside(region="UI"):
            found = bpy.context.property
        if found is not None and found[1] == "prompt":
            break
    else:
        raise AssertionError("the sidebar shows no field for a prompt")
    yield from w.click()
    yield from w.write(name)
    yield from w.press("Return")
    assert session.prompt == session.asked == name, (session.prompt, session.asked)
    assert session.matches[0].name == name, [match.name for match in session.matches]


def clicking(path: Path, folder: Path):
    """A click on Gaussians selects the anchor that moves them."""
    area = w.area_of("VIEW_3D")
    region, view = w.region_of(area), area.spaces.active.region_3d
    with w.inside():
        bpy.ops.object.select_all(action="DESELECT")
        bpy.ops.view3d.view_all()
    yield 1.0
    hits = {}
    clouds = [obj for obj in loaded()[0].all_objects if obj.r5dgs.role == "CLOUD" and obj.r5dgs.object_id > 0]
    for cloud in clouds:
        if cloud.r5dgs.object_id in hits:
            continue
        places = np.empty(3 * len(cloud.data.points), np.float32)
        cloud.data.attributes["position"].data.foreach_get("vector", places)
        middle = cloud.matrix_world @ cloud.data.points[0].co.__class__(np.median(places.reshape(-1, 3), axis=0))
        pixel = view3d_utils.location_3d_to_region_2d(region, view, middle)
        yield from w.hover(region, *pixel)
        yield from w.click()
        yield 0.0  # timers run before the subscribers of changes
        active = bpy.context.view_layer.objects.active
        assert active.r5dgs.role != "CLOUD", f"{active.name}: not its anchor"
        hits[cloud.r5dgs.object_id] = active == cloud.parent
    print(f"clicks: {sum(hits.values())} of {len(hits)} objects selected by their anchors", flush=True)
    assert sum(hits.values()) > len(hits) / 2


def rendering(path: Path, folder: Path):
    """Esc stops F12 during a render, and the next F12 is complete."""
    scene = w.main_window().scene
    with w.inside():
        bpy.ops.r5dgs.use_engine()
        bpy.ops.r5dgs.show_colors_as_trained()
    render, ended = scene.render, []
    bpy.app.handlers.render_cancel.append(lambda *_: ended.append("cancelled"))
    bpy.app.handlers.render_complete.append(lambda *_: ended.append("complete"))
    job = w.service("worker.jobs")
    for size, stop in ((320, False), (6000, True), (320, False)):
        render.resolution_x, render.resolution_y, render.resolution_percentage = size, size * 3 // 4, 100
        yield from w.hover(w.region_of(w.area_of("VIEW_3D")))
        ended.clear()
        yield from w.press("F12")
        if stop:
            yield from w.wait(job.busy, "F12")
            yield 1.0
            assert job.busy() and not ended, "the picture was there before Esc"
            began = time.monotonic()
            yield from w.press("Escape")
        yield from w.wait(lambda: ended and not bpy.app.is_job_running("RENDER"), "F12")
        assert ended == ["cancelled" if stop else "complete"], ended
        if stop:
            print(f"F12: stopped {time.monotonic() - began:.1f} s after Esc", flush=True)
        yield 0.5
        yield from w.press("Escape")  # return from the render view
        yield 0.5
    assert nothing_runs()


def previewing(path: Path, folder: Path):
    """Esc stops a preview while the worker draws, and the next one works."""
    render, worker = w.main_window().scene.render, w.service("worker.jobs")
    for size in (320, 6000, 320):
        render.resolution_x, render.resolution_y, render.resolution_percentage = size, size * 3 // 4, 100
        yield from w.hover(w.region_of(w.area_of("VIEW_3D")))
        with w.inside():
            bpy.ops.r5dgs.preview("INVOKE_DEFAULT")
        if size == 6000:
            yield 1.0
            assert worker.busy(), "the preview was there before Esc"
            yield from w.press("Escape")
        yield from w.wait(nothing_runs, "preview")
        yield 0.5
        assert tuple(bpy.data.images["R5DGS Preview"].size) == (320, 240)


WRAPPERS = {
    "runs the worker as a child": '"{python}" "$@"\nexit $?\n',
    "ignores SIGTERM": 'trap "" TERM\n"{python}" "$@"\nexit $?\n',
    "never starts": "sleep 600\nexit 0\n",
}


def stopping(path: Path, folder: Path):
    """Esc ends a preview at once if Worker Python is a wrapper script, and no process is left."""
    render, worker, area = w.main_window().scene.render, w.service("worker.jobs"), w.area_of("VIEW_3D")
    render.resolution_x, render.resolution_y, render.resolution_percentage = 6000, 4500, 100
    chosen, python = os.environ.get("R5DGS_PYTHON"), w.service("preferences").worker_python()
    for number, (what, lines) in enumerate(WRAPPERS.items()):
        script = folder / f"wrapper{number}"
        script.write_text("#!/bin/sh\n" + lines.format(python=python))
        script.chmod(0o755)
        os.environ["R5DGS_PYTHON"] = str(script)
        yield from w.hover(w.region_of(area))
        with w.inside():
            bpy.ops.r5dgs.preview("INVOKE_DEFAULT")
        phase = "starting" if what == "never starts" else "rendering"
        yield from w.wait(lambda: any(phase in job.doing for job in worker._jobs), what)  # noqa: B023
        yield 1.0
        leader = worker._worker.pid
        began = time.monotonic()
        yield from w.press("Escape")
        yield from w.wait(nothing_runs, what)
        print(f"a wrapper that {what}: free {time.monotonic() - began:.2f} s after Esc", flush=True)
        yield from w.wait(lambda: not processes_of(leader), f"{what}: {processes_of(leader)}")  # noqa: B023
    os.environ.pop("R5DGS_PYTHON")
    os.environ.update({"R5DGS_PYTHON": chosen} if chosen else {})


def processes_of(group: int) -> list[str]:
    """Processes of a group that are not zombies, as /proc lists them."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            state, _, member = stat.read_text().rpartition(")")[2].split()[:3]
            found += [stat.parent.name] if int(member) == group and state != "Z" else []
    return found


def looking(path: Path, folder: Path):
    """A border drawn with Ctrl+B crops F12 but not the Rendered viewport; the eyes of a stereo render differ."""
    scene, area = w.main_window().scene, w.area_of("VIEW_3D")
    region, space, render = w.region_of(area), area.spaces[0], scene.render
    with w.inside():
        bpy.ops.r5dgs.use_engine()
        bpy.ops.r5dgs.show_colors_as_trained()
    render.resolution_x, render.resolution_y, render.resolution_percentage = 320, 240, 100
    space.region_3d.view_perspective, space.shading.type = "CAMERA", "RENDERED"
    yield from w.hover(region)
    yield from w.wait(full_picture, "viewport")
    middle = np.array([region.width, region.height]) / 2
    yield from w.press("ctrl+b")
    yield from w.drag(region, tuple(middle * 0.9), tuple(middle * 1.2))
    assert render.use_border and render.border_max_x - render.border_min_x < 0.7
    yield 1.0
    yield from w.wait(full_picture, "viewport")
    camera = full_picture()[0].camera
    assert (camera.width, camera.height) == (region.width, region.height)
    space.shading.type, space.region_3d.view_perspective = "SOLID", "PERSP"
    yield from render_by_key()
    (seen,) = saved_pictures(scene, folder / "border")
    assert 0.05 < (seen.max(axis=-1) > 0).mean() < 0.7, "the border does not cut F12"
    render.use_border, render.use_multiview = False, True
    yield from render_by_key()
    left, right = saved_pictures(scene, folder / "stereo")
    render.use_multiview = False
    assert left.std() > 0.05 and np.abs(left - right).max() > 0.1, "both eyes see the same"


def render_by_key():
    """Press F12, wait for the picture, and return to the 3D view."""
    yield from w.hover(w.region_of(w.area_of("VIEW_3D")))
    yield from w.press("F12")
    yield from w.wait(lambda: not w.service("worker.jobs").busy() and not bpy.app.is_job_running("RENDER"), "F12")
    yield 0.5
    yield from w.press("Escape")


def saved_pictures(scene: bpy.types.Scene, stem: Path) -> list[np.ndarray]:
    """Images of the last render as saved by Blender, one per view. [H, W, 3] each"""
    settings = scene.render.image_settings
    settings.file_format, settings.views_format = "PNG", "INDIVIDUAL"
    with contextlib.suppress(RuntimeError):  # 4.3 reports an error for the missing file without a view's name
        bpy.data.images["Render Result"].save_render(f"{stem}.png", scene=scene)
    return [pixels(bpy.data.images.load(str(file))) for file in sorted(stem.parent.glob(f"{stem.name}*.png"))]


def exporting(path: Path, folder: Path):
    """Esc stops exports: only finished files are kept, and the frame is restored."""
    scene = w.main_window().scene
    scene.render.resolution_x, scene.render.resolution_y = 320, 240
    scene.frame_set(7)
    running = w.service("ui.stepwise_operator")
    blink, running.BLINK_S = running.BLINK_S, 1e-4  # each step draws the window and processes Esc
    for operator, name in (("export_masks", ""), ("export_ply", "a.ply"), ("export_scene", "b.r5dgs")):
        target = folder / operator
        target.mkdir()
        path_of = {"filepath": str(target / name)} if name else {"directory": str(target)}
        ranged = {} if operator == "export_scene" else {"frames": "RANGE"}
        with w.inside():
            getattr(bpy.ops.r5dgs, operator)("INVOKE_DEFAULT", **path_of, **ranged)
        yield from choose(target, name)
        wanted = [] if operator == "export_scene" else [f".{'png' if operator == 'export_masks' else 'ply'}"]
        finished = lambda: [p for p in target.rglob("*") if p.suffix in wanted]  # noqa: B023, E731
        yield from w.wait(lambda: w.main_window().modal_operators, operator)
        if wanted:
            yield from w.wait(lambda: len(finished()) > 2, operator)  # noqa: B023
        yield from w.press("Escape")
        yield from w.wait(nothing_runs, operator)
        yield 1.0
        count = len(finished())
        print(f"{operator}: stopped by Esc after {count} files", flush=True)
        frames = scene.frame_end - scene.frame_start + 1
        assert scene.frame_current == 7 and count < frames
        others = [p for p in target.rglob("*") if p.is_file() and p.suffix not in (*wanted, ".json")]
        assert not others, others
    running.BLINK_S = blink
    with w.inside():
        bpy.ops.r5dgs.export_scene("INVOKE_DEFAULT", filepath=str(folder / "c.r5dgs"))
    yield from choose(folder, "c.r5dgs")
    yield from w.wait(lambda: (folder / "c.r5dgs").exists() and nothing_runs(), "export_scene")


def capturing(path: Path, folder: Path):
    """Esc stops a capture and leaves nothing; an undisturbed capture is complete."""
    scene = w.main_window().scene
    engine = scene.render.engine
    few = {"resolution_x": 64, "resolution_y": 48, "samples": 1, "denoise": False, "rig": "ARC"}
    with w.inside():
        bpy.ops.r5dgs.capture_dataset("INVOKE_DEFAULT", directory=str(folder / "stopped"), **few)
    yield from w.wait(lambda: any(folder.glob("*stopped*/*/*.png")), "capture")
    yield from w.press("Escape")
    yield from w.wait(nothing_runs, "Esc")
    assert not any(folder.glob("*stopped*")), list(folder.iterdir())
    assert scene.render.engine == engine
    (folder / "whole").mkdir()
    with w.inside():
        bpy.ops.r5dgs.capture_dataset("INVOKE_DEFAULT", **few, frame_end=2, rig_observed=2, rig_novel=1)
    yield from choose(folder / "whole")  # the file browser opens again, although a folder was chosen before
    yield from w.wait(lambda: (folder / "whole" / "objects.json").exists() and nothing_runs(), "capture")
    assert scene.render.engine == engine


def merging(path: Path, folder: Path):
    """Merge with Meshes shows the nearer of the Gaussians and a wall, which Cycles or EEVEE renders."""
    scene = w.main_window().scene
    with w.inside():
        bpy.ops.r5dgs.use_engine()
        bpy.ops.r5dgs.show_colors_as_trained()
    render = scene.render
    render.resolution_x, render.resolution_y, render.resolution_percentage = 160, 120, 100
    render.dither_intensity = 0
    picture = w.service("engine.render_request")
    with bpy.context.temp_override(window=w.main_window()):
        seen = picture.shown(bpy.context.evaluated_depsgraph_get())
        _, arrays = picture.render(seen, ("depth", "alpha"))
    solid = arrays["alpha"] > 0.6
    wall = float(np.median(arrays["depth"][solid]))  # in the middle of the view
    mesh = bpy.data.meshes.new("wall")
    mesh.from_pydata([(x, y, -wall) for x, y in ((-99, -99), (99, -99), (99, 99), (-99, 99))], [], [(0, 1, 2, 3)])
    plane = bpy.data.objects.new("wall", mesh)
    scene.collection.objects.link(plane)
    plane.matrix_world = scene.camera.matrix_world.normalized()
    for engine in ("CYCLES", w.service("compat").EEVEE):
        with w.inside():
            assert bpy.ops.r5dgs.merge_with_meshes(engine=engine) == {"FINISHED"}
        meshes = scene.r5dgs_render.meshes
        assert meshes.render.engine == engine
        meshes.cycles.samples = meshes.eevee.taa_render_samples = 4
        meshes.cycles.use_denoising = False
        with w.inside():
            bpy.ops.render.render(scene=scene.name)
        saved = folder / f"{engine}.png"
        render.image_settings.file_format = "PNG"
        bpy.data.images["Render Result"].save_render(str(saved), scene=scene)
        same = (
            np.abs(pixels(bpy.data.images.load(str(saved))) - np.clip(arrays["color"], 0, 1)).max(axis=-1) < 8 / 255
        )  # Gaussians reach through the wall
        nearer, farther = solid & (arrays["depth"] < 0.95 * wall), solid & (arrays["depth"] > 1.05 * wall)
        print(
            f"Merge with Meshes by {engine}: of {nearer.sum()} pixels before the wall {same[nearer].mean():.1%} are "
            f"the Gaussians', of {farther.sum()} behind it {same[farther].mean():.1%}",
            flush=True,
        )
        assert same[nearer].mean() > 0.95 and same[farther].mean() < 0.05, engine
    with w.inside():
        assert bpy.ops.r5dgs.stop_merging() == {"FINISHED"}
    bpy.data.objects.remove(plane)
    yield 0.5


def selecting(path: Path, folder: Path):
    """Drags with the tools *Brush Gaussians* and *Lasso Gaussians* select Gaussians in one undo step each."""
    points, region = w.service("clean_up.selected_points"), w.region_of(w.area_of("VIEW_3D"))
    path = [(x * region.width, y * region.height) for x, y in ((0.3, 0.7), (0.6, 0.2), (0.7, 0.6))]
    with w.inside():
        bpy.ops.view3d.view_all()
    for tool in ("brush", "lasso"):
        with w.inside():
            bpy.ops.ed.undo_push(message="View")
            bpy.ops.wm.tool_set_by_id(name=f"r5dgs.{tool}_tool")
        yield 1.0
        yield from w.drag(region, *path)
        count = points.count(loaded()[0])
        assert count > 0, f"the {tool} selected nothing"
        yield from w.press("ctrl+z")
        yield from w.wait(lambda: points.count(loaded()[0]) == 0, f"{tool}: Ctrl+Z")
        yield from w.press("ctrl+shift+z")
        yield from w.wait(lambda: points.count(loaded()[0]) == count, f"{tool}: Ctrl+Shift+Z")  # noqa: B023
        with w.inside():
            bpy.ops.wm.tool_set_by_id(name="builtin.select_box")
            bpy.ops.r5dgs.select_gaussians(action="NONE")


CHECKS = (
    browsing,
    typing,
    clicking,
    selecting,
    rendering,
    previewing,
    stopping,
    looking,
    exporting,
    capturing,
    merging,
)


def checks(path: Path, chosen: list):
    """Run the checks in order. Yields the seconds to wait after each step."""
    view = bpy.context.preferences.view
    view.filebrowser_display_type = view.render_display_type = "SCREEN"
    with tempfile.TemporaryDirectory(prefix="r5dgs-window-") as folder:
        bpy.data.objects.remove(bpy.data.objects["Cube"])
        bpy.ops.ed.undo_push(message="Remove Cube")  # else Ctrl+Z brings it back
        yield 1.0
        for check in chosen:
            if check != browsing:
                load(path)
            yield 0.5
            yield from check(path, Path(folder))
            print(f"ok: {inspect.getdoc(check)}", flush=True)


def main(arguments: list[str]) -> None:
    """Run the checks named on the command line, or all."""
    unknown = set(arguments[1:]) - {check.__name__ for check in CHECKS}
    if unknown:
        raise SystemExit(f"{', '.join(unknown)}: expected some of {', '.join(check.__name__ for check in CHECKS)}")
    chosen = [check for check in CHECKS if not arguments[1:] or check.__name__ in arguments[1:]]
    w.run(checks, Path(arguments[0]).resolve(), chosen)


if __name__ == "__main__":
    main(sys.argv[sys.argv.index("--") + 1 :])
