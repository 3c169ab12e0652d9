"""Every format of the core's registry has a button in Blender, and is written with Blender's edits."""

import dataclasses
import importlib
import re
from types import SimpleNamespace

import numpy as np
import pytest

from r5dgs_core.cli.commands import export as export_command
from r5dgs_core.formats import ply, registry
from r5dgs_core.scene import scene_file
from tests.support import layouts, motions, pages, scenes

pytest.importorskip("bpy", reason="bpy is not installed; it comes with the extra 'test' on Python 3.11")

from mathutils import Matrix  # noqa: E402  (bpy brings it)


@pytest.fixture
def scene_path(tmp_path):
    made = scenes.make_scene(n=300, objects=3, sh_degree=2, seed=4, world_convention="colmap")
    return scene_file.write(made, tmp_path / "scene.r5dgs")


@pytest.fixture
def csv(monkeypatch):
    """Name of the format that the developer's page adds."""
    pages.load("Export format", "r5dgs_core.formats.csv_points", monkeypatch)
    monkeypatch.setitem(registry.MODULES, "csv", "csv_points")
    return "csv"


def cloud(collection, name):
    return next(o for o in motions.clouds(collection) if o.name == name)


def drawn(bpy):
    """Text of the panel."""
    return layouts.draw(bpy, importlib.import_module("r5dgs.r5dgs_addon.panels.export").R5DGS_PT_export)


def drawn_menu(bpy):
    """Text of the entries in File > Export."""
    said = []
    menu = layouts.Layout(bpy, said)
    importlib.import_module("r5dgs.operators")._menu_export(SimpleNamespace(layout=menu), bpy.context)
    return said


def tooltip(bpy, name):
    operator = importlib.import_module("r5dgs.operators.export_format").R5DGS_OT_export_format
    return operator.description(bpy.context, SimpleNamespace(format=name))


def rows(path):
    """Positions in a file of the page's format, sorted. [n, 3]"""
    return np.sort(np.loadtxt(path, delimiter=",", skiprows=1), axis=0)


def test_the_format_of_the_developers_page_appears_in_blender(blender, loaded, csv, tmp_path):
    assert "Centers (.csv)" in drawn(blender) and "R5DGS Centers (.csv)" in drawn_menu(blender)
    assert "Keeps: centres of the Gaussians. Not kept: everything else" in tooltip(blender, csv)
    blender.context.scene.frame_set(13)
    before = sorted(tmp_path.iterdir())
    with pytest.raises(RuntimeError, match="give it a name"):
        blender.ops.r5dgs.export_format(format=csv)
    assert sorted(tmp_path.iterdir()) == before
    assert blender.ops.r5dgs.export_format(format=csv, filepath=str(tmp_path / "a")) == {"FINISHED"}
    assert blender.context.scene.frame_current == 13
    time = 12 / loaded.r5dgs.frames_per_unit
    (wanted,) = export_command.run_export(tmp_path / "scene.r5dgs", csv, tmp_path / "b.csv", times=(time,))
    assert (tmp_path / "a.csv").read_bytes() == wanted.read_bytes()


@pytest.mark.parametrize(("name", "suffix"), [("poses", "json"), ("tum", "txt"), ("glb", "glb"), ("usd", "usd")])
def test_formats_with_motion_or_poses_are_written_and_losses_reported(blender, loaded, tmp_path, capfd, name, suffix):
    if (reason := registry.get(name).why_unavailable()) is not None:
        pytest.skip(reason)
    path = tmp_path / f"a.{suffix}"
    assert blender.ops.r5dgs.export_format(format=name, filepath=str(path), frames="RANGE") == {"FINISHED"}
    found = sorted(tmp_path.glob(f"a*.{suffix}"))
    assert len(found) == (3 if name == "tum" else 1) and all(one.stat().st_size for one in found)
    said = capfd.readouterr().out
    assert ("Warning: Lost in this format: identity encodings" in said) == (name in ("glb", "usd"))


def test_a_quantised_scene_is_written_and_loaded_but_never_over_a_loaded_scene(blender, loaded, tmp_path):
    with pytest.raises(RuntimeError, match="plays from this file"):
        blender.ops.r5dgs.export_format(format="r5dgs", filepath=str(tmp_path / "scene.r5dgs"))
    path = tmp_path / "small.r5dgs"
    assert blender.ops.r5dgs.export_format(format="r5dgs", filepath=str(path), frames="RANGE") == {"FINISHED"}
    assert scene_file.precision_of(path) == "quantised"
    assert blender.ops.r5dgs.load_scene(filepath=str(path)) == {"FINISHED"}
    clouds = [one for one in blender.data.objects if one.type == "POINTCLOUD" and one not in loaded.all_objects[:]]
    assert sum(len(one.data.points) for one in clouds) == len(scene_file.read(path).gaussians.means) == 300


def test_without_the_format_there_is_no_button(blender, loaded, tmp_path, monkeypatch):
    monkeypatch.delitem(registry.MODULES, "csv", raising=False)
    said = drawn(blender)
    assert "Centers (.csv)" not in said and {"Gaussians (.ply)", "Cameras (.json)"} <= set(said)
    with pytest.raises(TypeError, match="csv"):
        blender.ops.r5dgs.export_format(format="csv", filepath=str(tmp_path / "a.csv"))


def test_each_frame_of_the_range_is_a_file(blender, loaded, csv, tmp_path):
    view = blender.context.scene
    view.frame_start, view.frame_end = 40, 60
    options = {"format": csv, "frames": "RANGE", "frame_step": 10}
    assert blender.ops.r5dgs.export_format(filepath=str(tmp_path / "a.csv"), **options) == {"FINISHED"}
    for frame in (40, 50, 60):
        time = (frame - 1) / loaded.r5dgs.frames_per_unit
        (wanted,) = export_command.run_export(tmp_path / "scene.r5dgs", csv, tmp_path / f"b{frame}.csv", times=(time,))
        assert (tmp_path / f"a_{frame:04d}.csv").read_bytes() == wanted.read_bytes()
    assert sorted(path.name for path in tmp_path.glob("a*")) == ["a_0040.csv", "a_0050.csv", "a_0060.csv"]


def test_edits_are_exported_and_hidden_or_unselected_objects_are_not(blender, loaded, tmp_path):
    mug, car, apple = (cloud(loaded, name) for name in ("mug", "toy car", "red apple"))
    mug.matrix_local = Matrix.Translation((0.3, -0.2, 0.4)) @ mug.matrix_local @ Matrix.Scale(1.6, 4)
    mug.r5dgs_look.tint = (0.4, 1.3, 0.8)
    blender.context.view_layer.update()
    blender.context.scene.frame_set(46)
    assert blender.ops.r5dgs.export_scene(filepath=str(tmp_path / "edited.r5dgs"), exact=True) == {"FINISHED"}
    time = 45 / loaded.r5dgs.frames_per_unit
    wanted = ply.read(
        export_command.run_export(tmp_path / "edited.r5dgs", "ply", tmp_path / "wanted.ply", times=(time,))[0]
    )

    def export(name, **options):
        path = tmp_path / name
        assert blender.ops.r5dgs.export_format(filepath=str(path), format="ply", **options) == {"FINISHED"}
        return ply.read(path)

    def assert_same(found, objects):
        chosen = np.isin(wanted.object_ids, objects)
        for name in ("means", "log_scales", "sh", "object_ids"):
            np.testing.assert_array_equal(getattr(found, name), getattr(wanted, name)[chosen], err_msg=name)

    everything = np.unique(wanted.object_ids)
    assert_same(export("all.ply"), everything)
    car.hide_set(True)
    assert_same(export("visible.ply"), everything[everything != car.r5dgs.object_id])
    motions.choose(blender, mug, apple)
    assert_same(export("selected.ply", which="SELECTED"), [mug.r5dgs.object_id, apple.r5dgs.object_id])


def test_without_a_visible_object_nothing_is_written(blender, loaded, csv, tmp_path):
    for obj in motions.clouds(loaded):
        obj.hide_set(True)
    with pytest.raises(RuntimeError, match="expected a visible object"):
        blender.ops.r5dgs.export_format(format=csv, filepath=str(tmp_path / "a.csv"))
    assert not (tmp_path / "a.csv").exists()


def test_a_format_whose_package_is_missing_is_disabled_with_the_reason(blender, loaded, csv, tmp_path, monkeypatch):
    module = importlib.import_module("r5dgs_core.formats.csv_points")
    lacking = dataclasses.replace(module.FORMAT, extra="tables", packages=("numpy", "no_such_package"))
    monkeypatch.setattr(module, "FORMAT", lacking)
    enabled = []
    collected = property(fset=lambda row, value: enabled.append(value))
    monkeypatch.setattr(layouts.Layout, "enabled", collected, raising=False)
    jobs = importlib.import_module("r5dgs.r5dgs_addon.worker.jobs")
    monkeypatch.setattr(jobs, "formats", lambda: frozenset({"ply"}))  # a worker with no further package
    usable = [registry.get(name).why_unavailable() is None for name in registry.MODULES]
    assert "Centers (.csv)" in drawn(blender) and enabled == usable and not usable[-1] and any(usable)
    reason = "no_such_package is not installed; remedy: pip install 'r5dgs[tables]', in the Python of the worker"
    assert reason in tooltip(blender, csv)
    with pytest.raises(RuntimeError) as refused:
        blender.ops.r5dgs.export_format(format=csv, filepath=str(tmp_path / "a.csv"))
    assert reason in str(refused.value) and not (tmp_path / "a.csv").exists()


def test_a_format_whose_package_only_the_worker_has_is_written_there(blender, loaded, tmp_path, monkeypatch, capfd):
    options = {"format": "poses", "frames": "RANGE"}
    assert blender.ops.r5dgs.export_format(filepath=str(tmp_path / "own.json"), **options) == {"FINISHED"}
    module = importlib.import_module("r5dgs_core.formats.poses")
    lacking = dataclasses.replace(
        module.FORMAT, losses=lambda scene, options: ["a hue"], extra="tables", packages=("no_such_package",)
    )
    monkeypatch.setattr(module, "FORMAT", lacking)  # the worker is another process
    jobs = importlib.import_module("r5dgs.r5dgs_addon.worker.jobs")
    jobs.stop()
    assert jobs.formats() is None and "Keeps: " in tooltip(blender, "poses")
    assert blender.ops.r5dgs.export_format(filepath=str(tmp_path / "a.json"), **options) == {"FINISHED"}
    written, own = ((tmp_path / name).read_text() for name in ("a.json", "own.json"))
    number = r"-?\d+\.?\d*(?:e-?\d+)?"  # the worker's numpy may round otherwise
    assert re.sub(number, "0", written) == re.sub(number, "0", own)
    found, expected = (np.array(re.findall(number, text), float) for text in (written, own))
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)
    assert "poses" in jobs.formats() and "Keeps: " in tooltip(blender, "poses")
    assert "Warning: Lost in this format: a hue" in capfd.readouterr().out
    with pytest.raises(RuntimeError, match="cannot be written"):
        blender.ops.r5dgs.export_format(filepath=str(tmp_path / "missing" / "a.json"), **options)
