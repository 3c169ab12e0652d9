"""The sidebar, menus and drag and drop are there, and name only operators and properties that exist."""

import contextlib
import importlib
import os
import re
from types import SimpleNamespace

import numpy as np
import pytest

from r5dgs_core.formats import registry
from r5dgs_core.scene import scene_file
from tests.support import layouts, motions, scenes


@pytest.fixture
def sidebar(blender):
    panels = importlib.import_module("r5dgs.r5dgs_addon.panels")

    def draw():
        return layouts.draw(blender, *(panel for module in panels.MODULES for panel in module.CLASSES))

    return draw


@pytest.fixture
def scene_path(tmp_path):
    return scene_file.write(scenes.make_scene(n=200), tmp_path / "scene.r5dgs")


def test_without_a_scene_the_sidebar_offers_to_load_one(sidebar):
    said = sidebar()
    assert "r5dgs.load_scene" in said and "No scene loaded" in said and "r5dgs.capture_dataset" in said
    assert "r5dgs.preview" not in said


def test_the_sidebar_shows_the_loaded_scene_and_marks_extrapolated_times(blender, sidebar, scene_path):
    blender.ops.r5dgs.load_scene(filepath=str(scene_path))
    blender.context.scene.frame_set(31)
    said = sidebar()
    assert "synthetic: 3 objects, 200 Gaussians" in said and "t = 0.500: observed" in said
    assert "r5dgs.preview" in said and said.count("r5dgs.select_by_prompt") == 3
    blender.context.scene.frame_set(55)
    assert "t = 0.900: extrapolated by 0.150" in sidebar()


def test_the_sidebar_shows_matches_or_their_absence(blender, sidebar, scene_path):
    blender.ops.r5dgs.load_scene(filepath=str(scene_path))
    blender.ops.r5dgs.select_by_prompt(text="cup")
    assert {"mug", "0.97  alias 'cup'"} <= set(sidebar())
    blender.ops.r5dgs.select_by_prompt(text="submarine")
    assert "Nothing matches 'submarine'" in sidebar()


def test_the_sidebar_shows_kernel_compilation(blender, sidebar, scene_path, monkeypatch):
    worker = importlib.import_module("r5dgs.r5dgs_addon.worker.jobs")
    blender.ops.r5dgs.load_scene(filepath=str(scene_path))
    before = sidebar()
    process = importlib.import_module("r5dgs.r5dgs_addon.worker.process")
    monkeypatch.setattr(worker, "notice", lambda: process.COMPILING)
    new = [text for text in sidebar() if text not in before]
    assert " ".join(new) == "Preparing the rasterizer (first use, 10 to 30 s)"


def test_texts_fit_a_sidebar_of_normal_width(blender, sidebar, scene_path, monkeypatch):
    blender.ops.r5dgs.load_scene(filepath=str(scene_path))
    windows, points, worker, live, notes = (
        importlib.import_module(f"r5dgs.r5dgs_addon.{name}")
        for name in (
            *("ui.status_bar", "scene.evaluated_points", "worker.jobs"),
            *("engine.live_preview", "engine.render_notes"),
        )
    )
    monkeypatch.setattr(windows, "_WIDTH", 280)
    long = "mug: the radius of points is for display only; change the attribute 'scale' instead"
    monkeypatch.setattr(points, "notes", lambda collection: [long])
    monkeypatch.setattr(notes, "of", lambda scene: [long])
    monkeypatch.setattr(worker, "notice", lambda: long)
    monkeypatch.setattr(live, "message", lambda: long)
    blender.context.scene.render.engine = "R5DGS"
    blender.context.scene.view_settings.view_transform = "False Color"
    figures = blender.context.window_manager.r5dgs_figures
    figures.size, figures.unbent = "1920 x 1080", 1234
    with contextlib.suppress(RuntimeError):  # the error that the sidebar repeats
        blender.ops.r5dgs.select_by_prompt(text="not the unicorn that lives in the forest")
    said = sidebar()
    words = " ".join(said)
    assert words.count("change the attribute") == 5 and "False Color" in words
    assert "1920 x 1080" in words and "are shown rigid" in words and "lives in the forest" in words
    assert [text for text in said if len(text) > 40] == []


def test_import_menu_export_menu_and_drag_and_drop_lead_to_the_operators(blender, extension):
    own = motions.addon("panels.export").FORMATS
    exports = [own[name][0] if name in own else "r5dgs.export_format" for name in registry.MODULES]
    exports += [f"r5dgs.{name}" for name in ("export_scene", "export_masks", "capture_dataset")]
    for menu, operators in (("import", ["r5dgs.load_scene"]), ("export", exports)):
        functions = getattr(blender.types, f"TOPBAR_MT_file_{menu}").draw._draw_funcs
        ours = [function for function in functions if function.__module__.startswith("r5dgs.")]
        said = []
        for function in ours:
            function(SimpleNamespace(layout=layouts.Layout(blender, said)), blender.context)
        assert [text for text in said if text.startswith("r5dgs.")] == operators
    handler = blender.types.R5DGS_FH_scene
    assert (handler.bl_import_operator, handler.bl_file_extensions) == ("r5dgs.load_scene", ".r5dgs")
    extension.unregister()
    try:
        functions = blender.types.TOPBAR_MT_file_import.draw._draw_funcs
        assert not [function for function in functions if function.__module__.startswith("r5dgs.")]
    finally:
        extension.register()


def test_cycles_shows_points_in_the_colours_of_the_file(blender, tmp_path):
    srgb = np.array([0.8, 0.35, 0.1])
    scene = scenes.make_scene(n=3000, objects=2, shading=False)
    sh = np.tile(((srgb - 0.5) / 0.28209479177387814).astype(np.float32), (len(scene.gaussians.means), 1, 1))
    path = scene_file.write(scene.with_arrays(sh=sh), tmp_path / "one_colour.r5dgs")
    blender.ops.wm.read_homefile(app_template="", use_empty=True)
    blender.ops.r5dgs.load_scene(filepath=str(path))
    bl_scene = blender.context.scene
    camera = blender.data.objects.new("camera", blender.data.cameras.new("camera"))
    camera.location = (0, 0, 8)
    bl_scene.collection.objects.link(camera)
    bl_scene.camera = camera
    bl_scene.render.engine = "CYCLES"
    bl_scene.cycles.samples, bl_scene.cycles.use_denoising = 4, False
    bl_scene.render.film_transparent = True
    bl_scene.render.resolution_x = bl_scene.render.resolution_y = 32
    bl_scene.render.resolution_percentage = 100
    bl_scene.view_settings.view_transform = "Standard"
    bl_scene.render.filepath = str(tmp_path / "render.png")
    silenced, nowhere = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)  # Cycles prints its progress past Python
    try:
        blender.ops.render.render(write_still=True)
    finally:
        os.dup2(silenced, 1)
        os.close(silenced)
        os.close(nowhere)
    images = importlib.import_module("r5dgs_core.data.images")
    rgba = images.read(tmp_path / "render.png")
    covered = rgba[..., 3] == 1
    assert covered.sum() > 10
    np.testing.assert_allclose(rgba[covered][:, :3], np.broadcast_to(srgb, (covered.sum(), 3)), atol=0.01)


def _texts(rna):
    """Labels and tooltips of a type, its properties and their items, with their location."""
    yield rna.identifier, rna.name
    yield rna.identifier, rna.description
    for item in rna.properties:
        if item.identifier not in ("rna_type", "bl_idname", "bl_rna"):
            entries = getattr(item, "enum_items_static", ())
            for part in (item, *entries):
                yield f"{rna.identifier}.{item.identifier}", part.name
                yield f"{rna.identifier}.{item.identifier}", part.description


def test_labels_and_tooltips_follow_blenders_style(blender):
    groups = (blender.types.PropertyGroup, blender.types.AddonPreferences)
    rnas = [cls.bl_rna for base in groups for cls in base.__subclasses__() if cls.__module__.startswith("r5dgs.")]
    rnas += [getattr(blender.ops.r5dgs, name).get_rna_type() for name in dir(blender.ops.r5dgs)]
    wrong = re.compile("\\n|  |[a-z]\\.$|colour|centre|grey", re.IGNORECASE)
    texts = [found for rna in rnas for found in _texts(rna)]
    assert len(texts) > 300 and [found for found in texts if wrong.search(found[1])] == []


def test_visible_properties_of_operators_and_their_items_have_tooltips(blender):
    missing = []
    for name in dir(blender.ops.r5dgs):
        rna = getattr(blender.ops.r5dgs, name).get_rna_type()
        for item in rna.properties:
            if item.identifier not in ("rna_type", "bl_idname") and not item.is_hidden:
                parts = (item, *getattr(item, "enum_items_static", ()))
                missing += [f"{name}.{item.identifier}" for part in parts if not part.description]
    assert missing == []


def test_angles_and_lengths_of_a_capture_have_units(blender):
    properties = blender.ops.r5dgs.capture_dataset.get_rna_type().properties
    units = {p.identifier: p.unit for p in properties if p.identifier.startswith("rig_") and p.type == "FLOAT"}
    angles = ("rig_elevation", "rig_elevation_spread", "rig_azimuth", "rig_arc", "rig_fov")
    assert units == {"rig_radius": "LENGTH", **dict.fromkeys(angles, "ROTATION")}


def test_every_panel_and_operator_links_to_a_page_of_the_manual(blender, extension, monkeypatch):
    manual = motions.addon("ui.manual")
    named = [name for names in manual.PAGES.values() for name in names]
    assert len(named) == len(set(named)) and set(named) <= set(dir(blender.ops.r5dgs))
    assert all((manual.FOLDER / f"{page}.md").is_file() for page in manual.PAGES)
    panels = [panel for module in motions.addon("panels").MODULES for panel in module.CLASSES]
    top = [one for one in panels if getattr(one, "bl_region_type", "") == "UI" and not hasattr(one, "bl_parent_id")]
    said, linked = [], [one for one in panels if getattr(one, "manual", "")]
    for panel in linked:
        assert panel.manual in manual.PAGES
        panel.draw_header_preset(SimpleNamespace(layout=layouts.Layout(blender, said), manual=panel.manual), None)
    assert said == ["r5dgs.open_manual"] * len(linked) and set(top) <= set(linked)
    opened = []
    monkeypatch.setattr("webbrowser.open", opened.append)
    assert blender.ops.r5dgs.open_manual(page="motion") == {"FINISHED"}
    for button, page in (
        ("r5dgs.add_shadows", "rendering"),
        ("r5dgs.load_scene", "blender"),
        ("R5DGS_PG_clean_up.opacity", "clean_up"),
    ):
        assert blender.ops.wm.doc_view_manual(doc_id=button) == {"FINISHED"}
        assert opened.pop() == manual.address(page)
    assert opened == [manual.address("motion")] and opened[0].startswith("file://")
    extension.unregister()
    try:
        assert manual.links not in blender.utils._manual_map
    finally:
        extension.register()


def test_each_operator_has_a_file_of_its_own(extension):
    operators = importlib.import_module("r5dgs.operators")
    for module in operators.modules():
        idnames = [cls.bl_idname for cls in module.CLASSES if cls.bl_idname.startswith("r5dgs.")]
        assert idnames == [f"r5dgs.{module.__name__.rpartition('.')[2]}"]


def test_panels_are_in_the_order_of_tasks_and_only_the_first_ones_are_open(extension):
    panels = importlib.import_module("r5dgs.r5dgs_addon.panels")
    classes = [panel for module in panels.MODULES for panel in module.CLASSES if hasattr(panel, "bl_label")]
    sidebar = [one for one in classes if getattr(one, "bl_region_type", "") == "UI"]
    assert [one.bl_label for one in sidebar if not hasattr(one, "bl_parent_id")] == [
        *("Scene", "Objects", "Select by Prompt", "Motion", "Clean Up", "Preview", "Export", "Capture")
    ]
    closed = {one for one in sidebar if "DEFAULT_CLOSED" in getattr(one, "bl_options", ())}
    assert {one for one in sidebar if hasattr(one, "bl_parent_id")} <= closed
    assert [one.bl_label for one in sidebar if one not in closed] == ["Scene", "Objects", "Select by Prompt"]
