"""A path in a .blend is read automatically only beside or below that .blend; other paths must be allowed."""

import dataclasses
import importlib
import os
import shutil
from pathlib import Path

import pytest

from r5dgs_core import errors
from r5dgs_core.scene import scene_file
from tests.support import layouts, motions, tiny_datasets

ASKS = "not read, because it is outside the folder of the .blend"


@pytest.fixture
def trust(blender, monkeypatch):
    """The module without permissions of other tests, and the environment of a plain session."""
    module = motions.addon("scene.trust")
    monkeypatch.setattr(module, "_allowed", set())
    monkeypatch.delenv(module.ENVIRONMENT, raising=False)
    return module


@pytest.fixture
def scene_path(tmp_path):
    folder = tmp_path / "elsewhere"
    folder.mkdir()
    return scene_file.write(tiny_datasets.breathing(tiny_datasets.make_truth(), 0.3), folder / "bending.r5dgs")


@pytest.fixture
def blend(blender, trust, scene_path, tmp_path):
    """A .blend with Exact Mode on whose scene file is in another folder, opened in a new session."""
    motions.load_again(blender, scene_path)
    blender.ops.r5dgs.exact_mode(action="ON")
    path = tmp_path / "project" / "work.blend"
    path.parent.mkdir()
    blender.ops.wm.save_as_mainfile(filepath=str(path))
    blender.ops.wm.read_homefile(app_template="")
    new_session(trust)
    return path


def new_session(trust):
    """Clear the permissions of the user and the cached files."""
    trust._allowed.clear()
    motions.addon("motion.exact_mode")._files.clear()


@pytest.fixture
def reads(monkeypatch):
    """Files that were read since."""
    found = []
    read = scene_file.read
    monkeypatch.setattr(scene_file, "read", lambda path: found.append(Path(path)) or read(path))
    return found


def opened(bpy, path):
    bpy.ops.wm.open_mainfile(filepath=str(path))
    return next(c for c in bpy.data.collections if c.r5dgs.is_scene)


def scene_panel(bpy):
    return layouts.draw(bpy, bpy.types.R5DGS_PT_scene)


def test_opening_a_blend_reads_no_file_from_elsewhere_until_the_user_allows_it(blender, blend, scene_path, reads):
    collection = opened(blender, blend)
    for frame in range(1, 6):
        blender.context.scene.frame_set(frame)
    assert reads == [] and ASKS in collection.r5dgs_exact.problem and str(scene_path) in collection.r5dgs_exact.problem
    said = scene_panel(blender)
    assert f"Not read, outside this .blend's folder:{scene_path}" in "".join(said).replace(": ", ":")
    assert "r5dgs.allow_scene_file" in said
    with pytest.raises(errors.SceneFileError, match=ASKS):
        motions.addon("engine.render_request").scene_path(collection)
    assert blender.ops.r5dgs.allow_scene_file() == {"FINISHED"}
    assert [path.resolve() for path in reads] == [scene_path] and collection.r5dgs_exact.problem == ""
    assert "r5dgs.allow_scene_file" not in scene_panel(blender)
    collection = opened(blender, blend)  # later in the same session
    assert collection.r5dgs_exact.problem == ""


def test_data_stored_in_a_blend_file_grants_no_trust(blender, blend, scene_path, trust, reads):
    collection = opened(blender, blend)
    blender.ops.wm.save_mainfile()
    blender.ops.wm.save_as_mainfile(filepath=str(blend.with_name("copy.blend")), copy=True)
    assert trust.find(collection).asked == scene_path
    new = blend.parent / "below" / "moved.blend"
    new.parent.mkdir()
    blender.ops.wm.save_as_mainfile(filepath=str(new))
    assert trust.find(collection).asked == scene_path and reads == []


@pytest.mark.parametrize("place", ["beside", "below"])
def test_a_file_beside_or_below_the_blend_is_read_by_itself(blender, blend, scene_path, trust, place, tmp_path):
    target = tmp_path / ("elsewhere" if place == "beside" else "") / "work.blend"
    opened(blender, blend)
    blender.ops.wm.save_as_mainfile(filepath=str(target))
    blender.ops.wm.read_homefile(app_template="")
    new_session(trust)
    collection = opened(blender, target)
    assert collection.r5dgs_exact.problem == "" and trust.find(collection).path.resolve() == scene_path


def test_links_and_dots_do_not_lead_out_of_the_folder(trust, tmp_path):
    home, other = tmp_path / "home", tmp_path / "other"
    (home / "sub").mkdir(parents=True)
    other.mkdir()
    (other / "scene.r5dgs").write_bytes(b"")
    (home / "scene.r5dgs").write_bytes(b"")
    os.symlink(other, home / "link")
    os.symlink(other / "scene.r5dgs", home / "linked.r5dgs")
    os.symlink(home, tmp_path / "home-link")
    allowed = ("scene.r5dgs", "sub/../scene.r5dgs", "../home/scene.r5dgs", "../home-link/scene.r5dgs")
    refused = ("link/scene.r5dgs", "linked.r5dgs", "../other/scene.r5dgs", "sub/../../other/scene.r5dgs", "../home2/a")
    for folder in (home, tmp_path / "home-link"):
        assert [name for name in allowed if not trust.may_read(home / name, [str(folder)])] == []
        assert [name for name in refused if trust.may_read(home / name, [str(folder)])] == []
    assert not trust.may_read(home / "scene.r5dgs", [])


def test_a_path_of_the_network_is_not_touched_before_it_is_allowed(trust, monkeypatch, tmp_path):
    for path in (r"\\server\share\a.r5dgs", "//server/share/a.r5dgs", r"\\?\UNC\server\a.r5dgs"):
        assert trust.on_network(path, windows=True) and not trust.on_network(path, windows=False)
    assert not trust.on_network(r"C:\scenes\a.r5dgs", windows=True)
    monkeypatch.setattr(trust, "on_network", lambda place: True)
    touched = []
    monkeypatch.setattr(os.path, "realpath", lambda path: touched.append(path) or str(path))
    assert not trust.may_read(tmp_path / "elsewhere" / "a.r5dgs", [str(tmp_path / "project")]) and not touched
    assert trust.may_read(tmp_path / "project" / "a.r5dgs", [str(tmp_path / "project")]) and touched


def test_an_unsaved_blend_reads_only_what_was_loaded_in_this_session(blender, trust, scene_path):
    collection = motions.load(blender, scene_path)
    assert trust.find(collection).path == scene_path
    new_session(trust)
    assert trust.find(collection).asked == scene_path


def test_a_file_that_the_user_chooses_in_the_panel_is_allowed(blender, blend, trust, scene_path, tmp_path):
    collection = opened(blender, blend)
    chosen = tmp_path / "chosen.r5dgs"
    shutil.copy(scene_path, chosen)
    collection.r5dgs.filepath = str(chosen)
    assert trust.find(collection).path == chosen


def test_files_in_trusted_folders_are_read_without_confirmation(blender, blend, trust, scene_path, monkeypatch):
    collection = opened(blender, blend)
    assert trust.find(collection).path is None
    monkeypatch.setenv(trust.ENVIRONMENT, os.pathsep.join(("/nowhere", str(scene_path.parent))))
    assert trust.find(collection).path.resolve() == scene_path
    monkeypatch.delenv(trust.ENVIRONMENT)
    preferences = motions.addon("preferences")
    kept = dataclasses.make_dataclass("Kept", ["trusted_folders"])("")
    monkeypatch.setattr(preferences, "get", lambda: kept)
    preferences.trust(str(scene_path.parent))
    assert kept.trusted_folders == str(scene_path.parent)
    assert preferences._trusted(kept) == (str(scene_path.parent),)


def test_a_linked_scene_may_read_only_beside_its_library(blender, blend, trust, scene_path, tmp_path):
    opened(blender, blend)
    library = scene_path.parent / "library.blend"
    blender.ops.wm.save_as_mainfile(filepath=str(library))
    blender.ops.wm.read_homefile(app_template="", use_empty=True)
    blender.ops.wm.save_as_mainfile(filepath=str(tmp_path / "project" / "linking.blend"))
    with blender.data.libraries.load(str(library), link=True) as (source, target):
        target.collections = [name for name in source.collections if name.startswith("R5DGS")]
    (collection,) = target.collections
    new_session(trust)
    assert trust.find(collection).path.resolve() == scene_path
    with blender.data.libraries.load(str(library), link=False) as (source, target):
        target.collections = [name for name in source.collections if name.startswith("R5DGS")]
    assert trust.find(target.collections[0]).asked == scene_path


def test_an_override_of_a_missing_library_reads_nothing_beside_it(blender, blend, trust, scene_path, tmp_path):
    opened(blender, blend)
    library, folder = scene_path.parent / "library.blend", tmp_path / "project"
    blender.ops.wm.save_as_mainfile(filepath=str(library))
    blender.ops.wm.read_homefile(app_template="")
    with blender.data.libraries.load(str(library), link=True) as (source, target):
        target.collections = [name for name in source.collections if name.startswith("R5DGS")]
    own = target.collections[0].override_hierarchy_create(blender.context.scene, blender.context.view_layer)
    new_session(trust)
    assert trust.find(own).path.resolve() == scene_path
    blender.ops.wm.save_as_mainfile(filepath=str(folder / "overriding.blend"))
    library.unlink()
    blender.ops.wm.open_mainfile(filepath=str(folder / "overriding.blend"))
    own = next(one for one in blender.data.collections if one.r5dgs.is_scene)
    assert own.override_library is not None
    assert trust.find(own) == trust.SceneFileSearch(asked=scene_path)


def test_a_file_that_cannot_be_read_is_read_once_until_it_changes(blender, blend, trust, scene_path, reads, caplog):
    trust.allow(scene_path)
    whole = scene_path.read_bytes()
    scene_path.write_bytes(whole[:1000])
    collection = opened(blender, blend)
    for frame in range(1, 6):
        blender.context.scene.frame_set(frame)
    assert len(reads) == 1 and "bending.r5dgs" in collection.r5dgs_exact.problem
    assert caplog.text.count("Exact Mode") == 1  # for `blender -b`, which has no panel
    with pytest.raises(RuntimeError, match="bending.r5dgs"):
        blender.ops.r5dgs.exact_mode(action="ON")  # a click tries again
    assert len(reads) == 2
    scene_path.write_bytes(whole)
    blender.context.scene.frame_set(7)
    assert len(reads) == 3 and collection.r5dgs_exact.problem == ""


def test_the_cache_reads_a_file_again_only_after_a_change(blender, tmp_path):
    remembered = importlib.import_module("r5dgs.r5dgs_addon.scene.file_cache")
    calls = []
    files = remembered.Remembered(lambda path: calls.append(path) or len(path.read_bytes()))
    path = tmp_path / "file"
    with pytest.raises(errors.SceneFileError, match="cannot be read"):
        files.get(path)
    path.write_bytes(b"abc")
    assert files.get(path) == files.get(path) == 3 and len(calls) == 1
    path.write_bytes(b"abcd")
    assert files.get(path) == 4 and len(calls) == 2
