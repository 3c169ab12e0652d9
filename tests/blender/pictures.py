"""Take the pictures of docs/user/blender.md in a real Blender with a window.

    xvfb-run -a -s "-screen 0 1600x1400x24 +extension GLX" blender --factory-startup --window-geometry 0 0 1600 1400 \\
        --python tests/blender/pictures.py -- demo.r5dgs FOLDER [PICTURE ...]

Needs ImageMagick's ``import`` (Blender's own screenshots are black under software rendering) and a worker's Python
(`R5DGS_PYTHON`). Each picture is a function that sets up the window; the screenshot follows after Blender has drawn. A
function may be a generator of seconds to wait between its steps.
"""

import argparse
import importlib.util
import inspect
import shutil
import subprocess
import sys
import tempfile
import traceback
from pathlib import Path

import bpy
from mathutils import Vector

ROOT = Path(__file__).resolve().parents[2]
CROPS = {"nothing": "225x330+830+66"}  # of 1280 pixels of width, if only one panel is shown
SETTLE_S = 2.5  # until the window has been redrawn
SIDEBAR = "R5DGS"


def register_extension() -> None:
    """Register the extension of this repository if none is enabled."""
    if hasattr(bpy.types, "R5DGS_PT_scene"):
        return
    spec = importlib.util.spec_from_file_location("r5dgs", ROOT / "__init__.py", submodule_search_locations=[str(ROOT)])
    module = importlib.util.module_from_spec(spec)
    sys.modules["r5dgs"] = module
    spec.loader.exec_module(module)
    module.register()


class Window:
    """Areas of Blender's window, and context overrides for operators in them."""

    @property
    def window(self):
        return bpy.context.window_manager.windows[0]

    def area(self, kind: str):
        """The largest area of a kind."""
        areas = [area for area in self.window.screen.areas if area.type == kind]
        return max(areas, key=lambda area: area.width * area.height)

    def region(self, area, kind: str):
        return next(region for region in area.regions if region.type == kind)

    def inside(self, kind: str = "VIEW_3D"):
        """A context in the largest area of a kind."""
        area = self.area(kind)
        region = self.region(area, "WINDOW")
        return bpy.context.temp_override(window=self.window, screen=self.window.screen, area=area, region=region)

    def scrub(self, t: float) -> None:
        """Go to a scene time."""
        state = collection().r5dgs
        frame = state.frame_zero + t * state.frames_per_unit
        bpy.context.scene.frame_set(round(frame))


def collection():
    """The loaded scene."""
    return next(c for c in bpy.data.collections if c.r5dgs.is_scene)


def load(path: Path, window: Window) -> None:
    """Load a scene into an empty file, viewed through the captured camera that the operator activates."""
    for obj in list(bpy.data.objects):
        bpy.data.objects.remove(obj)
    bpy.ops.wm.save_as_mainfile(filepath=str(path.with_suffix(".blend")))  # the sidebar shows paths from here
    with window.inside():
        bpy.ops.r5dgs.load_scene(filepath=str(path))
    collection().r5dgs.filepath = f"//{path.name}"
    area = window.area("VIEW_3D")
    space = area.spaces.active
    space.show_region_ui = True
    space.overlay.show_relationship_lines = False
    space.shading.type = "MATERIAL"


def bounds() -> tuple[Vector, Vector]:
    """Box about the named objects, Blender's world."""
    import numpy as np

    points = []
    for obj in collection().all_objects:
        if obj.r5dgs.role == "CLOUD" and obj.r5dgs.object_id > 0:
            places = np.empty(3 * len(obj.data.points), np.float32)
            obj.data.attributes["position"].data.foreach_get("vector", places)
            matrix = np.array(obj.matrix_world)
            points.append(places.reshape(-1, 3) @ matrix[:3, :3].T + matrix[:3, 3])
    low, high = np.quantile(np.concatenate(points), [0.02, 0.98], axis=0)
    return Vector(low), Vector(high)


def loaded(window: Window):
    """The sidebar with a loaded scene, at an extrapolated frame."""
    window.scrub(0.9)


def prompt(window: Window):
    """Matches of a prompt, and their selection."""
    with window.inside():
        bpy.ops.r5dgs.select_by_prompt(text="globe and the vase")


def nothing(window: Window):
    """A prompt without matches, and its suggestions."""
    with window.inside():
        bpy.ops.r5dgs.select_by_prompt(text="glowb")


def physics(window: Window):
    """Physics panel of one object, and the predicted paths with their uncertainty."""
    window.area("VIEW_3D").spaces.active.shading.type = "SOLID"
    window.area("VIEW_3D").spaces.active.shading.color_type = "OBJECT"
    with window.inside():
        bpy.ops.object.select_all(action="DESELECT")
        bpy.ops.r5dgs.show_confidence(action="SHOW")
        bpy.ops.r5dgs.select_by_prompt(text="beach ball")
        bpy.ops.r5dgs.extrapolate_until(t_end=1.6)
    ball = bpy.data.objects["beach ball"]
    bpy.context.view_layer.objects.active = ball
    ball.select_set(True)


def ellipsoids(window: Window):
    """Display as ellipsoids."""
    window.area("VIEW_3D").spaces.active.shading.type = "MATERIAL"
    with window.inside():
        bpy.ops.object.select_all(action="DESELECT")
        bpy.ops.r5dgs.show_confidence(action="HIDE")
        bpy.ops.r5dgs.set_display(display="ELLIPSOIDS")
    yield 8.0


def viewport(window: Window):
    """Rendered viewport shading by the engine."""
    with window.inside():
        bpy.ops.r5dgs.set_display(display="POINTS")
        bpy.ops.r5dgs.use_engine()
        bpy.ops.r5dgs.show_colors_as_trained()
    window.area("VIEW_3D").spaces.active.shading.type = "RENDERED"
    yield 60.0  # the rasterizer may have to be compiled first


def preview(window: Window):
    """The preview image beside the view."""
    window.area("VIEW_3D").spaces.active.shading.type = "MATERIAL"
    with window.inside():
        bpy.ops.r5dgs.preview("INVOKE_DEFAULT")
    yield 15.0
    with window.inside():
        bpy.ops.screen.area_split(direction="VERTICAL", factor=0.45)
    area = min((area for area in window.window.screen.areas if area.type == "VIEW_3D"), key=lambda area: area.x)
    area.type = "IMAGE_EDITOR"
    area.spaces.active.image = bpy.data.images["R5DGS Preview"]
    yield 1.0
    with window.inside("IMAGE_EDITOR"):
        bpy.ops.image.view_all(fit_view=True)


def merge(window: Window):
    """A mesh by Cycles among the Gaussians, by Merge with Meshes."""
    gaussians = bpy.context.scene
    low, high = bounds()
    middle, size = (low + high) / 2, (high - low).length
    bpy.ops.mesh.primitive_monkey_add(size=0.12 * size, location=middle + Vector((-0.03, -0.08, 0.02)) * size)
    light = bpy.data.objects.new("Sun", bpy.data.lights.new("Sun", "SUN"))
    light.data.energy, light.rotation_euler = 4.0, (0.6, 0.3, 0.0)
    gaussians.collection.objects.link(light)
    gaussians.view_settings.view_transform = "Standard"
    gaussians.render.resolution_percentage = 400
    bpy.ops.r5dgs.merge_with_meshes()
    gaussians.r5dgs_render.meshes.cycles.samples = 32
    gaussians.r5dgs_render.meshes.cycles.use_denoising = False
    bpy.ops.render.render()
    window.window.workspace = bpy.data.workspaces["Compositing"]
    yield 1.0
    with window.inside("NODE_EDITOR"):
        bpy.ops.screen.area_split(direction="HORIZONTAL", factor=0.5)
    area = max((area for area in window.window.screen.areas if area.type == "NODE_EDITOR"), key=lambda area: area.y)
    area.type = "IMAGE_EDITOR"
    area.spaces.active.image = bpy.data.images["Render Result"]
    yield 1.0
    for kind, fit in (("NODE_EDITOR", bpy.ops.node.view_all), ("IMAGE_EDITOR", bpy.ops.image.view_all)):
        with window.inside(kind):
            fit()


SHOTS = (loaded, prompt, nothing, physics, ellipsoids, viewport, preview, merge)


def run(path: Path, folder: Path, shots: list):
    """Set up and take one picture after the other. Yields the seconds to wait."""
    window = Window()
    load(path, window)
    yield 2.0
    for shot in shots:
        waits = shot(window)
        if inspect.isgenerator(waits):
            yield from waits
        views = [area for area in window.window.screen.areas if area.type == "VIEW_3D"]
        for area in views:
            window.region(area, "UI").active_panel_category = SIDEBAR
        yield SETTLE_S
        with window.inside(window.window.screen.areas[0].type):
            bpy.ops.wm.redraw_timer(type="DRAW_WIN_SWAP", iterations=1)
        yield 0.5
        target = folder / f"{shot.__name__}.jpg"
        crop = ["-crop", CROPS[shot.__name__], "+repage"] if shot.__name__ in CROPS else []
        subprocess.run(
            ["import", "-window", "root", "-resize", "1280x", *crop, "-quality", "88", str(target)], check=True
        )
        print(f"written: {target}", flush=True)


def main(arguments: list[str]) -> None:
    """Take the pictures, then quit Blender."""
    parser = argparse.ArgumentParser(description="Take the pictures of docs/user/blender.md.")
    parser.add_argument("scene", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("pictures", nargs="*", choices=[[], *(shot.__name__ for shot in SHOTS)])
    options = parser.parse_args(arguments)
    options.folder.mkdir(parents=True, exist_ok=True)
    bpy.context.preferences.view.show_splash = False
    register_extension()
    chosen = [shot for shot in SHOTS if not options.pictures or shot.__name__ in options.pictures]
    copy = Path(tempfile.mkdtemp(prefix="r5dgs-pictures-")) / options.scene.name
    shutil.copy(options.scene, copy)
    going = run(copy, options.folder.resolve(), chosen)

    def step():
        try:
            return next(going)
        except StopIteration:
            pass
        except BaseException:
            traceback.print_exc()
        shutil.rmtree(copy.parent, ignore_errors=True)
        bpy.ops.wm.quit_blender()
        return None

    bpy.app.timers.register(step, first_interval=1.0)


if __name__ == "__main__":
    main(sys.argv[sys.argv.index("--") + 1 :])
