"""Bad input gives a message with place and remedy, changes nothing, and leaves a .blend that saves and opens.

Each test prints the messages that the user sees; ``-rP`` shows them.
"""

import contextlib
import importlib
import os
import signal
import stat
import sys
import threading
import zipfile
from pathlib import Path

import pytest

from r5dgs_core.scene import scene_file
from tests.support import scenes

pytest.importorskip("bpy", reason="bpy is not installed; it comes with the extra 'test' on Python 3.11")

from tests.support import motions  # noqa: E402

KINDS = ("collections", "objects", "pointclouds", "meshes", "actions", "materials", "node_groups", "images", "scenes")
OWN_OF_BLENDER = {"Render Result", "Viewer Node"}  # images that every render creates


@pytest.fixture
def scene_path(tmp_path):
    folder = tmp_path / "captured"
    folder.mkdir()
    return scene_file.write(scenes.make_scene(n=300, objects=3, seed=1), folder / "synthetic.r5dgs")


def contents(bpy, users=0):
    """Names and user counts of all data-blocks that a user would notice."""
    found = {kind: {data.name for data in getattr(bpy.data, kind) if data.users >= users} for kind in KINDS}
    return {kind: sorted(names - OWN_OF_BLENDER) for kind, names in found.items()}


@contextlib.contextmanager
def refused(bpy, match):
    """Expect an error, and an unchanged state, both here and after saving and opening the .blend."""
    scene, before = bpy.context.scene, [contents(bpy), contents(bpy, 1)]  # unused data is not saved
    timeline = scene.frame_start, scene.frame_end, scene.frame_current, len(scene.timeline_markers)
    selected = [obj.name for obj in bpy.context.selected_objects]
    with pytest.raises(RuntimeError, match=f"(?s){match}") as caught:
        yield
    message = str(caught.value).strip()
    print(message)
    assert "Traceback" not in message and message.startswith("Error: ")
    for users in (0, 1):
        scene = bpy.context.scene
        assert contents(bpy, users) == before[users]
        assert (scene.frame_start, scene.frame_end, scene.frame_current, len(scene.timeline_markers)) == timeline
        assert [obj.name for obj in bpy.context.selected_objects] == selected
        bpy.ops.wm.save_mainfile()
        bpy.ops.wm.open_mainfile(filepath=bpy.data.filepath)


@pytest.fixture
def saved(blender, tmp_path):
    """Blender with a .blend that lies in a folder of its own."""
    folder = tmp_path / "project"
    folder.mkdir()
    blender.ops.wm.save_as_mainfile(filepath=str(folder / "work.blend"))
    return blender


@pytest.fixture
def loaded(saved, scene_path, monkeypatch):
    """`saved` with a scene, a camera and the render engine."""
    monkeypatch.delenv("R5DGS_PYTHON", raising=False)
    motions.load_again(saved, scene_path)
    render = saved.context.scene.render
    render.engine, render.resolution_x, render.resolution_y = "R5DGS", 64, 48
    saved.ops.wm.save_mainfile()
    return saved


def f12(bpy):
    """Render and save an image. Returns True if it was written."""
    path = Path(bpy.data.filepath).with_name("f12.png")
    path.unlink(missing_ok=True)
    bpy.context.scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)
    return path.is_file()


# --- loading ---


@pytest.fixture
def bad(tmp_path, scene_path):
    """Makes a bad input of a kind; returns its path."""

    def make(kind):
        path = tmp_path / f"{kind}.r5dgs"
        if kind == "newer":
            with_json(scene_path, path, lambda text: text.replace('"format_version": 1', '"format_version": 99'))
        elif kind == "folder of images":
            path = tmp_path / "images"
            path.mkdir()
            (path / "r_000.png").write_bytes(b"\x89PNG")
        elif kind == "image":
            path = tmp_path / "r_000.png"
            path.write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(500))
        elif kind == "no Gaussians":
            scene_file.write(scenes.make_scene(n=0, objects=0, unassigned=0, shadows=False), path)
        elif kind.startswith("truncated"):
            whole = scene_path.read_bytes()
            lengths = {"truncated at the end": len(whole) - 300, "truncated in the middle": len(whole) // 2}
            path.write_bytes(whole[: lengths.get(kind, 0)])
        return path

    return make


def with_json(source, target, change):
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(target, "w") as new:
        for name in old.namelist():
            data = old.read(name)
            if name == "scene.json":
                changed = change(data.decode())
                assert changed != data.decode()
                data = changed.encode()
            new.writestr(name, data)


REMEDIES = {
    "newer": "format.*99.*update R5DGS",
    "folder of images": "expected a .r5dgs file, found a folder.*r5dgs train",
    "image": "bake or copy it again",
    "no Gaussians": "expected Gaussians, found none",
    "truncated at the end": "bake or copy it again",
    "truncated in the middle": "bake or copy it again",
    "truncated to nothing": "bake or copy it again",
    "not there": "found nothing; look for its new place",
}


@pytest.mark.parametrize("kind", REMEDIES)
def test_bad_input_raises_with_a_remedy_and_changes_nothing(saved, bad, kind):
    path = bad(kind)
    with refused(saved, f"{path.name}.*{REMEDIES[kind]}"):
        saved.ops.r5dgs.load_scene(filepath=str(path))


WITHOUT_A_SCENE = {
    "Load an R5DGS scene first": (
        "add_alias", "add_crop_box", "allow_scene_file", "assign_gaussians", "delete_gaussians", "exact_mode",
        "explain_warning", "export_format", "export_masks", "export_ply", "export_scene", "extrapolate_until",
        "fit_timeline", "isolate", "merge_with_meshes", "predict_contacts", "preview", "remove_alias",
        "rename_object", "retime", "select_by_prompt", "select_floaters", "select_gaussians", "select_object",
        "set_display", "show_captured_images", "show_confidence", "switch_contacts", "use_captured_camera",
        "view_as_trained", "viewport_render",
    ),
    "Select an object of an R5DGS scene first": (
        "delete_object", "duplicate_object", "hand_over", "pivot_to_cursor", "re_extrapolate", "reset_motion",
        "simplify_keys",
    ),
    "Select an object of a loaded scene first": ("recolor",),
    "Select a tinted object first": ("reset_color",),
    "Select the objects to change": ("replace_motion",),
    "Hand objects over to rigid bodies first": ("bake_back",),
    "Nothing is isolated": ("unisolate",),
    "Live preview needs a window": ("live_preview",),
    "Merge with meshes by Cycles first": ("add_shadows",),
    "Nothing is merged with this scene": ("stop_merging",),
    "Use this in a 3D view": ("brush_gaussians", "lasso_gaussians"),
}  # fmt: skip
NEEDING_NONE = {
    "capture_dataset", "check_worker", "export_cameras", "load_scene", "open_manual", "show_colors_as_trained",
    "use_engine",
}  # fmt: skip


@pytest.mark.parametrize(
    ("asked", "name"), [(asked, name) for asked, names in WITHOUT_A_SCENE.items() for name in names]
)
def test_actions_without_a_scene_raise(blender, asked, name):
    with pytest.raises(RuntimeError, match=asked):
        getattr(blender.ops.r5dgs, name)()


def test_every_action_needs_a_scene_or_is_known_to_need_none(blender):
    needing = {name for names in WITHOUT_A_SCENE.values() for name in names}
    actions = {name for name in dir(blender.ops.r5dgs) if not name.startswith("_")}
    assert needing | NEEDING_NONE == actions, "WITHOUT_A_SCENE and NEEDING_NONE above must list all operators"


def test_loading_without_a_path_raises(blender):
    with pytest.raises(RuntimeError, match="choose a .r5dgs file"):
        blender.ops.r5dgs.load_scene()


def test_a_scene_with_only_a_background_loads_with_a_warning(blender, tmp_path, capfd):
    path = scene_file.write(scenes.make_scene(n=50, objects=0, unassigned=0), tmp_path / "still.r5dgs")
    collection = motions.load(blender, path)
    said = capfd.readouterr().out
    print(said)
    assert "Warning: still.r5dgs contains only a background, no objects; train with masks to get objects" in said
    motions.assert_plays_like_the_core(blender, collection, scene_file.read(path), (0.0, 0.5, 0.9))
    blender.ops.wm.save_as_mainfile(filepath=str(tmp_path / "still.blend"))
    blender.ops.wm.open_mainfile(filepath=str(tmp_path / "still.blend"))
    assert sum(collection.r5dgs.is_scene for collection in blender.data.collections) == 1


@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="rights to read are those of POSIX here")
@pytest.mark.parametrize("what", ["file", "folder"])
def test_an_unreadable_scene_file_raises(blender, scene_path, what):
    locked: Path = scene_path if what == "file" else scene_path.parent
    locked.chmod(0)
    is_root, before = os.geteuid() == 0, contents(blender)
    if is_root:
        os.seteuid(65534)  # root can read everything, so the file is read as the user nobody
    try:
        with pytest.raises(RuntimeError, match="cannot be read") as caught:
            blender.ops.r5dgs.load_scene(filepath=str(scene_path))
    finally:
        if is_root:
            os.seteuid(0)
        locked.chmod(0o755)
    assert "Traceback" not in str(caught.value) and contents(blender) == before


# --- a missing scene file ---


def test_a_scene_file_that_was_moved_away_is_missed_by_name_and_nothing_breaks(loaded, scene_path, tmp_path, capfd):
    pytest.importorskip("torch", reason="torch is not installed in this Python, which runs the worker here")
    away = tmp_path / "moved" / "elsewhere.r5dgs"
    away.parent.mkdir()
    scene_path.rename(away)
    actions = {
        "preview": loaded.ops.r5dgs.preview,
        "F12": lambda: f12(loaded),
        "masks": lambda: loaded.ops.r5dgs.export_masks(directory=str(tmp_path / "masks"), frames="CURRENT"),
        "scene": lambda: loaded.ops.r5dgs.export_scene(filepath=str(tmp_path / "out.r5dgs")),
    }
    for act in actions.values():
        with refused(loaded, f"{scene_path}: expected the scene.*found no file; choose.*'Scene File'"):
            act()
    assert not [path for path in tmp_path.rglob("*") if path.name in {"f12.png", "out.r5dgs"}]
    capfd.readouterr()
    assert loaded.ops.r5dgs.export_ply(filepath=str(tmp_path / "out.ply")) == {"FINISHED"}  # Blender has the points
    assert "Warning: Taken from the points in Blender, without shading" in capfd.readouterr().out
    collection = next(c for c in loaded.data.collections if c.r5dgs.is_scene)
    collection.r5dgs.filepath = str(away)
    assert loaded.ops.r5dgs.preview() == {"FINISHED"} and f12(loaded)


# --- worker failures ---


@pytest.fixture
def without_numba(monkeypatch, tmp_path):
    """Make this Python the worker's, as if numba were not installed."""
    path = tmp_path / "python"
    path.write_text(
        f"#!{sys.executable}\n"
        "import importlib.util, os, runpy, sys\n"
        "sys.path.insert(0, os.environ['PYTHONPATH'].split(os.pathsep)[0])\n"
        "find = importlib.util.find_spec\n"
        "importlib.util.find_spec = lambda name, *a: None if name == 'numba' else find(name, *a)\n"
        "runpy.run_module('r5dgs_core.worker.server', run_name='__main__')\n"
    )
    path.chmod(path.stat().st_mode | stat.S_IXUSR)

    def choose(on):
        monkeypatch.setenv("R5DGS_PYTHON", str(path)) if on else monkeypatch.delenv("R5DGS_PYTHON")

    choose(True)
    return choose


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="the script is one of POSIX")
def test_a_python_without_numba_is_named_with_the_remedy_and_the_next_choice_works(loaded, without_numba, tmp_path):
    pytest.importorskip("torch", reason="torch is not installed in this Python, which runs the worker here")
    loaded.context.scene.render.engine = "R5DGS"
    said = "worker: .*python lacks numba; install the core there.*pip install r5dgs.*'Worker Python'"
    for act in (
        loaded.ops.r5dgs.check_worker,
        lambda: f12(loaded),
        lambda: loaded.ops.r5dgs.export_masks(directory=str(tmp_path / "masks"), frames="CURRENT"),
    ):
        with refused(loaded, said):
            act()
    assert not Path(loaded.data.filepath).with_name("f12.png").exists()
    without_numba(False)
    assert loaded.ops.r5dgs.preview() == {"FINISHED"} and f12(loaded)


@pytest.fixture
def dying(loaded):
    """Kill the worker during a request."""
    worker = importlib.import_module("r5dgs.r5dgs_addon.worker.jobs")

    @contextlib.contextmanager
    def kill():
        running = worker.current()
        os.kill(running.pid, signal.SIGSTOP)  # so that the request waits
        killer = threading.Timer(0.5, os.kill, (running.pid, signal.SIGKILL))
        killer.start()
        yield
        killer.join()

    return kill


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(signal, "SIGSTOP"), reason="signals are those of POSIX")
def test_a_worker_killed_during_a_render_raises_and_the_next_render_works(loaded, dying):
    pytest.importorskip("torch", reason="torch is not installed in this Python, which runs the worker here")
    assert f12(loaded)
    for act in (lambda: f12(loaded), loaded.ops.r5dgs.preview):
        with (
            dying(),
            refused(loaded, r"worker: \S+ ended unexpectedly \(stopped from outside.*; the next request starts"),
        ):
            act()
        assert f12(loaded) and loaded.ops.r5dgs.preview() == {"FINISHED"}
