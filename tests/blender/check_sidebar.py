"""Measure the height of the sidebar in Blender's window, with panels closed and open.

    xvfb-run -a -s "-screen 0 1280x1000x24 +extension GLX" blender --factory-startup --window-geometry 0 0 1280 1000 \\
        --python tests/blender/check_sidebar.py -- SCENE.r5dgs OUT [PANEL]

Prints the height in pixels at a UI scale of 1 with a loaded scene: without a selection, with an object or a point cloud
active, and with several objects selected. With the panel PANEL open beside those that are open by default, it prints
the height for an active object only. Exits with 1 if, without PANEL, a screen of 1000 pixels is too small. Saves
pictures of the window in OUT.
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


def selections(collection: bpy.types.Collection) -> dict[str, list[bpy.types.Object]]:
    """Selections of a loaded scene by their names; the first object of each becomes active."""
    named = [one for one in collection.all_objects if one.r5dgs.object_id > 0]
    anchors, clouds = ([one for one in named if one.r5dgs.role == role] for role in ("ANCHOR", "CLOUD"))
    return {
        "no selection": [],
        "object": anchors[:1],
        "point cloud": clouds[:1],
        "several objects": anchors,
        "object past t_max": anchors[:1],
    }


def checks(path: Path, out: Path, opened: str) -> Iterator[float]:
    """Measure with a scene and several selections."""
    if opened:
        open_by_default(opened)
    with w.inside():
        bpy.ops.r5dgs.load_scene(filepath=str(path))
    collection = next(one for one in bpy.data.collections if one.r5dgs.is_scene)
    out.mkdir(parents=True, exist_ok=True)
    too_high = []
    for name, chosen in selections(collection).items():
        if opened and name != "object":
            continue
        for obj in bpy.context.view_layer.objects:
            obj.select_set(obj in chosen)
        bpy.context.view_layer.objects.active = chosen[0] if chosen else None
        if "t_max" in name:
            bpy.context.scene.frame_set(bpy.context.scene.frame_end)
        found, scrolls, room = yield from height()
        subprocess.run(["import", "-window", "root", str(out / f"{name}{' ' * bool(opened)}{opened}.png")], check=True)
        with_panel = f", {opened} open" if opened else ""
        print(f"{name}{with_panel}: {'' if scrolls else 'at most '}{found:.0f} of {room} px", flush=True)
        too_high += [name] if scrolls else []
    assert opened or not too_high, f"the sidebar does not fit a screen of {SCREEN} px: {', '.join(too_high)}"


if __name__ == "__main__":
    arguments = sys.argv[sys.argv.index("--") + 1 :]
    w.run(checks, Path(arguments[0]).resolve(), Path(arguments[1]), *(arguments[2:] or [""]))
