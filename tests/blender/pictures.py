"""Take the pictures of docs/user/blender.md in a real Blender with a window.

    xvfb-run -a -s "-screen 0 1280x900x24 +extension GLX" blender --factory-startup --window-geometry 0 0 1280 900 \\
        --python tests/blender/pictures.py -- demo.r5dgs FOLDER [PICTURE ...]

Needs ImageMagick's ``import`` (Blender's own screenshots are black under software rendering) and a worker's Python
(`R5DGS_PYTHON`). Each picture is a function that sets up the window; the screenshot follows after Blender has drawn. A
function may be a generator of seconds to wait between its steps. Take the picture `physics` in a run of its own, in
which the panel *Motion* is open, and in a window of 1280 x 1250 pixels.
"""

import argparse
import importlib
import importlib.util
import inspect
import shutil
import subprocess
import sys
import tempfile
import traceback
from pathlib import Path

import bpy
import numpy as np

ROOT = Path(__file__).resolve().parents[2]
CROPS = {"nothing": "256x172+773+540"}  # of 1280 x 900 pixels: the panel Select by Prompt
SETTLE_S = 2.5  # until the window has been redrawn
SIDEBAR = "R5DGS"


def register_extension(open_motion: bool) -> None:
    """Register the extension of this repository, with the panel *Motion* open if requested."""
    spec = importlib.util.spec_from_file_location("r5dgs", ROOT / "__init__.py", submodule_search_locations=[str(ROOT)])
    module = importlib.util.module_from_spec(spec)
    sys.modules["r5dgs"] = module
    spec.loader.exec_module(module)
    if open_motion:  # scripts cannot open panels
        importlib.import_module("r5dgs.r5dgs_addon.panels.motion").R5DGS_PT_motion.bl_options = set()
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


def loaded(window: Window):
    """The sidebar with a loaded scene, at an extrapolated frame."""
    window.scrub(0.9)


def prompt(window: Window):
    """Matches of a prompt, and their selection."""
    with window.inside():
        bpy.ops.r5dgs.select_by_prompt(text="globe and the vase")


def nothing(window: Window):
    """A prompt without matches."""
    with window.inside():
        bpy.ops.r5dgs.select_by_prompt(text="elephant")


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
    """A mesh by Cycles among the Gaussians of the demo, by Merge with Meshes and Add Shadows, in the demo's light."""
    gaussians = bpy.context.scene
    bpy.ops.mesh.primitive_monkey_add(size=0.66, location=(0.35, -0.35, 0.33), rotation=(-0.25, 0.0, 0.5))
    bpy.ops.object.shade_smooth()
    material = bpy.data.materials.new("Orange")
    material.use_nodes = True
    material.node_tree.nodes["Principled BSDF"].inputs["Base Color"].default_value = (0.8, 0.35, 0.1, 1)
    bpy.context.object.data.materials.append(material)
    light = bpy.data.objects.new("Sun", bpy.data.lights.new("Sun", "SUN"))
    light.data.energy, light.rotation_euler = 2.1, np.radians((32.0, -18.0, 20.0))
    gaussians.collection.objects.link(light)
    gaussians.world = bpy.data.worlds.new("Sky")
    gaussians.world.use_nodes = True
    sky = gaussians.world.node_tree.nodes["Background"]
    sky.inputs["Color"].default_value, sky.inputs["Strength"].default_value = (0.74, 0.85, 1.0, 1.0), 0.62
    gaussians.view_settings.view_transform = "Standard"
    gaussians.render.resolution_percentage = 400
    bpy.ops.r5dgs.merge_with_meshes()
    gaussians.r5dgs_render.meshes.cycles.samples = 32
    gaussians.r5dgs_render.meshes.cycles.use_denoising = False
    bpy.ops.r5dgs.add_shadows()
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
    register_extension(options.pictures == ["physics"])
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
