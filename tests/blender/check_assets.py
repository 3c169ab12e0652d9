"""Check scenes that are dragged from the Asset Browser into a 3D view with the mouse.

    xvfb-run -a -s "-screen 0 1280x800x24 +extension GLX" blender --factory-startup --window-geometry 0 0 1280 800 \\
        --python tests/blender/check_assets.py -- SCENE.r5dgs [PICTURES]

Needs ``xdotool`` and ImageMagick. The scene is marked as an asset and dragged from its own file, then linked and
appended into others. Its splats must look like those of the loaded scene. Screenshots are saved in the folder
PICTURES. Exits with 1 if a drag fails.
"""

import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import bpy
import numpy as np
from mathutils import Euler

sys.path.insert(0, str(Path(__file__).parent))
import window as w  # noqa: E402
from check_splats import MIN_DB, psnr, redraw, screenshot, shown_region  # noqa: E402

LIBRARY = "R5DGS assets"
METHODS = ("LINK", "APPEND")
TILE = (48, 60)  # inside the first asset, from the upper left corner


def loaded() -> list[bpy.types.Collection]:
    """Collections of loaded scenes."""
    return [one for one in bpy.data.collections if one.r5dgs.is_scene]


def look(scene_size: float) -> None:
    """Look at the scene without overlays."""
    space = w.area_of("VIEW_3D").spaces.active
    space.overlay.show_overlays, space.show_gizmo, space.show_region_hud = False, False, False
    view = space.region_3d
    view.view_perspective, view.view_rotation = "PERSP", Euler((1.1, 0, 0.6)).to_quaternion()
    view.view_location, view.view_distance = (0, 0, 0), scene_size
    space.lens, space.clip_start, space.clip_end = 50, 0.01, 1000


def picture(path: Path) -> np.ndarray:
    """Pixels of the 3D view."""
    redraw()
    return shown_region(screenshot(path))[0]


def open_browser(library: str, method: str = "FOLLOW_PREFS") -> Iterator[float]:
    """Turn the editor of properties into an Asset Browser that shows a library."""
    area = w.area_of("PROPERTIES")
    area.ui_type = "ASSETS"
    yield 1.0
    space = area.spaces.active
    space.show_region_toolbar = space.show_region_tool_props = False
    space.params.asset_library_reference, space.params.import_method = library, method
    yield 2.0


def drag_asset() -> Iterator[float]:
    """Drag the first asset into the middle of the 3D view."""
    tiles, view = w.region_of(w.area_of("FILE_BROWSER")), w.region_of(w.area_of("VIEW_3D"))
    x, y = TILE[0], tiles.height - TILE[1]
    within = [(tiles, (x + step, y - step)) for step in (0, 6, 12, 18)]  # a drag starts inside the tile
    target = [(view, (view.width / 2, view.height / 2 + step)) for step in (9, 0)]
    yield from w.drag_across(*within, *target)
    yield 1.5


def checks(path: Path, out: Path) -> Iterator[float]:
    """Load and mark the scene, then drag it into three files."""
    out.mkdir(parents=True, exist_ok=True)
    bpy.data.batch_remove(list(bpy.data.objects))
    with w.inside():
        bpy.ops.r5dgs.load_scene(filepath=str(path))
    (collection,) = loaded()
    size = w.area_of("VIEW_3D").spaces.active.region_3d.view_distance
    frame = bpy.context.scene.frame_current
    look(size)
    yield 1.0
    wanted = picture(out / "loaded.png")
    assert wanted.std() > 0.02, "nothing is visible"
    collection.asset_mark()
    with tempfile.TemporaryDirectory(prefix="r5dgs-assets-") as folder:
        blend = Path(folder) / "library.blend"
        bpy.ops.wm.save_as_mainfile(filepath=str(blend))
        yield from open_browser("LOCAL")
        bpy.context.view_layer.layer_collection.children[collection.name].exclude = True
        yield from drag_asset()
        yield from compare("own file", out / "own.png", wanted, size, frame)
        for method in METHODS:
            bpy.ops.wm.read_homefile(app_template="")
            yield 1.0
            bpy.context.preferences.filepaths.asset_libraries.new(name=LIBRARY, directory=folder)
            bpy.data.batch_remove(list(bpy.data.objects))
            look(size)
            yield from open_browser(LIBRARY, method)
            yield from drag_asset()
            assert loaded()[0].library is not None or method != "LINK", "the scene is not linked"
            yield from compare(method.lower(), out / f"{method.lower()}.png", wanted, size, frame)


def compare(what: str, path: Path, wanted: np.ndarray, size: float, frame: int) -> Iterator[float]:
    """Check that the drop is visible; move its empty to the origin, where the loaded scene is, and compare pictures."""
    yield 3.0
    assert shown_region(screenshot(path.with_stem(f"{path.stem}_dropped")))[0].std() > 0.02, "nothing is visible"
    empties = [one for one in bpy.context.scene.objects if one.instance_type == "COLLECTION"]
    print(f"{what}: {len(empties)} empties, {len(loaded())} scenes", flush=True)
    assert len(empties) == 1 and len(loaded()) == 1, "the drag made no instance"
    empties[0].location = (0, 0, 0)
    empties[0].select_set(False)
    bpy.context.scene.frame_set(frame)
    look(size)
    yield 1.0
    value = psnr(picture(path), wanted)
    print(f"{what}: {value:.1f} dB against the loaded scene", flush=True)
    assert value > MIN_DB


if __name__ == "__main__":
    arguments = sys.argv[sys.argv.index("--") + 1 :]
    w.run(checks, Path(arguments[0]).resolve(), Path(arguments[1] if arguments[1:] else tempfile.mkdtemp()))
