"""The preview is the core's picture of the visible objects, and worker failures are reported."""

import importlib
import inspect
import os
import queue
import re
import signal
import stat
import sys
import types

import numpy as np
import pytest

from r5dgs_core import errors
from r5dgs_core.playback import scene_player
from r5dgs_core.render import posed_scene, scene_renderer
from r5dgs_core.scene import cameras, quality, scene_file
from r5dgs_core.scene.instance import Instance
from tests.support import layouts, motions, patience, scenes

pytest.importorskip("bpy", reason="bpy is not installed; it comes with the extra 'test' on Python 3.11")

from mathutils import Matrix, Vector  # noqa: E402  (bpy brings it)


@pytest.fixture
def scene_path(tmp_path):
    scene = scenes.make_scene(n=400, objects=3, sh_degree=2, seed=4, world_convention="colmap")
    return scene_file.write(scene, tmp_path / "scene.r5dgs")


@pytest.fixture
def worker(blender, monkeypatch):
    monkeypatch.delenv("R5DGS_PYTHON", raising=False)
    return importlib.import_module("r5dgs.r5dgs_addon.worker.jobs")  # one worker serves all tests that do not break it


@pytest.fixture
def loaded(blender, worker, scene_path):
    collection = motions.load_again(blender, scene_path)
    scene = scene_file.read(scene_path)
    place_camera(blender, collection, scene.cameras[0])
    return collection


def place_camera(bpy, collection, camera, convention="colmap"):
    data = bpy.data.cameras.new("view")
    data.sensor_fit = "HORIZONTAL"
    data.lens = camera.intrinsics[0, 0] * data.sensor_width / camera.width
    obj = bpy.data.objects.new("view", data)
    bpy.context.scene.collection.objects.link(obj)
    world = np.eye(4)
    world[:3, :3] = cameras.WORLD_TO_BLENDER[convention]
    obj.matrix_world = Matrix((world @ cameras.cam_world_to_opengl(camera.T_cam_world)).tolist())
    render = bpy.context.scene.render
    render.resolution_x, render.resolution_y, render.resolution_percentage = camera.width, camera.height, 100
    bpy.context.scene.camera = obj
    return obj


def go_to(bpy, t):
    frame = 1 + 60 * t
    bpy.context.scene.frame_set(int(np.floor(frame)), subframe=float(frame % 1))


def preview(bpy):
    assert bpy.ops.r5dgs.preview() == {"FINISHED"}
    return pixels_of(bpy.data.images["R5DGS Preview"])


def pixels_of(image):
    pixels = np.empty(4 * image.size[0] * image.size[1], np.float32)
    image.pixels.foreach_get(pixels)
    return pixels.reshape(image.size[1], image.size[0], 4)[::-1, :, :3]


def core_picture(scene, pose):
    return np.clip(scene_renderer.render_frame(scene, pose, scene.cameras[0]).color, 0, 1)


def psnr(a, b):
    return -10 * np.log10(max(float(np.square(a.astype(np.float64) - b).mean()), 1e-12))


@pytest.mark.parametrize("t", [0.0, 0.3334, 0.9071])
def test_the_preview_is_the_cores_picture(blender, loaded, scene_path, t):
    scene = scene_file.read(scene_path)
    go_to(blender, t)
    assert psnr(preview(blender), core_picture(scene, scene_player.Player(scene).frame(t))) > 45


def test_preview_statistics_show_the_error_and_the_render_time(blender, loaded, scene_path):
    figures = importlib.import_module("r5dgs.r5dgs_addon.engine.render_stats")
    preview(blender)
    size = " x ".join(map(str, blender.data.images["R5DGS Preview"].size))
    assert re.fullmatch(rf"{size} in \d+ ms \(motion \d+, raster \d+\)", figures.speed())
    assert figures.errors() == [quality.measure(scene_file.read(scene_path), scene_path).text()]
    state = blender.context.window_manager.r5dgs_figures
    figures.remember(
        blender.data.images["R5DGS Preview"],
        {
            "ms_motion": 1.2,
            "ms_raster": 3.4,
            "scenes": [
                {"name": "a", "error": "41.5 dB", "unbent": 1200},
                {"name": "b", "error": "not known", "unbent": 34},
            ],
        },
    )
    assert state.ms_raster == pytest.approx(3.4) and figures.speed().endswith("(motion 1, raster 3)")
    assert figures.errors()[0] == "a: 41.5 dB; b: not known" and figures.errors()[1].startswith("1,234 Gaussians bend")


def test_saved_bytes_are_the_pictures_bytes(blender, loaded, scene_path, tmp_path):
    images = importlib.import_module("r5dgs_core.data.images")
    scene = scene_file.read(scene_path)
    go_to(blender, 0.5)
    preview(blender)
    image = blender.data.images["R5DGS Preview"]
    assert image.colorspace_settings.name == "sRGB" and not image.is_float
    image.filepath_raw, image.file_format = str(tmp_path / "saved.png"), "PNG"
    image.save()
    expected = np.round(255 * core_picture(scene, scene_player.Player(scene).frame(0.5)))
    saved = 255 * images.read(tmp_path / "saved.png")[..., :3].astype(np.float64)
    assert np.abs(saved - expected).max() <= 1.001


def test_hidden_objects_are_left_out_and_moved_ones_are_moved(blender, loaded, scene_path):
    scene = scene_file.read(scene_path)
    go_to(blender, scene.t_max)
    by_name = {obj.name: obj for obj in loaded.all_objects}
    by_name["mug"].hide_set(True)
    by_name["background"].hide_viewport = True
    by_name["red apple"].matrix_basis = Matrix.Translation((0.1, 0.2, -0.3)) @ Matrix.Rotation(0.7, 4, "X")
    instances = []
    for obj in by_name.values():
        if obj.r5dgs.role == "CLOUD" and obj.name not in ("mug", "background"):
            # At t_max anchor and parent inverse cancel, so only the cloud's own matrix remains.
            instances.append(Instance(obj.r5dgs.start, obj.r5dgs.count, np.array(obj.matrix_basis)))
    expected = core_picture(scene, posed_scene.pose_instances(scene, instances))
    everything = core_picture(scene, scene_player.Player(scene).frame(scene.t_max))
    shown = preview(blender)
    assert psnr(shown, expected) > 45 and psnr(everything, expected) < 30


def test_a_duplicate_is_drawn_twice_and_a_deleted_cloud_not_at_all(blender, loaded, scene_path):
    scene = scene_file.read(scene_path)
    go_to(blender, scene.t_max)
    apple = loaded.all_objects["red apple"]
    copy = apple.copy()
    apple.users_collection[0].objects.link(copy)
    copy.matrix_basis = Matrix.Translation((0.0, 0.0, 0.6))
    blender.data.objects.remove(loaded.all_objects["mug"])
    instances = [
        Instance(o.r5dgs.start, o.r5dgs.count, np.array(o.matrix_basis))
        for o in loaded.all_objects
        if o.r5dgs.role == "CLOUD"
    ]
    assert psnr(preview(blender), core_picture(scene, posed_scene.pose_instances(scene, instances))) > 45


def test_moving_the_whole_scene_with_its_camera_changes_nothing(blender, loaded):
    go_to(blender, 0.4)
    before = preview(blender)
    camera = blender.context.scene.camera
    change = Matrix.Translation((3, 1, -2)) @ Matrix.Rotation(1.1, 4, "Z") @ Matrix.Scale(2.5, 4)
    root = loaded.r5dgs.root
    camera.matrix_world = change @ camera.matrix_world
    root.matrix_world = change @ root.matrix_world
    assert psnr(preview(blender), before) > 45


@pytest.mark.parametrize("fit", ["AUTO", "HORIZONTAL", "VERTICAL"])
@pytest.mark.parametrize("size", [(64, 48, 100), (48, 64, 100), (120, 90, 50)])
def test_the_camera_projects_as_blenders_own(blender, loaded, fit, size):
    from bpy_extras.object_utils import world_to_camera_view

    picture = importlib.import_module("r5dgs.r5dgs_addon.engine.render_request")
    scene = blender.context.scene
    render = scene.render
    render.resolution_x, render.resolution_y, render.resolution_percentage = size
    data = scene.camera.data
    data.sensor_fit, data.sensor_height, data.shift_x, data.shift_y = fit, 20.0, 0.13, -0.21
    seen = picture.shown(blender.context.evaluated_depsgraph_get())
    width, height = seen.camera.width, seen.camera.height
    assert (width, height) == (size[0] * size[2] // 100, size[1] * size[2] // 100)
    points = np.random.default_rng(0).uniform(-1, 1, (20, 3))
    pixels, depth = cameras.project(seen.camera, points)
    for point, pixel, z in zip(points, pixels, depth, strict=True):
        x, y, distance = world_to_camera_view(scene, scene.camera, Vector(point))
        np.testing.assert_allclose(pixel, [x * width, (1 - y) * height], atol=2e-3)
        assert z == pytest.approx(distance, abs=1e-4)


def test_the_picture_has_the_size_that_blender_renders(blender, loaded, tmp_path):
    picture = importlib.import_module("r5dgs.r5dgs_addon.engine.render_request")
    render = blender.context.scene.render
    render.engine = "CYCLES"
    blender.context.scene.cycles.samples, blender.context.scene.cycles.use_denoising = 1, False
    render.filepath = str(tmp_path / "rendered.png")
    for size in [(100, 100, 29), (100, 50, 57), (33, 77, 29), (64, 48, 100)]:
        render.resolution_x, render.resolution_y, render.resolution_percentage = size
        blender.ops.render.render(write_still=True)
        rendered = blender.data.images.load(render.filepath)
        seen = picture.shown(blender.context.evaluated_depsgraph_get()).camera
        assert (seen.width, seen.height) == tuple(rendered.size), size
        blender.data.images.remove(rendered)


def test_pixel_aspect_is_part_of_the_camera(blender, loaded):
    picture = importlib.import_module("r5dgs.r5dgs_addon.engine.render_request")
    square = picture.shown(blender.context.evaluated_depsgraph_get()).camera.intrinsics
    blender.context.scene.render.pixel_aspect_x = 2.0
    wide = picture.shown(blender.context.evaluated_depsgraph_get()).camera.intrinsics
    assert wide[0, 0] / wide[1, 1] == pytest.approx(0.5 * square[0, 0] / square[1, 1], rel=1e-5)


def test_preview_with_a_panoramic_camera_raises(blender, loaded):
    blender.context.scene.camera.data.type = "PANO"
    with pytest.raises(RuntimeError, match="Perspective"):
        blender.ops.r5dgs.preview()


def test_a_moved_scene_file_is_found_beside_the_blend_and_a_missing_one_is_named(blender, loaded, scene_path, tmp_path):
    folder = tmp_path / "project"
    folder.mkdir()
    blender.ops.wm.save_as_mainfile(filepath=str(folder / "saved.blend"))
    scene_path.rename(folder / scene_path.name)
    preview(blender)
    (folder / scene_path.name).unlink()
    with pytest.raises(RuntimeError, match="scene.r5dgs.*Scene File"):
        blender.ops.r5dgs.preview()


class Window:
    """Stub of window and operator for `modal`, because bpy has no window."""

    def __init__(self, operator, job):
        self.workspace, self.window, self.windows, self.said, self.removed = self, self, [], [], []
        self.window_manager = self
        self.status_text_set, self.event_timer_remove = self.said.append, self.removed.append
        self.reports = []
        members = {"_job": job, "_timer": "timer", "report": lambda _, kind, text: self.reports.append((kind, text))}
        names = ("modal", "cancel", "_leave", "_answered", "_finish", "_summary", "waits_for")
        methods = {name: inspect.getattr_static(operator, name) for name in names if hasattr(operator, name)}
        self.operator = type("Operator", (), {**methods, **members})()

    def send(self, kind):
        return self.operator.modal(self, types.SimpleNamespace(type=kind))


@pytest.fixture
def windowed(blender, loaded):
    """Starts a preview as the window does."""
    operator = importlib.import_module("r5dgs.operators.preview").R5DGS_OT_preview
    picture = importlib.import_module("r5dgs.r5dgs_addon.engine.render_request")
    return lambda: Window(operator, picture.start(blender.context))


def test_a_preview_does_not_block_the_window(blender, loaded, worker, windowed):
    expected = preview(blender)
    blender.data.images.remove(blender.data.images["R5DGS Preview"])
    os.kill(worker.current().pid, signal.SIGSTOP)  # so that the job is still running
    window = windowed()
    assert worker.busy() and not blender.ops.r5dgs.preview.poll() and not blender.ops.r5dgs.check_worker.poll()
    assert window.send("MOUSEMOVE") == {"PASS_THROUGH"} and window.said == []
    assert window.send("TIMER") == {"PASS_THROUGH"} and "press Esc to stop" in window.said[-1]
    os.kill(worker._worker.pid, signal.SIGCONT)
    window.operator._job.join()
    assert window.send("TIMER") == {"FINISHED"}
    assert window.said[-1] is None and window.removed == ["timer"] and not worker.busy()
    np.testing.assert_array_equal(pixels_of(blender.data.images["R5DGS Preview"]), expected)


def test_the_picture_opens_in_empty_image_editors_or_the_user_is_told_to_open_one(blender, windowed, monkeypatch):
    editors = [types.SimpleNamespace(image=image) for image in ("another", None)]
    areas = [
        types.SimpleNamespace(type="IMAGE_EDITOR", spaces=types.SimpleNamespace(active=one), tag_redraw=lambda: None)
        for one in editors
    ]
    picture = importlib.import_module("r5dgs.r5dgs_addon.engine.render_request")
    monkeypatch.setattr(picture.bpy, "app", types.SimpleNamespace(background=False))
    for there, asked in ((areas, False), (areas[:1], True), ([], True)):
        window = windowed()
        window.screen = types.SimpleNamespace(areas=there)
        window.windows.append(window)
        window.operator._job.join()
        assert window.send("TIMER") == {"FINISHED"}
        assert ("open an Image Editor" in window.reports[-1][1]) == asked
    assert editors[0].image == "another" and editors[1].image == blender.data.images["R5DGS Preview"]


def test_escape_stops_a_preview_and_the_next_one_works(blender, loaded, worker, windowed):
    running = worker.current()
    os.kill(running.pid, signal.SIGSTOP)
    window = windowed()
    assert window.send("ESC") == {"CANCELLED"}
    assert not running.alive and not worker.busy()
    assert window.said == [None] and window.removed == ["timer"]
    assert {kind for report, _ in window.reports for kind in report} == {"INFO"}
    preview(blender)


def test_an_error_of_a_preview_in_the_window_is_reported(blender, loaded, worker, windowed):
    running = worker.current()
    os.kill(running.pid, signal.SIGSTOP)
    window = windowed()
    patience.wait_until(lambda: window.operator._job.doing == "loading the scenes")  # an earlier death is no error
    os.kill(running.pid, signal.SIGKILL)
    window.operator._job.join()
    assert window.send("TIMER") == {"CANCELLED"} and window.removed == ["timer"]
    assert "ended unexpectedly" in window.reports[-1][1]


@pytest.mark.slow
def test_a_worker_that_died_is_started_again_by_the_next_preview(blender, loaded, worker):
    preview(blender)
    first = worker.current()
    os.kill(first.pid, signal.SIGKILL)
    patience.wait_until(lambda: not first.alive)
    preview(blender)
    assert worker.current().pid != first.pid


def test_a_worker_that_dies_during_a_request_is_an_error_with_its_last_output(worker):
    running = worker.current()
    os.kill(running.pid, signal.SIGKILL)
    with pytest.raises(errors.BackendError, match="ended unexpectedly.*starts it again"):
        running.request("hello", timeout_s=20)
    assert worker.current().pid != running.pid


def test_a_worker_that_hangs_is_stopped(worker):
    running = worker.current()
    os.kill(running.pid, signal.SIGSTOP)
    with pytest.raises(errors.BackendError, match="no answer to 'hello' within"):
        running.request("hello", timeout_s=0.2)
    assert not running.alive


def fake_python(path, script):
    path.write_text(f"#!{sys.executable}\n{script}")
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return str(path)


def test_a_python_without_numba_is_named_with_the_remedy(blender, loaded, monkeypatch, tmp_path):
    script = (
        "import importlib.util, os, runpy, sys\n"
        "sys.path.insert(0, os.environ['PYTHONPATH'].split(os.pathsep)[0])\n"
        "find = importlib.util.find_spec\n"
        "importlib.util.find_spec = lambda name, *a: None if name == 'numba' else find(name, *a)\n"
        "runpy.run_module('r5dgs_core.worker.server', run_name='__main__')\n"
    )
    monkeypatch.setenv("R5DGS_PYTHON", fake_python(tmp_path / "python", script))
    with pytest.raises(RuntimeError, match="lacks numba.*pip install r5dgs"):
        blender.ops.r5dgs.preview()
    with pytest.raises(RuntimeError, match="lacks numba"):
        blender.ops.r5dgs.check_worker()


@pytest.mark.parametrize("kind", ["absent", "no python", "babbling"])
def test_a_wrong_python_is_named(blender, loaded, monkeypatch, tmp_path, kind):
    path = str(tmp_path / "nowhere" / "python")
    if kind == "no python":
        path = fake_python(tmp_path / "python", "raise SystemExit('I am not what you think')\n")
    elif kind == "babbling":
        path = fake_python(tmp_path / "python", "print('hello there', flush=True)\nimport time; time.sleep(60)\n")
    monkeypatch.setenv("R5DGS_PYTHON", path)
    with pytest.raises(RuntimeError, match="worker: .*python"):
        blender.ops.r5dgs.preview()


@pytest.mark.slow
def test_worker_test_reports_readiness_and_unregistering_stops_the_worker(blender, worker, capfd):
    assert blender.ops.r5dgs.check_worker() == {"FINISHED"}
    told = capfd.readouterr().out
    versions = r"\(Python 3\.\S+, R5DGS \S+, torch \S+, numba \S+\)"
    assert re.search(rf"Worker ready: .* {versions}, CPU, .*20,000 Gaussians at 400 x 400 in \d+ ms$", told, re.M), told
    assert "Worker ready" in " ".join(drawn_check(blender))
    running = worker.current()
    worker.unregister()
    assert not running.alive
    worker.register()


def drawn_check(bpy):
    """Texts below the button of *Test Worker*."""
    said = []
    module = importlib.import_module("r5dgs.r5dgs_addon.ui.worker_status")
    module.draw(layouts.Layout(bpy, said), bpy.context)
    return said


def test_progress_and_result_of_the_worker_test_are_drawn_under_its_button(blender, loaded, worker):
    running = worker.current()
    os.kill(running.pid, signal.SIGSTOP)
    module = importlib.import_module("r5dgs.operators.check_worker")
    check = importlib.import_module("r5dgs.r5dgs_addon.ui.worker_status")
    job = worker.start([("testing", "check", {})])
    check.begin(job)
    patience.wait_until(lambda: job.doing in ("testing", worker.notice()))
    assert re.search(rf"Testing: {re.escape(job.doing)}, \d+ s; press Esc to stop", " ".join(drawn_check(blender)))
    window = Window(module.R5DGS_OT_check_worker, job)
    assert window.send("ESC") == {"CANCELLED"} and "Stopped" in drawn_check(blender)
    check.begin(job)
    assert window.operator._answered(window) == {"CANCELLED"}
    assert "ended unexpectedly" in " ".join(drawn_check(blender))
    for kind in ("R5DGS_PT_preview", "R5DGS_AP_preferences"):
        assert "r5dgs.check_worker" in drawn_class(blender, kind)


def drawn_class(bpy, name):
    """Texts of a panel, or of the preferences."""
    if name == "R5DGS_PT_preview":
        return layouts.draw(bpy, getattr(bpy.types, name))
    said = []
    preferences = importlib.import_module("r5dgs.r5dgs_addon.preferences")
    fake = types.SimpleNamespace(layout=layouts.Layout(bpy, said), worker_python="", found_python="")
    fake.bl_rna = preferences.R5DGS_AP_preferences.bl_rna
    preferences.R5DGS_AP_preferences.draw(fake, bpy.context)
    return said


COMPILES = """
import json, os, sys

def say(header):
    print(json.dumps({**header, "arrays": []}), flush=True)

for line in sys.stdin:
    request = json.loads(line)
    if request["command"] == "warm":
        say({"event": "compiling", "text": "compiling"})
        say({"event": "progress", "text": "colors", "step": 3, "steps": 5})
        os.read(os.open(os.environ["GATE"], os.O_RDONLY), 1)
        say({"event": "ready", "seconds": 1.0})
    say({"id": request["id"], "ok": True, "result": {"missing": []}})
"""


def test_waiting_for_kernel_compilation_shows_a_notice(
    blender, loaded, worker, windowed, monkeypatch, tmp_path, caplog
):
    os.mkfifo(tmp_path / "gate")
    monkeypatch.setenv("GATE", str(tmp_path / "gate"))
    monkeypatch.setenv("R5DGS_PYTHON", fake_python(tmp_path / "python", COMPILES))
    assert worker.notice() == ""
    job = worker.start([("rendering", "warm", {})])
    with open(tmp_path / "gate", "w"):  # from here on the worker waits for the end of this block
        patience.wait_until(lambda: "step" in worker.notice())
        assert "rasterizer" in worker.notice() and job.doing == worker.notice()
        text, _, step = worker.notice().rpartition(", ")
        assert text in caplog.text and step == "step 3 of 5"
        window = Window(importlib.import_module("r5dgs.operators.preview").R5DGS_OT_preview, job)
        window.send("TIMER")
        assert worker.notice() in window.said[-1]
    job.answer()
    assert worker.notice() == "" and job.doing == "rendering"
    worker.stop()


@pytest.mark.parametrize("timeouts, done, outcome", [(10, False, "answer"), (10, True, "answer"), (3, False, "error")])
def test_compilation_extends_the_timeout_and_not_forever(blender, monkeypatch, tmp_path, timeouts, done, outcome):
    process = importlib.import_module("r5dgs.r5dgs_addon.worker.process")
    monkeypatch.setattr(process, "COMPILE_PATIENCE", timeouts)
    running = process.Worker(fake_python(tmp_path / "python", COMPILES))
    try:
        running.greet(120.0)
        running.notice, answers, late = process.COMPILING, running._answers, iter(range(5))
        if done:
            running._handle_event({"event": "ready"})
            assert running.notice == ""

        def get(timeout):
            if next(late, None) is not None:
                raise queue.Empty
            return answers.get(timeout=120.0)

        monkeypatch.setattr(running, "_answers", types.SimpleNamespace(get=get, put=answers.put))
        if outcome == "answer":
            assert running.request("hello", 60.0 if done else 0.1) == ({"missing": []}, {})
        else:
            with pytest.raises(errors.BackendError, match="no answer to 'hello'"):
                running.request("hello", 0.1)
    finally:
        running.close()
