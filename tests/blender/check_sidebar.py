"""Measure the height of the sidebar in Blender's window, with panels closed and open.

    xvfb-run -a -s "-screen 0 1280x1000x24 +extension GLX" blender --factory-startup --window-geometry 0 0 1280 1000 \\
        --python tests/blender/check_sidebar.py -- SCENE.r5dgs OUT [PANEL]

Prints the height in pixels at a UI scale of 1 with a loaded scene and an active object, and with the panel PANEL open
beside those that are open by default. Exits with 1 if, without PANEL, a screen of 1000 pixels is too small. Saves a
picture of the window in OUT.
"""

import contextlib
import subprocess
import sys
from collections.abc import Generator, Iterator
from pathlib import Path

import bpy

sys.path.insert(0, str(Path(__file__).parent))
import window as w  # noqa: E402

TAB = "R5DGS"
SCREEN = 1000
PAGES = 60  # steps of scrolling, more than any sidebar needs


def height() -> Generator[float, None, tuple[float, bool, int]]:
    """Scroll the sidebar to its end and back. Returns its height, True if it scrolls, and the height of its region."""
    area = w.area_of("VIEW_3D")
    area.spaces.active.show_region_ui = True
    yield 0.7
    sidebar = w.region_of(area, "UI")
    sidebar.active_panel_category = TAB
    area.tag_redraw()
    yield 1.5
    top = sidebar.view2d.region_to_view(0, 0)[1]
    with bpy.context.temp_override(window=w.main_window(), area=area, region=sidebar):
        for _ in range(PAGES):
            with contextlib.suppress(RuntimeError):  # nothing to scroll
                bpy.ops.view2d.scroll_down(deltay=100)
        bottom = sidebar.view2d.region_to_view(0, 0)[1]
        for _ in range(PAGES):
            with contextlib.suppress(RuntimeError):
                bpy.ops.view2d.scroll_up(deltay=100)
    yield 0.5
    return sidebar.height + max(top - bottom, 0), bottom < top, sidebar.height


def open_by_default(label: str) -> None:
    """Open a panel in views that have not shown it."""
    (panel,) = [one for one in panels() if one.bl_label == label]
    children = [one for one in panels() if getattr(one, "bl_parent_id", "") == panel.bl_idname]
    for one in [*children, panel]:
        bpy.utils.unregister_class(one)
    panel.bl_options = set(panel.bl_options) - {"DEFAULT_CLOSED"}
    for one in [panel, *children]:
        bpy.utils.register_class(one)


def panels() -> list[type]:
    """Panels of the tab."""
    found = [one for module in w.service("panels").MODULES for one in module.CLASSES]
    return [one for one in found if getattr(one, "bl_region_type", "") == "UI"]


def checks(path: Path, out: Path, opened: str) -> Iterator[float]:
    """Measure with a scene and an active object."""
    if opened:
        open_by_default(opened)
    with w.inside():
        bpy.ops.r5dgs.load_scene(filepath=str(path))
    collection = next(one for one in bpy.data.collections if one.r5dgs.is_scene)
    anchor = next(one for one in collection.all_objects if one.r5dgs.role == "ANCHOR" and one.r5dgs.object_id > 0)
    anchor.select_set(True)
    bpy.context.view_layer.objects.active = anchor
    found, scrolls, room = yield from height()
    out.mkdir(parents=True, exist_ok=True)
    subprocess.run(["import", "-window", "root", str(out / f"sidebar {opened}.png")], check=True)
    print(f"sidebar{f' with {opened} open' if opened else ''}: {'' if scrolls else 'at most '}{found:.0f} of {room} px")
    assert opened or not scrolls, f"the sidebar does not fit the {room} px that a screen of {SCREEN} px leaves for it"


if __name__ == "__main__":
    arguments = sys.argv[sys.argv.index("--") + 1 :]
    w.run(checks, Path(arguments[0]).resolve(), Path(arguments[1]), *(arguments[2:] or [""]))
