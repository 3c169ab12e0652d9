"""Check the splats in Blender's window against the worker's pictures.

    xvfb-run -a -s "-screen 0 1280x800x24 +extension GLX" \\
        blender --factory-startup --python tests/blender/check_splats.py -- SCENE.r5dgs [PICTURES]

Needs ImageMagick. `R5DGS_PYTHON` sets the worker's Python if it is not found automatically. Screenshots are saved in
the folder PICTURES. Exits with 1 if a viewport differs from the worker's picture of the same view.
"""

import subprocess
import sys
import tempfile
from pathlib import Path

import bpy
import numpy as np
from mathutils import Euler, Matrix, Vector

sys.path.insert(0, str(Path(__file__).parent))
from window import area_of, inside, main_window, region_of, run, service  # noqa: E402

MIN_DB = 40.0
VIEWS = (Euler((1.1, 0, 0.6)), Euler((0.8, 0, -0.9)), Euler((1.3, 0, 2.4)))
THICK = 0.1  # of an object's radius: Gaussians are not thinner, so that closer surfaces have no order
TIMES = (0.0, 0.3, 0.6, 0.95, 1.15)  # in observed spans


def screenshot(path: Path) -> np.ndarray:
    """Screenshot of the screen. [H, W, 3] in [0, 1]"""
    subprocess.run(["import", "-window", "root", str(path)], check=True)
    image = bpy.data.images.load(str(path))
    values = np.empty(4 * image.size[0] * image.size[1], np.float32)
    image.pixels.foreach_get(values)
    picture = values.reshape(image.size[1], image.size[0], 4)[::-1, :, :3]
    bpy.data.images.remove(image)
    return picture


def redraw():
    """Draw the window twice, so that all anti-aliasing samples are started."""
    with inside():
        bpy.ops.wm.redraw_timer(type="DRAW_WIN_SWAP", iterations=2)


def shown_region(picture: np.ndarray) -> tuple[np.ndarray, tuple[slice, slice]]:
    """Pixels of the 3D view that are not covered by a header or sidebar."""
    area, region = area_of("VIEW_3D"), region_of(area_of("VIEW_3D"))
    height = main_window().height
    tops = [r.height for r in area.regions if r.type in ("HEADER", "TOOL_HEADER") and r.height > 1]
    sides = [r.width for r in area.regions if r.type == "TOOLS" and r.width > 1]
    y0, x0 = height - region.y - region.height, region.x
    inner = slice(sum(tops) + 2, region.height - 2), slice(max(sides, default=0) + 2, region.width - 2)
    return picture[y0 : y0 + region.height, x0 : x0 + region.width][inner], inner


def expected(sky: bool = True) -> np.ndarray:
    """The worker's picture of the 3D view, over black without sky. [H, W, 3]"""
    request, cameras = service("engine.render_request"), service("engine.view_cameras")
    with inside():
        region, view_3d = bpy.context.region, bpy.context.region_data
        seen = request.shown(
            bpy.context.evaluated_depsgraph_get(),
            lambda points: cameras.of_region(region, view_3d, points),
            bpy.context.space_data,
        )
        return np.clip(request.render(seen, sky=sky)[1]["color"], 0, 1)


def worker_depth() -> tuple[np.ndarray, np.ndarray]:
    """Depth and coverage of the Gaussians in the 3D view. [H, W] each"""
    request, cameras = service("engine.render_request"), service("engine.view_cameras")
    with inside():
        region, view_3d = bpy.context.region, bpy.context.region_data
        seen = request.shown(
            bpy.context.evaluated_depsgraph_get(), lambda points: cameras.of_region(region, view_3d, points)
        )
        arrays = request.render(seen, ("depth", "alpha"))[1]
    return arrays["depth"], arrays["alpha"]


def largest_object() -> tuple[Vector, float]:
    """Median place and radius of the largest object."""
    clouds = [obj for obj in main_window().scene.objects if obj.r5dgs.role == "CLOUD" and obj.r5dgs.object_id > 0]
    cloud = max(clouds, key=lambda one: one.r5dgs.count)
    places = np.empty(3 * len(cloud.data.points), np.float32)
    cloud.data.attributes["position"].data.foreach_get("vector", places)
    places = places.reshape(-1, 3)
    middle = np.median(places, axis=0)
    radius = float(np.quantile(np.linalg.norm(places - middle, axis=1), 0.8)) * max(cloud.matrix_world.to_scale())
    return cloud.matrix_world @ Vector(middle), radius


def check_meshes(out: Path, size: float):
    """A plane that cuts an object, and a ball half behind it: the nearer of mesh and Gaussians is visible."""
    space = area_of("VIEW_3D").spaces[0]
    space.shading.light, space.shading.color_type, space.shading.single_color = "FLAT", "SINGLE", (0.0, 1.0, 0.0)
    view_3d = space.region_3d
    middle, radius = largest_object()
    view_3d.view_rotation, view_3d.view_location = VIEWS[0].to_quaternion(), middle
    view_3d.view_distance = 6 * radius
    right, back = (view_3d.view_rotation @ Vector(axis) for axis in ((1, 0, 0), (0, 0, 1)))
    ball_place = middle + 0.7 * radius * right - 1.2 * radius * back
    bpy.ops.mesh.primitive_uv_sphere_add(radius=radius, location=ball_place, segments=64, ring_count=32)
    ball = bpy.context.object
    bpy.ops.mesh.primitive_plane_add(size=4 * radius, location=middle)
    plane = bpy.context.object
    plane.matrix_world = Matrix.LocRotScale(middle, VIEWS[0].to_quaternion() @ Euler((0.9, 0, 0)).to_quaternion(), None)
    for obj in (ball, plane):
        obj.select_set(False)
    for name, mesh, other in (("plane", plane, ball), ("ball", ball, plane)):
        mesh.hide_viewport, other.hide_viewport = False, True
        yield 0.5
        redraw()
        picture, inner = shown_region(screenshot(out / f"{name}.png"))
        green = np.abs(picture - (0, 1, 0)).sum(-1) < np.abs(picture - expected()[inner]).sum(-1)
        depth, alpha = (values[inner] for values in worker_depth())
        nearest = mesh_depth((mesh,))[inner]
        both = (alpha > 0.95) & np.isfinite(nearest) & (np.abs(depth - nearest) > THICK * radius)
        both &= local_range(depth) < 0.3 * radius  # at soft silhouettes, the mean depth lies between two surfaces
        before, correct = nearest < depth, green == (nearest < depth)
        ends = f"the mesh is nearer in {(both & before).sum()}, the Gaussians in {(both & ~before).sum()}"
        print(f"{name}: {both.sum()} pixels covered by both ({ends}), right in {correct[both].mean():.2%}", flush=True)
        np.savez(out / f"{name}.npz", green=green, depth=depth, nearest=nearest, alpha=alpha, both=both)
        assert both.sum() >= 2000 and correct[both].mean() >= 0.99
        assert min((both & before).sum(), (both & ~before).sum()) > 300, "one of them is always nearer"
    for obj in (ball, plane):
        bpy.data.objects.remove(obj)


def local_range(values: np.ndarray, radius: int = 5) -> np.ndarray:
    """Return the range of values in squares around the pixels of an image. [H, W]"""
    low = high = values
    for axis in (0, 1):
        moved_low = [np.roll(low, step, axis) for step in range(-radius, radius + 1)]
        moved_high = [np.roll(high, step, axis) for step in range(-radius, radius + 1)]
        low, high = np.min(moved_low, 0), np.max(moved_high, 0)
    return high - low


def mesh_depth(objects) -> np.ndarray:
    """Depth of meshes in the 3D view by casting rays, infinite beside them. [H, W]"""
    region, view_3d = region_of(area_of("VIEW_3D")), area_of("VIEW_3D").spaces[0].region_3d
    to_world = np.array(view_3d.view_matrix.inverted())
    p = np.array(view_3d.window_matrix)
    result = np.full((region.height, region.width), np.inf)
    x, y = np.meshgrid(
        (np.arange(region.width) + 0.5) / region.width * 2 - 1, 1 - (np.arange(region.height) + 0.5) / region.height * 2
    )
    rays = np.stack([(x + p[0, 2]) / p[0, 0], (y + p[1, 2]) / p[1, 1], -np.ones_like(x)], -1)
    for obj in objects:
        to_object = np.linalg.inv(np.array(obj.matrix_world)) @ to_world
        start, across = to_object[:3, 3], rays @ to_object[:3, :3].T
        corners = np.array(obj.bound_box) @ np.array(obj.matrix_world)[:3, :3].T + np.array(obj.matrix_world)[:3, 3]
        seen = corners @ np.linalg.inv(to_world)[:3, :3].T + np.linalg.inv(to_world)[:3, 3]
        u = (p[0, 0] * seen[:, 0] + p[0, 2] * seen[:, 2]) / -seen[:, 2]
        v = (p[1, 1] * seen[:, 1] + p[1, 2] * seen[:, 2]) / -seen[:, 2]
        near = (x >= u.min() - 0.01) & (x <= u.max() + 0.01) & (y >= v.min() - 0.01) & (y <= v.max() + 0.01)
        for row, column in np.argwhere(near):
            direction = Vector(across[row, column])
            hit, place, *_ = obj.ray_cast(Vector(start), direction)
            if hit:
                far = (np.array(place) - start) @ across[row, column] / (across[row, column] @ across[row, column])
                result[row, column] = min(result[row, column], far)
    return result


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    """Peak signal-to-noise ratio in dB."""
    return float(-10 * np.log10(max(np.square(a - b).mean(), 1e-12)))


def checks(path: str, folder: str = ""):
    """Run the check. Yields the seconds to wait after each step."""
    out = Path(folder or tempfile.mkdtemp())
    out.mkdir(parents=True, exist_ok=True)
    bpy.context.preferences.view.show_splash = False
    for obj in list(bpy.data.objects):
        bpy.data.objects.remove(obj)
    with inside():
        bpy.ops.r5dgs.load_scene(filepath=path)
    scene, area = main_window().scene, area_of("VIEW_3D")
    space = area.spaces[0]
    space.overlay.show_overlays, space.show_gizmo = False, False
    view_3d = space.region_3d
    state = next(one.r5dgs for one in bpy.data.collections if one.r5dgs.is_scene)
    print(f"display: {state.display}; message: {service('splats.viewport_splats').message(bpy.context)!r}", flush=True)
    boxes = [obj.bound_box for obj in scene.objects if obj.type == "POINTCLOUD"]
    size = max((Vector(box[6]) - Vector(box[0])).length for box in boxes)
    view_3d.view_distance, space.clip_start, space.clip_end = 0.5 * size, 0.01, 1000
    scene.view_settings.view_transform = "Standard"
    worst = 1e9
    for number, rotation in enumerate(VIEWS):
        view_3d.view_rotation = rotation.to_quaternion()
        for time in TIMES:
            t = state.t_start + time * (state.t_max - state.t_start)
            scene.frame_set(round(state.frame_zero + t * state.frames_per_unit))
            yield 0.3
            redraw()
            found, inner = shown_region(screenshot(out / f"view{number}_t{time:g}.png"))
            wanted = expected()[inner]
            value = psnr(found, wanted)
            worst = min(worst, value)
            print(f"view {number}, t = {time:g}: {value:.1f} dB", flush=True)
            if number == 0 and time == 0.3:
                np.savez(out / "compare.npz", found=found, wanted=wanted)
    for kind in ("MATERIAL", "RENDERED", "SOLID"):
        space.shading.type = kind
        yield 2.0
        redraw()
        found, inner = shown_region(screenshot(out / f"{kind.lower()}.png"))
        value = psnr(found, expected()[inner])
        worst = min(worst, value)
        print(f"{kind}: {value:.1f} dB", flush=True)
    scene.r5dgs_render.sky = False
    space.shading.background_type, space.shading.background_color = "VIEWPORT", (0, 0, 0)
    yield 0.5
    redraw()
    found, inner = shown_region(screenshot(out / "without_sky.png"))
    value = psnr(found, expected(sky=False)[inner])
    worst = min(worst, value)
    print(f"without sky over black: {value:.1f} dB", flush=True)
    scene.r5dgs_render.sky = True
    yield from check_meshes(out, size)
    print("message:", service("splats.viewport_splats").message(bpy.context), flush=True)
    assert worst > MIN_DB


if __name__ == "__main__":
    run(checks, *sys.argv[sys.argv.index("--") + 1 :])
